"""Observers of one plant under several hypotheses, stepped together as one affine map.

The recursions of :mod:`monitor.observer` share (v, y); stacked they are one larger product,

    [s_1+; ...; s_K+; (zeta_k^; fa_k^; yt_k)...] = M [s_1; ...; s_K; v; y; 1; g_1; ...; g_K],

which costs far less than K small ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from gains.expression import compile_expression
from gains.gains_file import Gains
from monitor.coasting import StepMap, coasting_maps
from monitor.input_curve import effect_of_command


class ObserverStack:
    """State of K running observers with the same inputs, outputs and states.

    Parameters
    ----------
    gains : Sequence[Gains]
        Their gains.

    Attributes
    ----------
    x : NDArray[np.float64]
        State estimates (K, n).
    residual : NDArray[np.float64]
        yt of each (K, p).
    fault : NDArray[np.float64]
        [fa^; fs^] of each, one after the other (sum of a_k,).
    spans : tuple[slice, ...]
        Where each observer's faults stand in ``fault``.
    """

    def __init__(self, gains: Sequence[Gains]) -> None:
        first, K = gains[0], len(gains)
        s, p, n = len(first.inputs), len(first.outputs), len(first.states)
        faults = [len(one.faults) for one in gains]
        sizes = [one.step_matrix.shape[0] - n - count - p for one, count in zip(gains, faults, strict=True)]
        count_g = [one.step_matrix.shape[1] - size - s - p - 1 for one, size in zip(gains, sizes, strict=True)]
        at_s, at_f, at_g = _starts(sizes), _starts(faults), _starts(count_g)
        ns, nf, m = at_s[-1], at_f[-1], at_g[-1]
        M = np.zeros((ns + K * n + nf + K * p, ns + s + p + 1 + m))
        at_nu = _starts([len(one.argument_matrix) for one in gains])
        wide = (len(M), M.shape[1] + nf), (at_nu[-1], M.shape[1] + nf)
        around = [StepMap(np.zeros(wide[0]), np.zeros(wide[1])) for _ in range(2)]
        arguments, initial = [], np.zeros((ns, s + p + 1))
        for k, one in enumerate(gains):
            a1 = sum(kind == "actuator" for kind in one.fault_kinds)
            fs = np.arange(faults[k] - a1)
            zeta, fa = sizes[k], sizes[k] + n + len(fs)
            rows = np.concatenate([np.arange(zeta), zeta + np.arange(n), fa + np.arange(a1), zeta + n + fs])
            rows = np.concatenate([rows, fa + a1 + np.arange(p)])
            into = [np.arange(at_s[k], at_s[k + 1]), ns + k * n + np.arange(n)]
            into += [ns + K * n + np.arange(at_f[k], at_f[k + 1]), ns + K * n + nf + k * p + np.arange(p)]
            shared = np.arange(ns, ns + s + p + 1)
            columns = np.concatenate(
                [np.arange(at_s[k], at_s[k + 1]), shared, ns + s + p + 1 + np.arange(*at_g[k : k + 2])]
            )
            M[np.ix_(np.concatenate(into), columns)] = one.step_matrix[rows]
            known = np.concatenate([columns, M.shape[1] + np.arange(at_f[k], at_f[k + 1])])
            for stacked, alone in zip(around, coasting_maps(one), strict=True):
                stacked.step[np.ix_(np.concatenate(into), known)] = alone.step[rows]
                stacked.arguments[at_nu[k] : at_nu[k + 1], known] = alone.arguments
            H = np.zeros((len(one.argument_matrix), ns + s + p + 1))
            H[:, columns[: sizes[k] + s + p + 1]] = one.argument_matrix
            arguments.append(H)
            initial[at_s[k] : at_s[k + 1]] = one.initial_matrix
        nonlinearities = [g for one in gains for g in one.nonlinearities]
        self._M, self._arguments, self._initial = M, np.vstack(arguments), initial
        self._coast, self._resume = around
        self._coasted = False
        self._g = [compile_expression(g.expression, g.arguments) for g in nonlinearities]
        self._g_spans = _slices(_starts([len(g.arguments) for g in nonlinearities]))
        self._curves = first.input_curves
        self._z, self._out = np.zeros(M.shape[1] + nf), np.zeros(M.shape[0])
        self._z[ns + s + p] = 1.0
        self._state, self._v, self._y = self._z[:ns], self._z[ns : ns + s], self._z[ns + s : ns + s + p]
        self._affine, self._measured = self._z[: ns + s + p + 1], self._z[ns : ns + s + p + 1]
        self._fed = self._z[: M.shape[1]]
        self._nonlinear, self._before = self._fed[ns + s + p + 1 :], self._z[M.shape[1] :]
        self._nu = np.zeros(len(self._arguments))
        self._next = self._out[:ns]
        self.x = self._out[ns : ns + K * n].reshape(K, n)
        self.fault = self._out[ns + K * n : ns + K * n + nf]
        self.residual = self._out[ns + K * n + nf :].reshape(K, p)
        self.spans = _slices(at_f)

    def restart(self, u: NDArray[np.float64], y: NDArray[np.float64]) -> None:
        """Forget the past: start at the states that (u, y) explain without a fault."""
        self._v[:] = effect_of_command(self._curves, u)
        self._y[:] = y
        np.dot(self._initial, self._measured, out=self._state)
        self.fault[:] = 0.0
        self._coasted = False

    def step(self, u: NDArray[np.float64], y: NDArray[np.float64]) -> None:
        """Advance by one sample: u (s,) and y (p,) in the order of the gains files."""
        self._v[:] = effect_of_command(self._curves, u)
        self._y[:] = y
        if self._coasted:
            self._coasted = False
            self._take(self._resume)
            return
        if self._g:
            np.dot(self._arguments, self._affine, out=self._nu)
            self._evaluate()
        np.dot(self._M, self._fed, out=self._out)
        self._state[:] = self._next

    def coast(self, u: NDArray[np.float64]) -> None:
        """Advance by one sample without measurements, u (s,): by the model alone, each with its own hypothesis."""
        self._v[:] = effect_of_command(self._curves, u)
        self._coasted = True
        self._take(self._coast)

    def _take(self, chosen: StepMap) -> None:
        self._before[:] = self.fault
        if self._g:
            np.dot(chosen.arguments, self._z, out=self._nu)
            self._evaluate()
        np.dot(chosen.step, self._z, out=self._out)
        self._state[:] = self._next

    def _evaluate(self) -> None:
        for i, (g, span) in enumerate(zip(self._g, self._g_spans, strict=True)):
            self._nonlinear[i] = g(*self._nu[span].tolist())


def _starts(counts: Sequence[int]) -> list[int]:
    return [0, *np.cumsum(counts, dtype=int).tolist()]


def _slices(starts: Sequence[int]) -> tuple[slice, ...]:
    return tuple(slice(start, stop) for start, stop in pairwise(starts))
