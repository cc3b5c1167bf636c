"""Which messages hold a rover's steering, throttle and velocity."""

from __future__ import annotations

from collections.abc import Sequence

from adapters.channels import Channel
from adapters.errors import TelemetryError
from monitor.fitting.effect_signals import EFFECT_MESSAGES, EffectSignals, effect_signals, servo
from monitor.fitting.survey import Survey
from monitor.vehicles.base import Preview
from monitor.vehicles.rover.transform import DriveInputs

# Messages of velocity over ground and the m/s in their units, the preferred one first.
_VELOCITIES = (("LOCAL_POSITION_NED", 1.0), ("GLOBAL_POSITION_INT", 0.01))

MESSAGES = EFFECT_MESSAGES | {message for message, _ in _VELOCITIES}


def rover_signals(surveys: Sequence[Survey]) -> EffectSignals:
    """Choose the channels: ArduPilot's usual outputs (1 steering, 3 throttle), velocity over ground.

    Raises
    ------
    TelemetryError
        A message that is needed is missing or comes too seldom; the text says which to record.
    """
    velocity = next((v for v in _VELOCITIES if all(survey.rate_hz.get(v[0]) for survey in surveys)), None)
    if velocity is None:
        raise TelemetryError(
            f"no velocity in every log; record one of {', '.join(v[0] for v in _VELOCITIES)} at 10 Hz+"
        )
    message, scale = velocity
    velocities = {
        name: Channel(name, message, (field,), scale=scale)
        for name, field in (("velocity_north", "vx"), ("velocity_east", "vy"))
    }
    servos = {"steering": servo("steering", 1, 1500.0, 500.0), "throttle": servo("throttle", 3, 1500.0, 500.0)}
    return effect_signals(surveys, DriveInputs.signals, servos, velocities)


def preview(survey: Survey) -> Preview:
    """Return what could be watched with the messages of a recording."""
    signals = rover_signals([survey])
    return Preview(("steering", "throttle"), signals.channels, signals.rate_hz)
