"""Which messages hold the raw signals of the strapdown transform, as far as a vehicle sends them."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from math import tau
from typing import Any, NamedTuple

from adapters.channels import STANDARD_GRAVITY, Channel
from adapters.errors import TelemetryError
from monitor.fitting.raw_streams import corrected
from monitor.fitting.survey import IMUS, Survey, common_rate_hz, least_hz
from monitor.sampling.phase import FlightPhase
from monitor.vehicles.base import Preview
from monitor.vehicles.inertial.ros_signals import BARE_POSITIONS, ros_channels
from monitor.vehicles.inertial.strapdown import BAROMETER, ESTIMATED, GPS, IMU, LEARNED, MAGNETOMETER

MESSAGES = FlightPhase.interests | frozenset({"ATTITUDE", *IMUS, "GPS_RAW_INT", "SCALED_PRESSURE"})

_LARGEST = 1.7e308
"""Largest number that is a float without overflow."""
_FIX = ("fix_type", 2.0)
"""GPS_FIX_TYPE_2D_FIX of MAVLink: below it a receiver has no position, and its message may repeat an old one."""
_SELDOM = ("GPS_RAW_INT", "SCALED_PRESSURE")
"""Messages that no autopilot sends as often as those of its IMU; the transform waits for them."""
NAVIGATED_HZ = 10.0
"""Least rate of the IMU for which its integrals are meaningful, hertz: two samples between two fixes. At 2 Hz three of
twelve flights raised the alarm of an accelerometer, and a GPS that drifted away at 0.7 m/s was detected after 13 s
instead of 5.6 s without the IMU."""
_GYRO_SCALE = 1e-3
"""Unit of SCALED_IMU and RAW_IMU, rad/s: they count milliradians per second."""
LEARNED_HOLD_S = 10.0
"""Time for which the bias that an estimator has learned stays valid, seconds: in that time ArduPilot's estimator
learned half of a bias (on two flights)."""
_HOVERING = ("rotor", "copter")
"""Words in the types of vehicles that are carried by their thrust."""
_ENOUGH = 0.5
"""Share of HIGHRES_IMU's rate from which a raw message is preferred to a corrected one. Chosen: half the samples cost
little for a slow fault of a sensor, compared with its fading within seconds in corrected ones."""


class StrapdownSource(NamedTuple):
    """Channels in the order of the transform's signals, and the transform's parameters that say which signals exist.

    Messages in ``seldom`` come less often than those of the IMU; the transform waits for them. Without an ``imu``, the
    vehicle is assumed to hover at its attitude.
    """

    channels: tuple[Channel, ...]
    parameters: dict[str, float]
    seldom: tuple[str, ...]
    imu: bool = True


def strapdown_channels(examples: Mapping[str, Mapping[str, Any]], imus: Iterable[str] = IMUS) -> StrapdownSource:
    """Choose the channels.

    The IMU is the first of some messages: HIGHRES_IMU (SI units, microseconds), SCALED_IMU or RAW_IMU (which ArduPilot
    sends in the same units). Over a radio there may be none; GPS and barometer are then compared with each other and
    with a vehicle that hovers at its attitude. The barometer is the pressure altitude of HIGHRES_IMU, which comes with
    the IMU's own time stamp, else the pressure of SCALED_PRESSURE. The altitude of VFR_HUD is no barometer: it is the
    autopilot's estimate, which a fault of any sensor moves, and it has no time stamp.

    Parameters
    ----------
    examples : Mapping[str, Mapping[str, Any]]
        Fields of one message (in motion, after the first GPS fix) for each message name that the vehicle sends.
    imus : Iterable[str]
        Messages of inertial measurements, the preferred ones first.

    Raises
    ------
    TelemetryError
        No attitude, or neither an inertial measurement nor a position.
    """
    if "ATTITUDE" not in examples:
        raise TelemetryError("no ATTITUDE message: the inertial observer needs it; request it from the autopilot")
    imu = next((name for name in imus if name in examples), None)
    if imu is None:
        channels = _trim()
    else:
        rate = 1.0 if imu == "HIGHRES_IMU" else _GYRO_SCALE
        channels = [Channel(name, imu, (name,), scale=IMUS[imu] if "acc" in name else rate) for name in IMU[:6]]
    channels.append(Channel("roll", "ATTITUDE", ("roll",), period=tau))
    channels.append(Channel("pitch", "ATTITUDE", ("pitch",)))
    channels.append(Channel("yaw", "ATTITUDE", ("yaw",), period=tau))
    gps = _there(examples, "GPS_RAW_INT", ("lat", "lon", "vel", "cog")) and not _unknown(examples["GPS_RAW_INT"])
    if gps:
        fields = (("lat", 1e-7), ("lon", 1e-7), ("alt", 1e-3), ("vel", 1e-2), ("cog", 1e-2))
        fixed = (_FIX,) if _there(examples, "GPS_RAW_INT", ("fix_type",)) else ()
        channels += [
            Channel(
                name, "GPS_RAW_INT", (field,), scale=scale, period=360.0 if field == "cog" else None, at_least=fixed
            )
            for name, (field, scale) in zip(GPS, fields, strict=True)
        ]
    if imu is None and not gps:
        raise TelemetryError(
            "no HIGHRES_IMU, SCALED_IMU or RAW_IMU message, and no GPS_RAW_INT with position, speed and course: "
            "request one from the autopilot"
        )
    barometer = 0.0
    if _there(examples, "HIGHRES_IMU", ("pressure_alt",)):
        barometer = 1.0
        channels.append(Channel(BAROMETER[0], "HIGHRES_IMU", ("pressure_alt",)))
    elif _there(examples, "SCALED_PRESSURE", ("press_abs",)):
        barometer = 2.0
        channels.append(Channel(BAROMETER[0], "SCALED_PRESSURE", ("press_abs",)))
    magnetometer = (
        imu is not None and _there(examples, imu, MAGNETOMETER) and any(examples[imu][name] for name in MAGNETOMETER)
    )
    if imu is not None and magnetometer:
        channels += [Channel(name, imu, (name,)) for name in MAGNETOMETER]
    flags = {"gps": float(gps), "barometer": barometer, "magnetometer": float(magnetometer)}
    return StrapdownSource(tuple(channels), flags, _SELDOM, imu is not None)


def _trim() -> list[Channel]:
    """Return the channels of a vehicle without messages of its IMU (as over radios), which is assumed to hover.

    Its thrust carries it: the specific force is that of gravity, against the body's z axis; the rates are those that
    the autopilot estimates.
    """
    force = [
        Channel(name, "ATTITUDE", ("roll",), scale=0.0, offset=offset)
        for name, offset in zip(IMU[:3], (0.0, 0.0, -STANDARD_GRAVITY), strict=True)
    ]
    return force + _rates(IMU[3:6])


def _rates(names: Sequence[str]) -> list[Channel]:
    """Return the rates that the autopilot estimates as channels of these names."""
    fields = ("rollspeed", "pitchspeed", "yawspeed")
    return [Channel(name, "ATTITUDE", (field,)) for name, field in zip(names, fields, strict=True)]


def common_channels(surveys: Sequence[Survey]) -> StrapdownSource:
    """Choose the channels from the messages that every recording holds: an autopilot's, otherwise those of ROS 2."""
    examples = _examples(surveys)
    if "ATTITUDE" not in examples:
        rates = {name: least_hz(surveys, name) for name in examples}
        if (found := ros_channels(examples, rates)) is not None:
            return StrapdownSource(*found)
    return strapdown_channels(examples, _imus(surveys, "GPS_RAW_INT" in examples))


def _examples(surveys: Sequence[Survey]) -> dict[str, Mapping[str, Any]]:
    common = set.intersection(*(set(survey.examples) for survey in surveys))
    return {message: surveys[0].examples[message] for message in common}


def with_learned_biases(surveys: Sequence[Survey], source: StrapdownSource) -> StrapdownSource | None:
    """Return a source without an IMU, with gyros too seldom to be integrated; None if there are no gyros.

    These gyros show the bias that the autopilot's estimator subtracts from them.
    """
    examples = {} if source.imu else _examples(surveys)
    slow = next((name for name in ("SCALED_IMU", "RAW_IMU") if name in examples and _tells_biases(surveys, name)), None)
    if slow is None:
        return None
    raw = [Channel(name, slow, (name,), scale=_GYRO_SCALE) for name in IMU[3:6]]
    gyros, rates = (
        [replace(channel, interpolation="previous") for channel in found] for found in (raw, _rates(ESTIMATED))
    )
    channels = (*source.channels[:3], *gyros, *source.channels[6:], *rates)
    return StrapdownSource(channels, {**source.parameters, LEARNED: LEARNED_HOLD_S}, (*source.seldom, slow), imu=False)


def _tells_biases(surveys: Sequence[Survey], message: str) -> bool:
    """Return whether the gyros of a message are raw, whereas the rates of ATTITUDE have the learned bias subtracted."""
    return all(corrected(survey, "ATTITUDE") and not corrected(survey, message) for survey in surveys)


def _imus(surveys: Sequence[Survey], gps: bool) -> tuple[str, ...]:
    """Return the messages of inertial measurements, the preferred ones first: raw ones that come often enough.

    Messages that come too seldom are left out for a vehicle that hovers at its attitude and has a GPS.
    """
    least = _ENOUGH * least_hz(surveys, "HIGHRES_IMU")

    def second_choice(message: str) -> bool:
        return any(corrected(survey, message) for survey in surveys) or least_hz(surveys, message) < least

    names = sorted(IMUS, key=second_choice)
    types = [name for survey in surveys for name in survey.vehicle_types]
    if not gps or not any(word in name for name in types for word in _HOVERING):
        return tuple(names)
    return tuple(name for name in names if least_hz(surveys, name) >= NAVIGATED_HZ)


def inertial_rate_hz(surveys: Sequence[Survey], source: StrapdownSource) -> float:
    """Return the rate of the slowest message of attitude or IMU in the slowest recording."""
    return common_rate_hz(surveys, [channel for channel in source.channels if channel.message not in source.seldom])


def preview(survey: Survey) -> Preview:
    """Return what could be watched with the messages of a recording, and which sensors are missing."""
    source = common_channels([survey])
    gps, barometer, magnetometer = (bool(source.parameters[name]) for name in ("gps", "barometer", "magnetometer"))
    learned = with_learned_biases([survey], source) is not None
    watches, missing = ["gyro_x", "gyro_y", "gyro_z"] * (source.imu or learned), []
    if not source.imu:
        missing.append(
            "gyro_*, " * (not learned) + "accel_*, motion_*, gps_velocity_*, compass: no HIGHRES_IMU, SCALED_IMU or "
            f"RAW_IMU of {NAVIGATED_HZ:g} Hz or more"
        )
    if gps:
        watches += ["gps_north", "gps_east"]
        if source.parameters["gps"] == BARE_POSITIONS:
            missing.append("gps_velocity_*: positions come without a velocity: only their jumps and fast drifts show")
        elif source.imu:
            watches += ["gps_velocity_north", "gps_velocity_east"]
    else:
        missing.append("gps_*: no GPS_RAW_INT with position, speed and course")
    if source.imu and (gps or barometer):
        watches.append("accel_z")
    if gps and barometer:
        watches += ["gps_down", "baro"]
    elif not barometer:
        missing.append("baro, gps_down: no pressure (HIGHRES_IMU with pressure_alt, or SCALED_PRESSURE)")
    if magnetometer:
        watches.append("compass")
    elif source.imu:
        missing.append("compass: no magnetic field in HIGHRES_IMU, SCALED_IMU or RAW_IMU")
    timed = all(
        channel.message in survey.rate_hz for channel in source.channels if channel.message not in source.seldom
    )
    rate_hz = inertial_rate_hz([survey], source) if timed else None
    return Preview(tuple(watches), source.channels, rate_hz, tuple(missing))


def _there(examples: Mapping[str, Mapping[str, Any]], message: str, names: tuple[str, ...]) -> bool:
    fields = examples.get(message, {})
    # compared, not converted: whole numbers may be larger than any float
    return all(isinstance(fields.get(name), int | float) and abs(fields[name]) <= _LARGEST for name in names)


def _unknown(fields: Mapping[str, Any]) -> bool:
    """Return whether speed or course hold the value for unknown."""
    return 65_535 in (fields["vel"], fields["cog"])
