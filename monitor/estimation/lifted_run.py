"""Whole arrays through an observer in plain NumPy: cyclic reduction of its recursion, iteration of what is not linear.

With e_k what drives the state at sample k,

    s_{k+1} = A s_k + e_k     gives     s_{k+2} = A^2 s_k + (A e_k + e_{k+1}),

the same recursion for every other sample, half as long. Halved again and again it is a few products of whole
matrices, and so is the way back, s_{k+1} = A s_k + e_k for the samples left out: O(N ns^2) in all. Nothing is ever
computed from a later sample, so what is not a number spreads as it does step by step. Powers of A that magnify
rounding are not used: there the halving ends and the samples that are left are stepped through.

Nonlinearities are iterated (Picard, or waveform, iteration): nu of a whole block from the g before, g from that nu,
until nu no longer changes by more than rounding. nu_k depends on earlier g alone, so each pass settles one more
sample for good at the least, and as a rule the block in a few; what has settled is kept, and the rest starts anew in
a shorter block.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gains.plants.postfix import evaluate
from monitor.estimation.recursion import Recursion

_LONGEST, _SHORTEST = 4096, 16
_MOST_PASSES = 24
_FEW_PASSES = 12
_LEAST_ROWS = 8
_ROUNDING = 64.0 * np.finfo(np.float64).eps
"""Changes of nu below this share of what it is summed from are rounding."""

_MOST_GROWTH = 1e4
"""How many times larger than A its powers may be: by as much they magnify rounding."""

Array = NDArray[np.float64]


class LiftedRun:
    """State of one observer that runs block by block.

    Parameters
    ----------
    recursion : Recursion
        Its matrices.

    Attributes
    ----------
    state : NDArray[np.float64]
        s before the next sample (ns,); set it to start anywhere.
    """

    def __init__(self, recursion: Recursion) -> None:
        ns, nw, step = recursion.ns, recursion.nw, recursion.step
        self._recursion = recursion
        self._A_T, self._B_T, self._G_T = (
            np.ascontiguousarray(part.T) for part in np.split(step[:ns], [ns, ns + nw], axis=1)
        )
        self._estimates_T = np.ascontiguousarray(step[ns:].T)
        self._H_s_T, self._H_w_T = (
            np.ascontiguousarray(part.T) for part in np.split(recursion.arguments, [ns], axis=1)
        )
        self._powers = _powers(self._A_T)
        self._length = _LONGEST
        self.state = np.zeros(ns)

    def advance(self, v: Array, y: Array, out: Array) -> None:
        """Take N samples, v (N, s) and y (N, p), and write the estimates into ``out`` (N, n + a + p)."""
        ns, nw, s = self._recursion.ns, self._recursion.nw, v.shape[1]
        z = np.empty((min(len(v), _LONGEST), self._recursion.step.shape[1]))
        done = 0
        with np.errstate(all="ignore"):
            while done < len(v):
                block = z[: min(len(v) - done, self._length)]
                rows = slice(done, done + len(block))
                block[:, ns : ns + s] = v[rows]
                block[:, ns + s : ns + nw - 1] = y[rows]
                block[:, ns + nw - 1] = 1.0
                settled = self._run(block)
                np.matmul(block[:settled], self._estimates_T, out=out[done : done + settled])
                done += settled

    def _run(self, z: Array) -> int:
        """Fill s and g of z = [s; w; g] (L, ns + nw + m) and move on; return how many samples have settled."""
        ns, nw = self._recursion.ns, self._recursion.nw
        driven = z[:, ns : ns + nw] @ self._B_T
        settled = len(z)
        if self._recursion.nonlinearities:
            settled = self._settle(z, driven)
            driven += z[:, ns + nw :] @ self._G_T
        else:
            z[:, :ns] = _states(self._powers, self.state, driven)
        self.state = z[settled - 1, :ns] @ self._A_T + driven[settled - 1]
        return settled

    def _settle(self, z: Array, driven: Array) -> int:
        ns, nw = self._recursion.ns, self._recursion.nw
        w, g = z[:, ns : ns + nw], z[:, ns + nw :]
        known = w @ self._H_w_T
        nu = self._states_into(z, driven) @ self._H_s_T + known
        terms = (np.abs(z[:, :ns]) + np.abs(driven)) @ np.abs(self._H_s_T) + np.abs(w) @ np.abs(self._H_w_T)
        terms[~np.isfinite(terms)] = 0.0
        rounding = _ROUNDING * np.maximum.accumulate(terms, axis=0)
        settled = 0
        for passes in range(1, _MOST_PASSES + 1):
            self._evaluate(nu, g)
            before, nu = nu, self._states_into(z, driven + g @ self._G_T) @ self._H_s_T + known
            same = np.abs(nu - before) <= rounding
            if not same.all():
                same |= (nu == before) | (np.isnan(nu) & np.isnan(before))
            if same.all():
                if passes <= _FEW_PASSES:
                    self._length = min(_LONGEST, 2 * self._length)
                return len(z)
            settled = int(np.argmin(same.all(axis=1)))
        self._length = max(_SHORTEST, self._length // 2)
        # The state at the first sample that has not settled rests on settled ones, and so does its g.
        self._evaluate(nu, g)
        return settled + 1

    def _states_into(self, z: Array, driven: Array) -> Array:
        states = _states(self._powers, self.state, driven)
        z[:, : self._recursion.ns] = states
        return states

    def _evaluate(self, nu: Array, g: Array) -> None:
        columns = nu.T
        for i, (program, span) in enumerate(zip(self._recursion.nonlinearities, self._recursion.spans, strict=True)):
            g[:, i] = evaluate(program, list(columns[span]))


def _powers(A_T: Array) -> list[Array]:
    """Return [A^T; I] for A, A^2, A^4 ... (2 ns, ns) as far as they may be used, and blocks can need them."""
    powers, largest = [A_T], _MOST_GROWTH * max(1.0, float(np.abs(A_T).max(initial=0.0)))
    while _LEAST_ROWS << len(powers) <= _LONGEST:
        with np.errstate(all="ignore"):
            power = powers[-1] @ powers[-1]
        if not np.abs(power).max(initial=0.0) <= largest:
            break
        powers.append(power)
    return [np.vstack([power, np.eye(len(A_T))]) for power in powers]


def _states(powers: list[Array], start: Array, driven: Array) -> Array:
    """Return s_0 = start, s_1, ... s_{L-1} (L, ns) with s_{k+1} = A s_k + driven_k."""
    count = len(driven)
    halvings = min(len(powers) - 1, max(0, (count // _LEAST_ROWS).bit_length() - 1))
    missing = -count % (1 << halvings)
    if missing:
        driven = np.concatenate([driven, np.zeros((missing, len(start)))])
    return _halved(powers[: halvings + 1], start, driven)[:count]


def _halved(powers: list[Array], start: Array, driven: Array) -> Array:
    (count, ns), A_T = driven.shape, powers[0][: len(start)]
    if len(powers) == 1:
        states = np.empty((count, ns))
        states[0] = start
        for k in range(count - 1):
            np.dot(states[k], A_T, out=states[k + 1])
            states[k + 1] += driven[k]
        return states
    pairs = np.empty((count // 2, 2 * ns))
    pairs[:, :ns] = _halved(powers[1:], start, driven.reshape(-1, 2 * ns) @ powers[0])
    np.matmul(pairs[:, :ns], A_T, out=pairs[:, ns:])
    pairs[:, ns:] += driven[::2]
    return pairs.reshape(count, ns)
