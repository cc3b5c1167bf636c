"""Several outputs of a vehicle, each driven by one actuator of its own, identified together as one plant."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from adapters.errors import UntoldError
from gains.identification.regression import AxisFit, AxisModel, fit_axis
from gains.identification.segment import Segment
from gains.plants.plant import Disturbance, Fault, Noise, Plant, on_each

_EXCITED_T = 10.0
"""An actuator is watched if its gain is known within a tenth. Chosen: what is not known of the gain is a loss that
cannot be seen, and enters the reading of the estimates as such (``loss_doubt`` is at least 1/t)."""
_MOVED = 0.005
"""Standard deviation below which an actuator did not move, in full deflections: five steps of a servo's pulse."""
_FAULT_RATE = 2.0
"""Rate at which an effect may be lost, full deflections per second: the bandwidth of the design. Chosen: half a second
to a full loss; a higher rate adds noise to the estimates, a lower one delay."""
_ERROR = 0.01
"""The error of a fault's estimate that counts as one, in full deflections."""
_LEAST_NOISE = 0.3
"""Least measurement noise as a share of the disturbance: it keeps the design from trusting one sample without limit
where the fit found no sensor noise."""


@dataclass(frozen=True, slots=True)
class Excitation:
    """Whether an actuator was identified well enough to be monitored."""

    actuator: str  # its channel name
    excited: bool  # the verdict
    advice: str  # what was missing and what to fly or drive; empty if nothing was


@dataclass(frozen=True, slots=True)
class AxesFit:
    """The result of identifying such a vehicle from recordings."""

    rate_hz: float  # samples per second of the model
    inputs: tuple[str, ...]  # names of u
    axes: tuple[AxisFit, ...]  # one for each output, in the order of y
    excitation: tuple[Excitation, ...]  # one for each axis' actuator
    # parameters of the transform that bend the actuators' effects
    curves: Mapping[str, float] = field(default_factory=dict)

    def parameters(self) -> dict[str, float]:
        """Return the actuators' timing and curves as parameters of the transform, which the plant relies on."""
        timing = {}
        for axis in self.axes:
            timing[f"{axis.model.actuator}_delay_s"] = axis.delay_s
            timing[f"{axis.model.actuator}_lag_s"] = axis.lag_s
        return {**timing, **self.curves}

    def plant(self, name: str) -> Plant:
        """Return the axes as one discrete plant with y = x and one actuator fault per actuator that was excited.

        The standard error of an actuator's coefficient enters as disturbance, as large as the actuator moved.
        """
        outputs = tuple(axis.model.output for axis in self.axes)
        B = np.zeros((len(self.axes), len(self.inputs)))
        for o, axis in enumerate(self.axes):
            for effect, value in zip((axis.model.actuator, *axis.model.others), (axis.b, *axis.effects), strict=True):
                B[o, self.inputs.index(effect)] = value
        doubt = [float(np.hypot(axis.disturbance_std, axis.b_error * axis.moved)) for axis in self.axes]
        noise = [max(axis.noise_std, _LEAST_NOISE * size) for axis, size in zip(self.axes, doubt, strict=True)]
        return Plant(
            name=name,
            domain="discrete",
            rate_hz=self.rate_hz,
            states=outputs,
            inputs=self.inputs,
            outputs=outputs,
            A=np.diag([axis.a for axis in self.axes]),
            B=B,
            c=np.array([axis.c for axis in self.axes]),
            C=np.eye(len(self.axes)),
            faults=tuple(
                Fault(
                    name=verdict.actuator,
                    kind="actuator",
                    rate=_FAULT_RATE,
                    error=_ERROR,
                    unit="fraction of full deflection",
                    input=verdict.actuator,
                )
                for verdict in self.excitation
                if verdict.excited
            ),
            disturbances=on_each(Disturbance, outputs, doubt),
            noises=on_each(Noise, outputs, noise),
            state_errors=np.array([axis.residual_std for axis in self.axes]),
        )


def fit_axes(
    segments: Sequence[Segment],
    rate_hz: float,
    inputs: Sequence[str],
    models: Sequence[AxisModel],
    manoeuvres: Mapping[str, str],
    curves: Mapping[str, float] | None = None,
) -> AxesFit:
    """Identify every output.

    ``segments`` are healthy operation in unbroken stretches, u without the actuators' delays and lags and bent by
    ``curves``, y in the order of ``models``; ``manoeuvres`` say by actuator what to do to excite it.

    Raises
    ------
    ModelError
        Too little of it.
    UntoldError
        No actuator whose effect could be learned; the message says what to do for each.
    """
    outputs = tuple(model.output for model in models)
    axes = tuple(fit_axis(segments, rate_hz, inputs, outputs, model) for model in models)
    excitation = tuple(_excitation(axis, manoeuvres[axis.model.actuator]) for axis in axes)
    if not any(verdict.excited for verdict in excitation):
        raise UntoldError("no actuator can be learned: " + "; ".join(verdict.advice for verdict in excitation))
    return AxesFit(rate_hz, tuple(inputs), axes, excitation, curves or {})


def _excitation(axis: AxisFit, manoeuvre: str) -> Excitation:
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
