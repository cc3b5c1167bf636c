"""The surfaces observer of a plane: where its signals come from, and its fit."""

from __future__ import annotations

from collections.abc import Sequence

from adapters.channels import Channel
from adapters.errors import TelemetryError
from gains.identification.segment import Segment
from gains.plants.plant import Plant
from monitor.fitting.effect_signals import EffectSignals, effect_signals, servo
from monitor.fitting.fit_effects import Kind, fit_effects
from monitor.fitting.fitted import Fitted, Log
from monitor.fitting.survey import Survey
from monitor.sampling.gate import GateRule
from monitor.sampling.scaled_inputs import SurfaceInputs
from monitor.vehicles.plane.identify import SurfacesFit, identify_surfaces, surfaces_plant

_AIRSPEED_MESSAGE = "VFR_HUD"


def _learn(segments: Sequence[Segment], rate_hz: float, inputs: Sequence[str], name: str) -> tuple[SurfacesFit, Plant]:
    fit = identify_surfaces(segments, rate_hz, inputs)
    return fit, surfaces_plant(fit, name)


_PLANE = Kind(
    observer=SurfaceInputs.kind,
    slowest=0.5,
    speed=lambda signals: signals[:, SurfaceInputs.signals.index("airspeed")],
    full={"aileron": "pressure", "elevator": "pressure", "rudder": "pressure"},
    learn=_learn,
)


def plane_gate(settle_s: float) -> GateRule:
    """Return when a plane's samples are evidence: armed, and in the air where it says so; a slow one never is."""
    return GateRule(settle_s=settle_s)


def fit_surfaces(name: str, logs: Sequence[Log], surveys: Sequence[Survey], gate: GateRule) -> Fitted:
    """Identify a plane's surfaces and throttle on healthy recordings, design the observer, calibrate its alarms.

    Raises
    ------
    TelemetryError, ModelError, InfeasibleError
        The recordings do not hold what is needed, excite no axis, or allow no certified design.
    """
    return fit_effects(_PLANE, name, logs, plane_signals(surveys), gate)


def plane_signals(surveys: Sequence[Survey]) -> EffectSignals:
    """Choose the channels: ArduPilot's usual outputs (1 aileron, 2 elevator, 3 throttle, 4 rudder), airspeed.

    Raises
    ------
    TelemetryError
        A message that is needed is missing or comes too seldom; the text says which to record.
    """
    if not all(found.counts.get(_AIRSPEED_MESSAGE) for found in surveys):
        raise TelemetryError(f"no airspeed in every log; record {_AIRSPEED_MESSAGE} at 10 Hz or more")
    servos = {
        "aileron": servo("aileron", 1, 1500.0, 500.0),
        "elevator": servo("elevator", 2, 1500.0, 500.0),
        "throttle": servo("throttle", 3, 1000.0, 1000.0),
        "rudder": servo("rudder", 4, 1500.0, 500.0),
    }
    airspeed = {"airspeed": Channel("airspeed", _AIRSPEED_MESSAGE, ("airspeed",))}
    return effect_signals(surveys, SurfaceInputs.signals, servos, airspeed)
