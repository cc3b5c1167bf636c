"""Whether recordings determine each parameter of a model, and what to do in a flight that would.

A parameter is determined where its standard error is a small part of its size. Where two can only be told together,
the correlation of their estimates says so.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from gains.identification.free_model import FreeModel, Parameter
from gains.identification.simulation import Dynamics
from gains.plants.plant import FloatArray

_LARGEST_ERROR = 0.25
"""Largest standard error, as a share of the parameter: beyond it zero lies within four errors, and a design by the
value would prove little."""
_TOGETHER = 0.95
"""Largest correlation of two estimates. There the error of each is 3.2 times (1 / sqrt(1 - .95^2)) what it is with the
other known."""
_AT_BOUND = 1e-3
"""Distance from a bound, as a share of the parameter's size, that counts as at the bound: the solver stops within 1e-7
of it."""
_STEP = 1e-4
"""Relative change of a parameter that shows which entries depend on it; every such entry then differs in many
digits."""


@dataclass(frozen=True, slots=True)
class ExcitationVerdict:
    """The verdict on one parameter."""

    name: str
    # its estimate and how far that may be off, in its own unit
    value: float
    standard_error: float
    determined: bool  # whether the recordings determine it
    note: str  # what is wrong and what would help; empty if nothing is


def excitation_verdicts(
    model: FreeModel, theta: FloatArray, covariance: FloatArray, movement: Mapping[str, float]
) -> tuple[ExcitationVerdict, ...]:
    """Return a verdict on each free parameter.

    An estimate (k,) has infinite variance where no prediction depends on it; ``movement`` is the standard deviation of
    each input and state in the recordings, by name.
    """
    errors = np.sqrt(np.diag(covariance))
    verdicts = []
    for j, parameter in enumerate(model.parameters):
        value, error = float(theta[j]), float(errors[j])
        determined = bool(error <= _LARGEST_ERROR * max(abs(value), parameter.size))
        together = [] if determined else _partners(covariance, errors, j, model.parameters)
        note = ""
        driving = _driving(model.dynamics, theta, j, model)
        still = bool(driving) and all(movement.get(name, 0.0) == 0.0 for name in driving)
        if not np.isfinite(error) and not still:
            note = "no measured output depends on it: give it a number, or measure what it acts on"
        elif together:
            note = (
                f"the data determine it only in combination with {', '.join(together)}: give one of them a number, or "
                + _advice(driving, movement)
            )
        elif not determined:
            note = _advice(driving, movement)
        elif min(value - parameter.low, parameter.high - value) <= _AT_BOUND * parameter.size:
            note = "it ends at its bound: widen 'min' and 'max' if that is physical, else the model lacks something"
        verdicts.append(ExcitationVerdict(parameter.name, value, error, determined, note))
    return tuple(verdicts)


def _partners(covariance: FloatArray, errors: FloatArray, j: int, parameters: Sequence[Parameter]) -> list[str]:
    if not np.isfinite(errors[j]):
        return []
    finite = [i for i in range(len(errors)) if i != j and np.isfinite(errors[i]) and errors[i] > 0.0]
    return [
        f"'{parameters[i].name}'" for i in finite if abs(covariance[i, j]) > _TOGETHER * float(errors[i] * errors[j])
    ]


def _advice(driving: Sequence[str], movement: Mapping[str, float]) -> str:
    if not driving:
        return "record different steady conditions: it is a constant drive"
    moved = ", ".join(f"{name} (standard deviation {movement.get(name, 0.0):.3g})" for name in driving)
    return f"record manoeuvres that move {moved} more, and not always in step with each other"


def _driving(dynamics: Callable[[FloatArray], Dynamics], theta: FloatArray, j: int, model: FreeModel) -> list[str]:
    """Return the states and inputs that the parameter multiplies."""
    states, inputs = model.example.states, model.example.inputs
    step = np.zeros(len(theta))
    step[j] = _STEP * max(abs(float(theta[j])), model.parameters[j].size)
    a, b = dynamics(theta), dynamics(theta + step)
    touched = (a.A != b.A).any(axis=0) | (a.C != b.C).any(axis=0)
    for i, (before, after) in enumerate(zip(a.rows, b.rows, strict=True)):
        named = model.parameters[j].name in model.words_of(i)  # its own expression names it
        if (a.G[:, i] != b.G[:, i]).any() or (before != after).any() or named:
            touched |= (after != 0.0).any(axis=0)
    driven = (a.B != b.B).any(axis=0) | (a.curves != b.curves).any(axis=1)
    return [states[i] for i in np.flatnonzero(touched)] + [inputs[i] for i in np.flatnonzero(driven)]
