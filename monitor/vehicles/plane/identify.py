"""Identify a plane from healthy flights: deflections, scaled by dynamic pressure, to body rates and thrust.

The inputs come scaled and with the measured forces beside them (``SurfaceInputs`` of the adapters), so for every axis

    roll_rate+  = a roll_rate  + b aileron  + damping, coupling with yaw, side force, trim
    pitch_rate+ = a pitch_rate + b elevator + damping, normal force, gravity, trim
    yaw_rate+   = a yaw_rate   + b rudder   + damping, coupling with roll, side force, gravity, trim
    forward_acceleration+ = b throttle + drag with dynamic pressure, and with lift

has constant coefficients at every speed. Gusts act through sideslip and angle of attack, which the accelerometers
feel: taking the measured forces as inputs leaves the gusts out of the residual. Each actuator answers for one axis; a
rudder that is only mixed with the aileron cannot be learned beside it in roll.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from adapters.errors import ModelError
from gains.identification.regression import AxisFit, AxisModel, fit_axis
from gains.identification.segment import Segment
from gains.plants.plant import Disturbance, Fault, Noise, Plant

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
_EXCITED_T = 10.0
_MOVED = 0.005


@dataclass(frozen=True, slots=True)
class Excitation:
    """Whether an actuator was learned well enough to be watched.

    Parameters
    ----------
    actuator : str
        Its channel name.
    excited : bool
        The verdict.
    advice : str
        What was missing and what to fly or drive; empty where nothing was.
    """

    actuator: str
    excited: bool
    advice: str


@dataclass(frozen=True, slots=True)
class SurfacesFit:
    """What the flights say about the plane.

    Parameters
    ----------
    rate_hz : float
        Samples per second of the model.
    inputs : tuple[str, ...]
        Names of u.
    axes : tuple[AxisFit, ...]
        One for each output, in the order of y.
    excitation : tuple[Excitation, ...]
        One for each actuator.
    """

    rate_hz: float
    inputs: tuple[str, ...]
    axes: tuple[AxisFit, ...]
    excitation: tuple[Excitation, ...]

    def parameters(self) -> dict[str, float]:
        """Return the actuators' timing as parameters of the transform."""
        return timing_parameters(self.axes)


def identify_surfaces(segments: Sequence[Segment], rate_hz: float, inputs: Sequence[str]) -> SurfacesFit:
    """Fit the model of the module's docstring.

    Parameters
    ----------
    segments : Sequence[Segment]
        Healthy flight in unbroken stretches: u as the transform gives it without delays and lags, y in the order
        roll, pitch, yaw rate (rad/s), forward specific force (m/s^2).
    rate_hz : float
        Samples per second.
    inputs : Sequence[str]
        Names of the columns of u.

    Raises
    ------
    ModelError
        Too little flight, or no actuator whose effect could be learned.
    """
    outputs = tuple(model.output for model in AXES)
    axes = tuple(fit_axis(segments, rate_hz, inputs, outputs, model) for model in AXES)
    excitation = tuple(excitation_of(axis, _MANOEUVRES[axis.model.actuator]) for axis in axes)
    require_one(excitation)
    return SurfacesFit(rate_hz=rate_hz, inputs=tuple(inputs), axes=axes, excitation=excitation)


def surfaces_plant(fit: SurfacesFit, name: str, fault_rate: float = 2.0) -> Plant:
    """Return the fitted model as a plant with one actuator fault per actuator that was excited.

    The transform behind the plant has to hold :meth:`SurfacesFit.parameters`.

    Parameters
    ----------
    fit : SurfacesFit
        The fitted model.
    name : str
        Name of the plant.
    fault_rate : float
        How fast an effect may be lost, full deflections per second: the bandwidth knob.
    """
    return axes_plant(fit.axes, fit.excitation, fit.inputs, fit.rate_hz, name, fault_rate)


def axes_plant(
    axes: Sequence[AxisFit],
    excitation: Sequence[Excitation],
    inputs: Sequence[str],
    rate_hz: float,
    name: str,
    fault_rate: float,
) -> Plant:
    """Return fitted axes as one discrete plant with y = x.

    The standard error of an actuator's coefficient enters as disturbance, as large as the actuator moved.
    """
    outputs = tuple(axis.model.output for axis in axes)
    B = np.zeros((len(axes), len(inputs)))
    for o, axis in enumerate(axes):
        for effect, value in zip((axis.model.actuator, *axis.model.others), (axis.b, *axis.effects), strict=True):
            B[o, inputs.index(effect)] = value
    identity = np.eye(len(axes))
    doubt = [float(np.hypot(axis.disturbance_std, axis.b_error * axis.moved)) for axis in axes]
    return Plant(
        name=name,
        domain="discrete",
        rate_hz=rate_hz,
        states=outputs,
        inputs=tuple(inputs),
        outputs=outputs,
        A=np.diag([axis.a for axis in axes]),
        B=B,
        c=np.array([axis.c for axis in axes]),
        C=identity,
        faults=tuple(
            Fault(
                name=verdict.actuator,
                kind="actuator",
                rate=fault_rate,
                error=0.01,
                unit="fraction of full deflection",
                input=verdict.actuator,
            )
            for verdict in excitation
            if verdict.excited
        ),
        disturbances=tuple(
            Disturbance(name=f"disturbance_{output}", column=identity[:, o], scale=doubt[o])
            for o, output in enumerate(outputs)
        ),
        # A floor keeps the design from trusting one sample without limit where the fit found no sensor noise.
        noises=tuple(
            Noise(name=f"noise_{axis.model.output}", column=identity[:, o], scale=max(axis.noise_std, 0.3 * doubt[o]))
            for o, axis in enumerate(axes)
        ),
        state_errors=np.array([axis.residual_std for axis in axes]),
    )


def excitation_of(axis: AxisFit, manoeuvre: str) -> Excitation:
    """Return the verdict on one axis: its actuator's gain is known within a tenth."""
    actuator, response = axis.model.actuator, axis.model.output.replace("_", " ")
    if axis.moved < _MOVED:
        return Excitation(actuator, False, f"{actuator} hardly moved: {manoeuvre}")
    if axis.t_value >= _EXCITED_T:
        return Excitation(actuator, True, "")
    return Excitation(
        actuator,
        False,
        f"{response} does not follow {actuator} clearly (t = {axis.t_value:.1f}, {_EXCITED_T:.0f} needed): check that "
        f"this servo output drives it, or {manoeuvre}",
    )


def require_one(excitation: Sequence[Excitation]) -> None:
    """Refuse a fit in which no actuator was learned.

    Raises
    ------
    ModelError
        None of them was; the message says what to do for each.
    """
    if not any(verdict.excited for verdict in excitation):
        raise ModelError("no actuator can be learned: " + "; ".join(verdict.advice for verdict in excitation))


def timing_parameters(axes: Sequence[AxisFit]) -> dict[str, float]:
    """Return delays and lags of the axes' actuators, named as the transforms name them."""
    timing = {}
    for axis in axes:
        timing[f"{axis.model.actuator}_delay_s"] = axis.delay_s
        timing[f"{axis.model.actuator}_lag_s"] = axis.lag_s
    return timing
