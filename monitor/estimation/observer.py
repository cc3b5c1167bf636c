"""The observer as one affine map with scalar nonlinearities, stepped sample by sample.

Every design compiles offline to the same recursion (symbols of the theory; v = curve(u) is the known static
input nonlinearity, past v are part of the state s and carry motor lag and transport delay):

    nu = argument_matrix [s; v; y; 1]                     arguments of the nonlinearities, from x^
    [s+; zeta^; fa^; yt] = step_matrix [s; v; y; 1; g(nu)],      s = [eta; q; v(k-1); ...]

so a step is one small matrix product, and nothing is allocated in it. A run over arrays calls the same product
in the same order and therefore gives the same bits. A sample without measurements is one product with another matrix
(:mod:`monitor.estimation.coasting`), and so is the first one after it.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gains.plants.expression import compile_expression
from gains.synthesis.gains_file import Gains
from monitor.estimation.coasting import StepMap, coasting_maps
from monitor.estimation.input_curve import curve_columns, effect_into


class ObserverRun(NamedTuple):
    """Estimates over N samples: x (N, n), fault (N, a1 + a2) and residual (N, p)."""

    x: NDArray[np.float64]
    fault: NDArray[np.float64]
    residual: NDArray[np.float64]


class Observer:
    """State of one running observer.

    After :meth:`step`, the attributes ``x`` (n,), ``fault`` (a1 + a2,) = [fa^; fs^] in the effect units of the
    plant model and ``residual`` (p,) = yt are views that the next step overwrites.

    Parameters
    ----------
    gains : Gains
        Compiled gains.
    """

    def __init__(self, gains: Gains) -> None:
        self.gains = gains
        s, p = len(gains.inputs), len(gains.outputs)
        n = len(gains.states)
        a1 = sum(kind == "actuator" for kind in gains.fault_kinds)
        nz = n + len(gains.faults) - a1
        total = gains.step_matrix.shape[0]
        ns = total - nz - a1 - p
        m = gains.step_matrix.shape[1] - ns - s - p - 1
        # Methods of the matrices: the same products as np.dot, without its search for other kinds of array.
        self._step = np.ascontiguousarray(gains.step_matrix).dot
        self._arguments = np.ascontiguousarray(gains.argument_matrix).dot
        self._initial = np.ascontiguousarray(gains.initial_matrix)
        self._g = [compile_expression(item.expression, item.arguments) for item in gains.nonlinearities]
        ends = np.cumsum([0, *(len(g.arguments) for g in gains.nonlinearities)]).tolist()
        self._spans = tuple(slice(start, stop) for start, stop in pairwise(ends))
        self._coast, self._resume = coasting_maps(gains)
        self._coasted = False
        self._z = np.zeros(ns + s + p + 1 + m + len(gains.faults))
        self._z[ns + s + p] = 1.0
        self._state = self._z[:ns]
        self._v = self._z[ns : ns + s]
        self._y = self._z[ns + s : ns + s + p]
        self._affine = self._z[: ns + s + p + 1]
        self._measured = self._z[ns : ns + s + p + 1]
        self._fed = self._z[: ns + s + p + 1 + m]
        self._nonlinear = self._z[ns + s + p + 1 : ns + s + p + 1 + m]
        self._out = np.zeros(total)
        self._next = self._out[:ns]
        self._nu = np.zeros(len(gains.argument_matrix))
        self._curves = curve_columns(gains.input_curves)
        self.x = self._out[ns : ns + n]
        self._fs = self._out[ns + n : ns + nz]
        self._fa = self._out[ns + nz : ns + nz + a1]
        self.residual = self._out[ns + nz + a1 :]
        self.fault = self._z[ns + s + p + 1 + m :]
        self._fault_a, self._fault_s = self.fault[:a1], self.fault[a1:]

    def restart(self, u: NDArray[np.float64], y: NDArray[np.float64]) -> None:
        """Forget the past: start at the state that (u, y) explain without a fault."""
        effect_into(self._curves, u, self._v)
        self._y[:] = y
        np.dot(self._initial, self._measured, out=self._state)
        self.fault[:] = 0.0
        self._coasted = False

    def step(self, u: NDArray[np.float64], y: NDArray[np.float64]) -> None:
        """Advance by one sample: u (s,) and y (p,) in the order of the gains file."""
        effect_into(self._curves, u, self._v)
        self._y[:] = y
        if self._coasted:
            self._coasted = False
            self._take(self._resume)
            return
        if self._g:
            self._arguments(self._affine, self._nu)
            self._evaluate()
        self._step(self._fed, self._out)
        self._advance()

    def coast(self, u: NDArray[np.float64]) -> None:
        """Advance by one sample without measurements, u (s,): by the model alone."""
        effect_into(self._curves, u, self._v)
        self._coasted = True
        self._take(self._coast)

    def _take(self, chosen: StepMap) -> None:
        if self._g:
            np.dot(chosen.arguments, self._z, out=self._nu)
            self._evaluate()
        np.dot(chosen.step, self._z, out=self._out)
        self._advance()

    def _evaluate(self) -> None:
        nu = self._nu.tolist()
        for i, (g, span) in enumerate(zip(self._g, self._spans, strict=True)):
            self._nonlinear[i] = g(*nu[span])

    def _advance(self) -> None:
        self._state[:] = self._next
        self._fault_a[:] = self._fa
        self._fault_s[:] = self._fs

    def run(self, u: NDArray[np.float64], y: NDArray[np.float64]) -> ObserverRun:
        """Restart at the first sample and step through all: u (N, s), y (N, p)."""
        count = len(u)
        result = ObserverRun(
            np.empty((count, len(self.x))), np.empty((count, len(self.fault))), np.empty((count, y.shape[1]))
        )
        if count:
            self.restart(u[0], y[0])
        for k in range(count):
            self.step(u[k], y[k])
            result.x[k] = self.x
            result.fault[k] = self.fault
            result.residual[k] = self.residual
        return result
