"""Tell which messages have rates and accelerations without the bias that the autopilot's estimator has learned."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from adapters.channels import Channel
from monitor.fitting.survey import Survey

_RATES = frozenset({"rollspeed", "pitchspeed", "yawspeed"})
_IMU = frozenset({"xgyro", "ygyro", "zgyro", "xacc", "yacc", "zacc"})

_BIAS = "{messages}: the autopilot subtracts the bias that its estimator has learned, so slow sensor faults fade"
# Measured on PX4 (main of 2026-08) in its simulator.
_GYROS = "; within 2 s PX4 subtracts four fifths of 0.05 rad/s"
_ACCELEROMETERS = ", two thirds of 0.5 m/s^2"
_RAW_LINK = ". SCALED_IMU is raw (mavlink stream -s SCALED_IMU -r 50), and so is HIGHRES_IMU of the vehicle's log"


def corrected(survey: Survey, message: str) -> frozenset[str]:
    """Return the fields of a message from which the autopilot subtracts the bias that its estimator has learned.

    PX4 subtracts it from HIGHRES_IMU and from body rates (``vehicle_angular_velocity`` in its logs); SCALED_IMU and
    ``sensor_combined``, which HIGHRES_IMU is made of in its logs, are raw. ArduPilot subtracts the gyros' bias from the
    rates of ATTITUDE on a link; its IMU messages, and the IMU records that a log's ATTITUDE is made of, are raw.
    """
    if message in ("ATTITUDE", "ATTITUDE_QUATERNION"):
        return _RATES if survey.px4 or not survey.onboard else frozenset()
    return _IMU if message == "HIGHRES_IMU" and survey.px4 and not survey.onboard else frozenset()


def hidden(surveys: Sequence[Survey], channels: Iterable[Channel]) -> str | None:
    """Return, for people, what the messages of some channels hide; None if they are raw."""
    used = {
        channel.message: None
        for channel in channels
        if any(channel.path[0] in corrected(survey, channel.message) for survey in surveys)
    }
    if not used:
        return None
    text = _BIAS.format(messages=", ".join(used))
    if all(survey.px4 for survey in surveys):
        text += _GYROS + (_ACCELEROMETERS + _RAW_LINK) * ("HIGHRES_IMU" in used)
    return text
