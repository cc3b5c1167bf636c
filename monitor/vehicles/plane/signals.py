"""Which messages hold a plane's deflections and airspeed."""

from __future__ import annotations

from collections.abc import Sequence

from adapters.channels import Channel
from adapters.errors import TelemetryError
from monitor.fitting.effect_signals import EFFECT_MESSAGES, EffectSignals, effect_signals, servo
from monitor.fitting.survey import Survey
from monitor.vehicles.base import Preview
from monitor.vehicles.plane.transform import SurfaceInputs

_AIRSPEED_MESSAGE = "VFR_HUD"

MESSAGES = EFFECT_MESSAGES | {_AIRSPEED_MESSAGE}


def plane_signals(surveys: Sequence[Survey]) -> EffectSignals:
    """Choose the channels: ArduPilot's usual outputs (1 aileron, 2 elevator, 3 throttle, 4 rudder), airspeed.

    Raises
    ------
    TelemetryError
        A message that is needed is missing or comes too seldom; the text says which to record.
    """
    if not all(survey.counts.get(_AIRSPEED_MESSAGE) for survey in surveys):
        raise TelemetryError(f"no airspeed in every log; record {_AIRSPEED_MESSAGE} at 10 Hz or more")
    servos = {
        "aileron": servo("aileron", 1, 1500.0, 500.0),
        "elevator": servo("elevator", 2, 1500.0, 500.0),
        "throttle": servo("throttle", 3, 1000.0, 1000.0),
        "rudder": servo("rudder", 4, 1500.0, 500.0),
    }
    airspeed = {"airspeed": Channel("airspeed", _AIRSPEED_MESSAGE, ("airspeed",))}
    return effect_signals(surveys, SurfaceInputs.signals, servos, airspeed)


def preview(survey: Survey) -> Preview:
    """Return what could be watched with the messages of a recording."""
    signals = plane_signals([survey])
    return Preview(("aileron", "elevator", "throttle", "rudder"), signals.channels, signals.rate_hz)
