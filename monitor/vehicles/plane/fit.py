"""The surfaces observer of a plane: deflections, scaled by dynamic pressure, to body rates and thrust.

Inputs are scaled, and measured forces are among them (:class:`SurfaceInputs`), so that for every axis

    roll_rate+  = a roll_rate  + b aileron  + damping, coupling with yaw, side force, trim
    pitch_rate+ = a pitch_rate + b elevator + damping, normal force, gravity, trim
    yaw_rate+   = a yaw_rate   + b rudder   + damping, coupling with roll, side force, gravity, trim
    forward_acceleration+ = b throttle + drag with dynamic pressure, and with lift

has constant coefficients at every speed. Gusts act through sideslip and angle of attack, which accelerometers measure:
with the measured forces as inputs, gusts are not in the residual. Each actuator belongs to one axis; a rudder that only
follows the aileron by a mixer cannot be learned beside it in roll.
"""

from collections.abc import Sequence

from gains.identification.axes import AxesFit, fit_axes
from gains.identification.regression import AxisModel
from gains.identification.segment import Segment
from monitor.fitting.calibrate import SETTLE_S
from monitor.fitting.fit_effects import EffectKind, fit_effects
from monitor.fitting.fitted import FitRequest, Fitted
from monitor.sampling.gate import GateRule
from monitor.vehicles.plane.signals import plane_signals
from monitor.vehicles.plane.transform import SurfaceInputs

AXES = (
    AxisModel("roll_rate", "aileron", ("pressure", "roll_damping", "yaw_coupling", "side_force"), offset=False),
    AxisModel("pitch_rate", "elevator", ("pressure", "pitch_damping", "normal_force", "normal_gravity"), offset=False),
    AxisModel(
        "yaw_rate",
        "rudder",
        ("pressure", "yaw_damping", "roll_coupling", "side_force", "side_gravity"),
        rivals=("aileron",),
        offset=False,
    ),
    AxisModel("forward_acceleration", "throttle", ("pressure", "normal_force", "lift_drag"), dynamic=False),
)
_MANOEUVRES = {
    "aileron": "roll left and right briskly, ten times",
    "elevator": "pull up and push over briskly, ten times",
    "rudder": "yaw left and right with the rudder alone, ten times",
    "throttle": "change between climb power and idle, ten times",
}


def identify_surfaces(segments: Sequence[Segment], rate_hz: float, inputs: Sequence[str]) -> AxesFit:
    """Fit the model of the module's docstring.

    Segments are healthy flight in unbroken stretches: u as the transform gives it without delays and lags, its columns
    named by ``inputs``, y in the order roll, pitch, yaw rate (rad/s), forward specific force (m/s^2).

    Raises
    ------
    ModelError
        Too little flight, or no actuator whose effect could be learned.
    """
    return fit_axes(segments, rate_hz, inputs, AXES, _MANOEUVRES)


_PLANE = EffectKind(
    observer=SurfaceInputs.kind,
    # Below half its usual speed a plane is on the ground or stalls, where deflections act differently.
    slowest=0.5,
    speed=lambda signals: signals[:, SurfaceInputs.signals.index("airspeed")],
    full={"aileron": "pressure", "elevator": "pressure", "rudder": "pressure"},
    identify=identify_surfaces,
    sensors=("gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z"),
)


def fit_plane(request: FitRequest) -> tuple[Fitted, GateRule]:
    """Identify a plane's surfaces and throttle on healthy recordings, design the observer, calibrate its alarms.

    Samples are evidence while the plane is armed, in the air (if its telemetry tells that), and not slow.
    """
    return fit_effects(_PLANE, request, plane_signals(request.surveys), GateRule(settle_s=SETTLE_S))
