"""The surfaces observer of a plane."""

from __future__ import annotations

from monitor.fitting.calibrate import SETTLE_S
from monitor.fitting.fit_effects import EffectKind, fit_effects
from monitor.fitting.fitted import FitRequest, Fitted
from monitor.sampling.gate import GateRule
from monitor.vehicles.plane.identify import identify_surfaces
from monitor.vehicles.plane.signals import plane_signals
from monitor.vehicles.plane.transform import SurfaceInputs

_PLANE = EffectKind(
    observer=SurfaceInputs.kind,
    # Slower than half its usual speed a plane is on the ground or stalls, where deflections act in other ways.
    slowest=0.5,
    speed=lambda signals: signals[:, SurfaceInputs.signals.index("airspeed")],
    full={"aileron": "pressure", "elevator": "pressure", "rudder": "pressure"},
    identify=identify_surfaces,
)


def fit_plane(request: FitRequest) -> tuple[Fitted, GateRule]:
    """Identify a plane's surfaces and throttle on healthy recordings, design the observer, calibrate its alarms.

    Samples are evidence while the plane is armed, and in the air where it says so; a slow one never is.

    Raises
    ------
    TelemetryError, ModelError, InfeasibleError
        The recordings do not hold what is needed, excite no axis, or allow no certified design.
    """
    return fit_effects(_PLANE, request, plane_signals(request.surveys), GateRule(settle_s=SETTLE_S))
