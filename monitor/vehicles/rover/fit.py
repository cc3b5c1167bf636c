"""The drive observer of a rover: where its signals come from, and its fit."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from adapters.channels import Channel
from adapters.errors import TelemetryError
from gains.identification.segment import Segment
from gains.plants.plant import Plant
from monitor.fitting.effect_signals import EffectSignals, effect_signals, servo
from monitor.fitting.fit_effects import Kind, fit_effects
from monitor.fitting.fitted import Fitted, Log
from monitor.fitting.survey import Survey
from monitor.sampling.gate import GateRule
from monitor.sampling.scaled_inputs import DriveInputs
from monitor.vehicles.rover.identify import DriveFit, drive_plant, identify_drive

_VELOCITIES = (("LOCAL_POSITION_NED", 1.0), ("GLOBAL_POSITION_INT", 0.01))
_NORTH, _EAST = (DriveInputs.signals.index(f"velocity_{axis}") for axis in ("north", "east"))


def _speed(signals: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.hypot(signals[:, _NORTH], signals[:, _EAST]))


def _learn(segments: Sequence[Segment], rate_hz: float, inputs: Sequence[str], name: str) -> tuple[DriveFit, Plant]:
    fit = identify_drive(segments, rate_hz, inputs)
    return fit, drive_plant(fit, name)


_ROVER = Kind(
    observer=DriveInputs.kind,
    slowest=1.0 / 6.0,
    speed=_speed,
    full={"steering": "speed"},
    learn=_learn,
)


def rover_gate(settle_s: float) -> GateRule:
    """Return when a rover's samples are evidence: armed; one that stands never is."""
    return GateRule(require_airborne=False, settle_s=settle_s)


def fit_drive(name: str, logs: Sequence[Log], surveys: Sequence[Survey], gate: GateRule) -> Fitted:
    """Identify a rover's steering and throttle on healthy recordings, design the observer, calibrate its alarms.

    Raises
    ------
    TelemetryError, ModelError, InfeasibleError
        The recordings do not hold what is needed, excite no axis, or allow no certified design.
    """
    return fit_effects(_ROVER, name, logs, rover_signals(surveys), gate)


def rover_signals(surveys: Sequence[Survey]) -> EffectSignals:
    """Choose the channels: ArduPilot's usual outputs (1 steering, 3 throttle), velocity over ground.

    Raises
    ------
    TelemetryError
        A message that is needed is missing or comes too seldom; the text says which to record.
    """
    velocity = next((v for v in _VELOCITIES if all(found.rate_hz.get(v[0]) for found in surveys)), None)
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
