"""Simulation of many copies of a plant at once: parameter sets times windows of data, one NumPy step per sample.

Between samples k and k+1 the linear part is exact (matrix exponential); inputs v and nonlinearities g(x) are ramps from
one sample to the next, g(x(k+1)) being taken at a first prediction (exponential time differencing of order 2, Cox and
Matthews 2002). Discrete plants are evaluated as written:

    x+ = Phi x + Gamma_0 v(k) + Gamma_1 v(k+1) + gamma + Lambda_0 g(x(k)) + Lambda_1 g(x(k+1))
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from adapters.errors import ModelError
from gains.plants.discretise import transition
from gains.plants.expression import FUNCTIONS, Node, closure, derivative, parse_expression
from gains.plants.plant import FloatArray, Plant

Hold = Literal["first", "zero"]
Vectorised = Callable[[Sequence[FloatArray]], FloatArray]

_FUNCTIONS: dict[str, Callable[[FloatArray], FloatArray]] = {
    name: getattr(np, {"atan": "arctan"}.get(name, name)) for name in (*FUNCTIONS, "sign")
}
_OPERATORS = {"+": np.add, "-": np.subtract, "*": np.multiply, "/": np.divide, "**": np.power}


@dataclass(frozen=True, slots=True, eq=False)
class Dynamics:
    """A plant's equations at given parameters, in the symbols of :mod:`gains.plants.plant`."""

    rate_hz: float | None  # rate of a discrete plant; None in continuous time
    # (n, n), (n, s), (p, n), (n,), (n, m)
    A: FloatArray
    B: FloatArray
    C: FloatArray
    c: FloatArray
    G: FloatArray
    rows: tuple[FloatArray, ...]  # H_i of the m nonlinearities
    functions: tuple[Vectorised, ...]  # g_i, of the arguments H_i x followed by the parameters
    parameters: FloatArray  # their values (k,)
    curves: FloatArray  # coefficients of u, u^2, ... (s, degree)


def compile_vectorised(node: Node) -> Vectorised:
    """Return an expression as a function of a sequence of arrays that broadcast; NaN if it has no value."""
    function = closure(node, _FUNCTIONS, _OPERATORS)
    return lambda values: np.asarray(function(values), dtype=np.float64)


def linearised(plant: Plant, states: FloatArray) -> Plant:
    """Return the plant linearised at the mean slope of each nonlinearity over states (N, n), in A; G is unchanged."""
    A = plant.A.copy()
    for i, g in enumerate(plant.nonlinearities):
        node = parse_expression(g.expression, g.arguments)
        arguments = list(g.rows @ states.T)
        with np.errstate(all="ignore"):
            slopes = [compile_vectorised(derivative(node, j))(arguments).mean() for j in range(len(arguments))]
        A += np.outer(plant.G[:, i], np.clip(np.nan_to_num(slopes), g.slopes[:, 0], g.slopes[:, 1]) @ g.rows)
    return replace(plant, A=A)


class Stepper:
    """Steps copies of a plant from sample to sample.

    Arrays of states are (P, W, n): P parameter sets, W windows of data.

    Raises
    ------
    ModelError
        A discrete plant has another rate, or the plant grows without bound within a sample.
    """

    def __init__(self, sets: Sequence[Dynamics], rate_hz: float, hold: Hold) -> None:
        first = sets[0]
        if first.rate_hz is not None and first.rate_hz != rate_hz:
            raise ModelError(f"the model is discrete at {first.rate_hz:g} Hz; the samples come at {rate_hz:g} Hz")
        distinct = {id(dynamics): _sampled(dynamics, 1.0 / rate_hz, hold) for dynamics in sets}
        self.C_T = _T(np.stack([dynamics.C for dynamics in sets]))
        self._rows_T = [_T(np.stack([dynamics.rows[i] for dynamics in sets])) for i in range(len(first.rows))]
        self._functions = first.functions
        self._parameters = [column[:, None] for column in np.stack([dynamics.parameters for dynamics in sets]).T]
        self._curves = np.stack([dynamics.curves for dynamics in sets])
        Phi, Gamma_0, Gamma_1, self._gamma, Lambda_0, Lambda_1 = (
            np.stack(parts) for parts in zip(*(distinct[id(dynamics)] for dynamics in sets), strict=True)
        )
        self._Phi_T, self._Gamma_0_T, self._Gamma_1_T = _T(Phi), _T(Gamma_0), _T(Gamma_1)
        self._Lambda_0_T, self._Lambda_1_T = _T(Lambda_0), _T(Lambda_1)
        self._Lambda_T = self._Lambda_0_T + self._Lambda_1_T
        self._looks_ahead = bool(Lambda_1.any())

    def drives(self, u: FloatArray) -> FloatArray:
        """Return the effect of inputs u (W, T, s) and of the offset on the states at each step (T - 1, P, W, n)."""
        powers = u[..., None] ** np.arange(1, self._curves.shape[2] + 1)
        v = np.einsum("wtsd,psd->tpws", powers, self._curves)
        return np.asarray(v[:-1] @ self._Gamma_0_T + v[1:] @ self._Gamma_1_T + self._gamma[:, None, :])

    def step(self, x: FloatArray, drive: FloatArray) -> FloatArray:
        """Return x(k+1) (P, W, n) from x(k) and the effect of the inputs at this step (P, W, n)."""
        base: FloatArray = x @ self._Phi_T + drive
        if not self._functions:
            return base
        g_0 = self.nonlinear(x)
        if not self._looks_ahead:
            return np.asarray(base + g_0 @ self._Lambda_0_T)
        g_1 = self.nonlinear(base + g_0 @ self._Lambda_T)
        return np.asarray(base + g_0 @ self._Lambda_0_T + g_1 @ self._Lambda_1_T)

    def nonlinear(self, x: FloatArray) -> FloatArray:
        """Return g(x) (P, W, m)."""
        values = np.empty((*x.shape[:2], len(self._functions)))
        for i, (function, rows_T) in enumerate(zip(self._functions, self._rows_T, strict=True)):
            nu = x @ rows_T
            values[..., i] = function([*(nu[..., j] for j in range(nu.shape[2])), *self._parameters])
        return values


def _T(matrices: FloatArray) -> FloatArray:
    return np.swapaxes(matrices, -1, -2)


def _sampled(dynamics: Dynamics, h: float, hold: Hold) -> tuple[FloatArray, ...]:
    """Return Phi, Gamma_0, Gamma_1, gamma, Lambda_0, Lambda_1 for a step of h seconds (van Loan 1978)."""
    n, s, m = len(dynamics.A), dynamics.B.shape[1], dynamics.G.shape[1]
    if dynamics.rate_hz is not None:
        return dynamics.A, dynamics.B, np.zeros((n, s)), dynamics.c, dynamics.G, np.zeros((n, m))
    held = np.hstack([dynamics.B, dynamics.c[:, None], dynamics.G])
    Phi, constant, end = np.split(transition(dynamics.A, held, h, "the model", s + 1 + m), [n, n + s + 1 + m], axis=1)
    if hold == "zero":
        end[:, : s + 1] = 0.0
    start = constant - end
    return Phi, start[:, :s], end[:, :s], constant[:, s], start[:, s + 1 :], end[:, s + 1 :]
