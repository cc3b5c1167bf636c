"""The drive observer of a rover: steering times speed to yaw rate, throttle to forward specific force.

    yaw_rate+             = a yaw_rate + b (steering + kappa steering^3) s + c        s = forward speed / reference,
                                                                                   1 if driven on two sides
    forward_acceleration+ = b throttle + b_v s + c

Throttle determines the specific force, not the speed: a slope slows a rover down, but its accelerometer does not
measure that. kappa, the curvature of turning rate over steering (linkage, tyres), belongs to the transform.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from gains.identification.axes import AxesFit, fit_axes
from gains.identification.regression import AxisFit, AxisModel, fit_axis, lagged
from gains.identification.segment import Segment
from gains.plants.plant import FloatArray
from monitor.fitting.calibrate import SETTLE_S
from monitor.fitting.fit_effects import EffectKind, fit_effects
from monitor.fitting.fitted import FitRequest, Fitted
from monitor.sampling.gate import GateRule
from monitor.vehicles.rover.signals import rover_signals
from monitor.vehicles.rover.transform import DriveInputs

AXES = (
    AxisModel("yaw_rate", "steering", ()),
    AxisModel("forward_acceleration", "throttle", ("speed",), dynamic=False),
)

_CUBED = "steering_cubed"
_MANOEUVRES = {
    "steering": "drive slalom and full-lock turns both ways at several speeds",
    "throttle": "accelerate and brake, ten times",
}
_CURVED_T = 5.0
"""Smallest size of the steering's gain, in standard errors, for which a curve is fitted: the curve is the ratio of two
coefficients, and with a denominator that is uncertain by more than a fifth the ratio has no useful value."""
_STEEPEST = 1.0 / 3.0
"""Largest size of kappa. d/du (u + kappa u^3) = 1 + 3 kappa u^2 is positive up to full deflection if kappa > -1/3: the
turning rate always grows with steering. The same size is the upper bound."""
_SMALLEST_SPEED = 0.05
"""Share of the reference speed below which samples are not used for the curve: its effect is divided by the speed
squared."""


def identify_drive(
    segments: Sequence[Segment], rate_hz: float, inputs: Sequence[str], *, differential: bool = False
) -> AxesFit:
    """Fit the model of the module's docstring.

    Segments are healthy driving in unbroken stretches above the minimum speed: u (steering, throttle, speed, named by
    ``inputs``) as the transform gives it without curve, delays and lags, y = yaw rate (rad/s), forward specific force
    (m/s^2).

    Raises
    ------
    ModelError
        Too little driving, or neither actuator could be learned.
    """
    yaw, outputs = AXES[0], tuple(axis.output for axis in AXES)
    steering, speed = inputs.index("steering"), inputs.index("speed")
    straight = fit_axis(segments, rate_hz, inputs, outputs, yaw)
    cubes = [
        segment.u[:, steering] ** 3 if differential else _cube(segment.u[:, steering], segment.u[:, speed])
        for segment in segments
    ]
    widened = [
        Segment(np.column_stack([s.u, lagged(cube, straight.delay_s, straight.lag_s, rate_hz)]), s.y)
        for s, cube in zip(segments, cubes, strict=True)
    ]
    cubic = AxisModel(yaw.output, yaw.actuator, (_CUBED,))
    kappa = _curve(fit_axis(widened, rate_hz, (*inputs, _CUBED), outputs, cubic))
    curved = [
        Segment(np.column_stack([s.u[:, :steering], s.u[:, steering] + kappa * cube, s.u[:, steering + 1 :]]), s.y)
        for s, cube in zip(segments, cubes, strict=True)
    ]
    return fit_axes(curved, rate_hz, inputs, AXES, _MANOEUVRES, {"steering_cubic": kappa})


def _cube(effect: FloatArray, s: FloatArray) -> FloatArray:
    """Return steering^3 s from steering s; zero if the rover stands."""
    rolls = np.abs(s) > _SMALLEST_SPEED
    return np.where(rolls, effect**3 / np.where(rolls, s, 1.0) ** 2, 0.0)


def _curve(axis: AxisFit) -> float:
    """Return kappa; zero if the drives do not determine it."""
    kappa = float(axis.effects[0]) / axis.b if axis.b and axis.t_value >= _CURVED_T else 0.0
    return min(max(kappa, -_STEEPEST), _STEEPEST)


_NORTH, _EAST = (DriveInputs.signals.index(f"velocity_{axis}") for axis in ("north", "east"))


def _speed(signals: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.hypot(signals[:, _NORTH], signals[:, _EAST]))


_ROVER = EffectKind(
    observer=DriveInputs.kind,
    # The transform divides by the speed: below a sixth of its usual speed a rover turns on the spot, slips or stands.
    slowest=1.0 / 6.0,
    speed=_speed,
    full={"steering": "speed"},
    identify=identify_drive,
    sensors=("gyro_z", "accel_x", "gps_north", "gps_east", "gps_velocity_north", "gps_velocity_east"),
)


def fit_rover(request: FitRequest) -> tuple[Fitted, GateRule]:
    """Identify a rover's steering and throttle on healthy recordings, design the observer, calibrate its alarms.

    Samples are evidence while the rover is armed and not slow.
    """
    gate = GateRule(require_airborne=False, settle_s=SETTLE_S)
    signals, kind = rover_signals(request.surveys), _ROVER
    if "differential" in signals.parameters:
        kind = replace(kind, full={}, identify=partial(identify_drive, differential=True))
    return fit_effects(kind, request, signals, gate)
