"""Observers of one plant under several hypotheses, stepped together as one affine map.

The recursions of :mod:`monitor.estimation.observer` share what comes in, w = [v; v(k-1); ...; v(k-L); y; 1]. Stacked,
with the cores c of their states (:mod:`monitor.estimation.stack_layout`), they are

    c+ = A c + B w + ...,       [x_1^; ...; x_K^; f_1^; ...; f_K^; yt_1; ...; yt_K] = C c + D w + ...,

the dots being what nonlinearities add. [B; D] w and C c are products for each sample by itself: over a stretch of
samples they are taken at once, only c+ waits for the sample before. Both ways are the same products of the same shapes,
added in the same order, and so give the same bits.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gains.plants.expression import compile_expression
from gains.synthesis.gains_file import Gains
from monitor.estimation.coasting import StepMap
from monitor.estimation.input_curve import effect_of_command
from monitor.estimation.stack_layout import stack_layout


class StackRun(NamedTuple):
    """Estimates over N samples: x (N, K, n), fault (N, sum of a_k) and residual (N, K, p)."""

    x: NDArray[np.float64]
    fault: NDArray[np.float64]
    residual: NDArray[np.float64]


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
        first, layout = gains[0], stack_layout(gains)
        s, p, cores, past = len(first.inputs), len(first.outputs), layout.cores, len(layout.held)
        M, width = layout.step.step, cores + s + past + p + 1
        m, faults = M.shape[1] - width, sum(layout.faults)
        self._A, self._C = M[:cores, :cores].copy(), M[cores:, :cores].copy()
        self._forcing, self._G = M[:, cores:width].copy(), M[:, width:].copy()
        self._arguments, self._initial = layout.step.arguments, layout.initial
        self._coast, self._resume = layout.coast, layout.resume
        self._coasted = False
        nonlinearities = [g for one in gains for g in one.nonlinearities]
        self._g = [compile_expression(g.expression, g.arguments) for g in nonlinearities]
        self._g_spans = _slices([len(g.arguments) for g in nonlinearities])
        self._curves = first.input_curves
        self._held = layout.held
        place = {(0, j): j for j in range(s)} | {held: s + i for i, held in enumerate(layout.held)}
        self._newer = np.array([place[delay - 1, j] for delay, j in layout.held], dtype=np.intp)
        self._source = np.array([j for _, j in layout.held], dtype=np.intp)
        self._z, self._out = np.zeros(width + m + faults), np.zeros(len(M))
        self._core, self._w = self._z[:cores], self._z[cores:width]
        self._v, self._past, self._y = self._w[:s], self._w[s : s + past], self._w[s + past : -1]
        self._w[-1] = 1.0
        self._affine, self._nonlinear, self._before = self._z[:width], self._z[width : width + m], self._z[width + m :]
        self._nu = np.zeros(len(self._arguments))
        self._next, self._given = self._out[:cores], self._out[cores:]
        self._forced = np.zeros(len(M))
        self._forced_core, self._forced_given = self._forced[:cores], self._forced[cores:]
        self._shape = len(gains), len(first.states), p
        self.x, self.fault, self.residual = (part[0] for part in self._parts(self._given[None]))
        self.spans = _slices(layout.faults)

    def restart(self, u: NDArray[np.float64], y: NDArray[np.float64]) -> None:
        """Forget the past: start at the states that (u, y) explain without a fault."""
        self._v[:] = effect_of_command(self._curves, u)
        self._past[:] = self._v[self._source]
        self._y[:] = y
        np.dot(self._initial, self._w, out=self._core)
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
        np.dot(self._forcing, self._w, out=self._forced)
        if self._g:
            np.dot(self._arguments, self._affine, out=self._nu)
            self._evaluate()
            self._forced += np.dot(self._G, self._nonlinear)
        np.dot(self._C, self._core, out=self._given)
        np.add(self._given, self._forced_given, out=self._given)
        np.dot(self._A, self._core, out=self._next)
        np.add(self._next, self._forced_core, out=self._core)
        self._age()

    def coast(self, u: NDArray[np.float64]) -> None:
        """Advance by one sample without measurements, u (s,): by the model alone, each with its own hypothesis."""
        self._v[:] = effect_of_command(self._curves, u)
        self._coasted = True
        self._take(self._coast)

    def run(self, u: NDArray[np.float64], y: NDArray[np.float64]) -> StackRun:
        """Step through N samples, u (N, s) and y (N, p): to the bits and the state of so many steps."""
        count = len(u)
        given = np.empty((count, len(self._given)))
        alone = count if self._g else min(count, int(self._coasted))
        for k in range(alone):
            self.step(u[k], y[k])
            given[k] = self._given
        if alone < count:
            self._run(u[alone:], y[alone:], given[alone:])
        return self._parts(given)

    def coasted(self, u: NDArray[np.float64]) -> StackRun:
        """Advance by N samples without measurements, u (N, s)."""
        given = np.empty((len(u), len(self._given)))
        for k in range(len(u)):
            self.coast(u[k])
            given[k] = self._given
        return self._parts(given)

    def _run(self, u: NDArray[np.float64], y: NDArray[np.float64], given: NDArray[np.float64]) -> None:
        count, cores = len(u), len(self._core)
        w = np.empty((count, len(self._w)))
        v, past = w[:, : len(self._v)], w[:, len(self._v) : len(self._v) + len(self._past)]
        v[:] = effect_of_command(self._curves, u)
        w[:, -1 - len(self._y) : -1] = y
        w[:, -1] = 1.0
        for column, before, newer in zip(past.T, self._past, self._newer, strict=True):
            column[0] = before
            column[1:] = w[:-1, newer]
        forced = _products(self._forcing, w)
        core = np.empty((count + 1, cores))
        core[0] = self._core
        A, dot, add = self._A, np.dot, np.add
        for now, force, following in zip(core[:-1], forced[:, :cores], core[1:], strict=True):
            dot(A, now, out=following)
            add(following, force, out=following)
        np.add(_products(self._C, core[:-1]), forced[:, cores:], out=given)
        self._w[:] = w[-1]
        self._core[:] = core[-1]
        self._age()
        self._given[:] = given[-1]

    def _take(self, chosen: StepMap) -> None:
        self._before[:] = self.fault
        if self._g:
            np.dot(chosen.arguments, self._z, out=self._nu)
            self._evaluate()
        np.dot(chosen.step, self._z, out=self._out)
        self._core[:] = self._next
        self._age()

    def _age(self) -> None:
        if len(self._past):
            self._past[:] = self._w[self._newer]

    def _evaluate(self) -> None:
        for i, (g, span) in enumerate(zip(self._g, self._g_spans, strict=True)):
            self._nonlinear[i] = g(*self._nu[span].tolist())

    def _parts(self, given: NDArray[np.float64]) -> StackRun:
        """Return views of x, fault and residual in rows of outputs."""
        (K, n, p), count = self._shape, len(given)
        x, fault, residual = np.split(given, [K * n, given.shape[1] - K * p], axis=1)
        return StackRun(x.reshape(count, K, n), fault, residual.reshape(count, K, p))


def _products(matrix: NDArray[np.float64], rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the product of a matrix with each row, by one call of BLAS for each: that of ``np.dot`` with one row."""
    return np.asarray(np.matmul(matrix, rows[:, :, None])[:, :, 0])


def _slices(counts: Sequence[int]) -> tuple[slice, ...]:
    return tuple(slice(start, stop) for start, stop in pairwise([0, *np.cumsum(counts, dtype=int).tolist()]))
