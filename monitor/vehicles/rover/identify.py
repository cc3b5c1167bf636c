"""Identify a rover from healthy drives: steering times speed to yaw rate, throttle to forward specific force.

    yaw_rate+             = a yaw_rate + b (steering + kappa steering^3) s + c        s = forward speed / reference
    forward_acceleration+ = b throttle + b_v s + c

Specific force, not speed, answers the throttle: a slope slows a rover down without being felt by its accelerometer.
kappa is the curvature of turning rate over steering (linkage, tyres); it belongs to the transform.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gains.identification.regression import AxisFit, AxisModel, fit_axis, lagged
from gains.identification.segment import Segment
from gains.plants.plant import FloatArray, Plant
from monitor.vehicles.plane.identify import Excitation, axes_plant, excitation_of, require_one, timing_parameters

YAW = AxisModel("yaw_rate", "steering", ())
FORWARD = AxisModel("forward_acceleration", "throttle", ("speed",), dynamic=False)

_CUBED = "steering_cubed"
_MANOEUVRES = {
    "steering": "drive slalom and full-lock turns both ways at several speeds",
    "throttle": "accelerate and brake, ten times",
}
_CURVED_T = 5.0
_FLATTEST = -1.0 / 3.0
_SMALLEST_SPEED = 0.05


@dataclass(frozen=True, slots=True)
class DriveFit:
    """What the drives say about the rover.

    Parameters
    ----------
    rate_hz : float
        Samples per second of the model.
    inputs : tuple[str, ...]
        Names of u.
    axes : tuple[AxisFit, ...]
        Yaw rate and forward specific force.
    excitation : tuple[Excitation, ...]
        Steering and throttle.
    steering_cubic : float
        kappa.
    """

    rate_hz: float
    inputs: tuple[str, ...]
    axes: tuple[AxisFit, ...]
    excitation: tuple[Excitation, ...]
    steering_cubic: float

    def parameters(self) -> dict[str, float]:
        """Return the actuators' timing and the steering's curve as parameters of the transform."""
        return {**timing_parameters(self.axes), "steering_cubic": self.steering_cubic}


def identify_drive(segments: Sequence[Segment], rate_hz: float, inputs: Sequence[str]) -> DriveFit:
    """Fit the model of the module's docstring.

    Parameters
    ----------
    segments : Sequence[Segment]
        Healthy driving in unbroken stretches above the minimum speed: u as the transform gives it without curve,
        delays and lags, y = yaw rate (rad/s), forward specific force (m/s^2).
    rate_hz : float
        Samples per second.
    inputs : Sequence[str]
        Names of the columns of u: steering, throttle, speed.

    Raises
    ------
    ModelError
        Too little driving, or neither actuator could be learned.
    """
    names, outputs = (*inputs, _CUBED), (YAW.output, FORWARD.output)
    steering, speed = inputs.index("steering"), inputs.index("speed")
    straight = fit_axis(segments, rate_hz, inputs, outputs, YAW)
    cubes = [_cube(segment.u[:, steering], segment.u[:, speed]) for segment in segments]
    widened = [
        Segment(np.column_stack([s.u, lagged(cube, straight.delay_s, straight.lag_s, rate_hz)]), s.y)
        for s, cube in zip(segments, cubes, strict=True)
    ]
    kappa = _curve(fit_axis(widened, rate_hz, names, outputs, AxisModel(YAW.output, YAW.actuator, (_CUBED,))))
    curved = [
        Segment(np.column_stack([s.u[:, :steering], s.u[:, steering] + kappa * cube, s.u[:, steering + 1 :]]), s.y)
        for s, cube in zip(segments, cubes, strict=True)
    ]
    axes = tuple(fit_axis(curved, rate_hz, inputs, outputs, model) for model in (YAW, FORWARD))
    excitation = tuple(excitation_of(axis, _MANOEUVRES[axis.model.actuator]) for axis in axes)
    require_one(excitation)
    return DriveFit(rate_hz, tuple(inputs), axes, excitation, kappa)


def drive_plant(fit: DriveFit, name: str, fault_rate: float = 2.0) -> Plant:
    """Return the fitted model as a plant with one actuator fault per actuator that was excited.

    Parameters
    ----------
    fit : DriveFit
        The fitted model; the transform behind the plant has to hold its :meth:`DriveFit.parameters`.
    name : str
        Name of the plant.
    fault_rate : float
        How fast an effect may be lost, full deflections per second: the bandwidth knob.
    """
    return axes_plant(fit.axes, fit.excitation, fit.inputs, fit.rate_hz, name, fault_rate)


def _cube(effect: FloatArray, s: FloatArray) -> FloatArray:
    """Return steering^3 s from steering s, zero where the rover stands."""
    rolls = np.abs(s) > _SMALLEST_SPEED
    return np.where(rolls, effect**3 / np.where(rolls, s, 1.0) ** 2, 0.0)


def _curve(axis: AxisFit) -> float:
    """Return kappa, zero where the drives do not show it; turning rate always grows with steering."""
    kappa = float(axis.effects[0]) / axis.b if axis.b and axis.t_value >= _CURVED_T else 0.0
    return min(max(kappa, _FLATTEST), -_FLATTEST)
