"""Choose the messages with the raw signals of vehicles whose deflections act with speed, and the rate of their grid."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from math import tau

from adapters.channels import Channel
from adapters.errors import TelemetryError
from adapters.logs.log_parameters import PARAMETER_MESSAGES
from monitor.fitting.output_functions import CONTROLS_MESSAGE, NO_OUTPUT, Actuator, MixedOutputs, actuator_channels
from monitor.fitting.survey import IMUS, MOTOR_MESSAGE, Survey, required
from monitor.sampling.phase import FlightPhase
from monitor.sampling.slow_telemetry import LOG_FASTER

_ATTITUDE = "ATTITUDE"
_ANGLES = {"roll": "roll", "pitch": "pitch", "yaw": "yaw"}
_RATES = {"roll_rate": "rollspeed", "pitch_rate": "pitchspeed", "yaw_rate": "yawspeed"}
_FORCES = {"forward_acceleration": "xacc", "lateral_acceleration": "yacc", "vertical_acceleration": "zacc"}
EFFECT_MESSAGES = FlightPhase.interests | PARAMETER_MESSAGES | {MOTOR_MESSAGE, CONTROLS_MESSAGE, _ATTITUDE, *IMUS}
"""Messages of attitude, acceleration and commands, of the actuators on them, and of the phase of flight."""
_RATES_HZ = (100.0, 50.0, 40.0, 25.0, 20.0, 10.0)
"""Rates of the grid, hertz: the usual message rates of autopilots, so that samples fall on messages."""
_NEARLY = 0.9
"""Share of a rate from which a message counts as sent at that rate. Chosen: autopilots send slightly less often than
requested."""


@dataclass(frozen=True, slots=True)
class EffectSignals:
    """Channels of a transform's raw signals, in its order, and their samples per second."""

    channels: tuple[Channel, ...]
    rate_hz: float
    parameters: Mapping[str, float] = field(default_factory=dict)  # of the transform, for mixed outputs

    @property
    def undriven(self) -> frozenset[str]:
        """Names of the actuators that no output drives."""
        return frozenset(channel.name for channel in self.channels if channel.scale == NO_OUTPUT)

    def driven(self, actuators: Sequence[Actuator]) -> tuple[str, ...]:
        """Return the names of the actuators that an output drives."""
        return tuple(actuator.name for actuator in actuators if actuator.name not in self.undriven)


def effect_signals(
    surveys: Sequence[Survey],
    names: Sequence[str],
    actuators: Sequence[Actuator],
    speeds: Mapping[str, Channel],
    mixes: Sequence[MixedOutputs],
) -> EffectSignals:
    """Choose the channels of the transform's signals ``names``: of ``actuators`` and, by signal, of ``speeds``.

    The grid follows the slowest of attitude, acceleration and commands; speeds may come less often.

    Raises
    ------
    TelemetryError
        A message that is needed is missing or comes too seldom; the text says which to record.
    """
    required(surveys, [_ATTITUDE], "attitude")
    commands, mixed = actuator_channels(surveys, actuators, mixes)
    imu = required(surveys, IMUS, "accelerations")
    known = {
        **{name: Channel(name, _ATTITUDE, (field,), period=tau) for name, field in _ANGLES.items()},
        **{name: Channel(name, _ATTITUDE, (field,)) for name, field in _RATES.items()},
        **{name: Channel(name, imu, (field,), scale=IMUS[imu]) for name, field in _FORCES.items()},
        **commands,
        **speeds,
    }
    messages = {_ATTITUDE, imu, *(channel.message for channel in commands.values())}
    return EffectSignals(tuple(known[name] for name in names), _rate_hz(surveys, messages), mixed)


def _rate_hz(surveys: Sequence[Survey], messages: Collection[str]) -> float:
    slowest, message = min((survey.rate_hz[message], message) for survey in surveys for message in messages)
    for rate in _RATES_HZ:
        if slowest >= _NEARLY * rate:
            return rate
    onboard = any(survey.onboard for survey in surveys)
    advice = f"{LOG_FASTER}; '--vehicle inertial' fits the sensors alone" if onboard else "Record it at 50 Hz or more"
    raise TelemetryError(f"{message} comes {slowest:.1f} times a second. {advice}")
