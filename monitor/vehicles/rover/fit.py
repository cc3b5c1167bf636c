"""The drive observer of a rover."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from monitor.fitting.calibrate import SETTLE_S
from monitor.fitting.fit_effects import EffectKind, fit_effects
from monitor.fitting.fitted import FitRequest, Fitted
from monitor.sampling.gate import GateRule
from monitor.vehicles.rover.identify import identify_drive
from monitor.vehicles.rover.signals import rover_signals
from monitor.vehicles.rover.transform import DriveInputs

_NORTH, _EAST = (DriveInputs.signals.index(f"velocity_{axis}") for axis in ("north", "east"))


def _speed(signals: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.hypot(signals[:, _NORTH], signals[:, _EAST]))


_ROVER = EffectKind(
    observer=DriveInputs.kind,
    # The transform divides by the speed: below a sixth of the usual one a rover turns on the spot, slips or stands.
    slowest=1.0 / 6.0,
    speed=_speed,
    full={"steering": "speed"},
    identify=identify_drive,
)


def fit_rover(request: FitRequest) -> tuple[Fitted, GateRule]:
    """Identify a rover's steering and throttle on healthy recordings, design the observer, calibrate its alarms.

    Samples are evidence while the rover is armed; where it is slow they never are.

    Raises
    ------
    TelemetryError, ModelError, InfeasibleError
        The recordings do not hold what is needed, excite no axis, or allow no certified design.
    """
    gate = GateRule(require_airborne=False, settle_s=SETTLE_S)
    return fit_effects(_ROVER, request, rover_signals(request.surveys), gate)
