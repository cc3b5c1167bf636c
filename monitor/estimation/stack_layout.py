"""The matrices of several observers of one plant as those of a single one, with the past inputs they share kept once.

With z = [c; v; past v; y; 1; g; f] the outputs are [c+; x; f; yt], each observer's parts one after the other. A state
that only hands on what an input was a sample before (v(k-1), v(k-2), ...) is the same for all observers and is kept
once, as past v; the others are the cores c.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gains.synthesis.gains_file import Gains
from monitor.estimation.coasting import StepMap, coasting_maps


class Held(NamedTuple):
    """An input of the past: how many samples ago, and which."""

    delay: int
    source: int


@dataclass(frozen=True, slots=True, eq=False)
class StackLayout:
    """One recursion for K observers."""

    held: tuple[Held, ...]  # what past v holds, by delay
    faults: tuple[int, ...]  # number of faults of each observer
    step: StepMap  # of [c; v; past v; y; 1; g] and, for the arguments, of the same without g
    # of z: the step without measurements and the first one after it, see :mod:`monitor.estimation.coasting`
    coast: StepMap
    resume: StepMap
    initial: NDArray[np.float64]  # c = initial [v; past v; y; 1] at a restart


# Vehicles of one profile share them, as do the replays of a measurement of what a profile detects.
@functools.lru_cache(maxsize=16)
def stack_layout(gains: tuple[Gains, ...]) -> StackLayout:
    """Return the matrices of observers with the same inputs, outputs and states; nobody may change them."""
    first, K = gains[0], len(gains)
    s, p, n = len(first.inputs), len(first.outputs), len(first.states)
    passed_on = [_passed_on(observer) for observer in gains]
    held = tuple(sorted(set[Held]().union(*(states.values() for states in passed_on))))
    own = [
        [i for i in range(_states(observer)) if i not in states]
        for observer, states in zip(gains, passed_on, strict=True)
    ]
    at_c, at_f = _starts([len(core) for core in own]), _starts([len(observer.faults) for observer in gains])
    at_g = _starts([len(observer.nonlinearities) for observer in gains])
    at_nu = _starts([len(observer.argument_matrix) for observer in gains])
    cores, nf = at_c[-1], at_f[-1]
    width = cores + s + len(held) + p + 1
    shape = cores + K * (n + p) + nf, width + at_g[-1] + nf
    maps = [StepMap(np.zeros(shape), np.zeros((at_nu[-1], shape[1]))) for _ in range(3)]
    initial = np.zeros((cores, width - cores))
    v, y = cores + np.arange(s), width - p - 1 + np.arange(p + 1)
    for k, observer in enumerate(gains):
        count, size, a1 = len(observer.faults), _states(observer), observer.fault_kinds.count("actuator")
        zeta, fa, fs = size, size + n + count - a1 + np.arange(a1), size + n + np.arange(count - a1)
        rows = np.concatenate([own[k], zeta + np.arange(n), fa, fs, size + n + count + np.arange(p)]).astype(np.intp)
        f = at_f[k] + np.arange(count)
        c = at_c[k] + np.arange(len(own[k]))
        into = np.concatenate([c, cores + k * n + np.arange(n), cores + K * n + f])
        into = np.concatenate([into, cores + K * n + nf + k * p + np.arange(p)])
        state = np.zeros(size, dtype=np.intp)
        state[own[k]] = c
        for i, past in passed_on[k].items():
            state[i] = cores + s + held.index(past)
        affine = np.concatenate([state, v, y])
        columns = np.concatenate([affine, width + np.arange(at_g[k], at_g[k + 1])])
        known = np.concatenate([columns, width + at_g[-1] + f])
        nu = np.arange(at_nu[k], at_nu[k + 1])
        alone = StepMap(observer.step_matrix, observer.argument_matrix), *coasting_maps(observer)
        for stacked, single in zip(maps, alone, strict=True):
            stacked.step[np.ix_(into, known[: single.step.shape[1]])] = single.step[rows]
            stacked.arguments[np.ix_(nu, known[: single.arguments.shape[1]])] = single.arguments
        initial[np.ix_(c, np.concatenate([v, y]) - cores)] = observer.initial_matrix[own[k]]
    step, coast, resume = maps
    step = StepMap(step.step[:, : width + at_g[-1]], step.arguments[:, :width])
    return StackLayout(held, tuple(len(observer.faults) for observer in gains), step, coast, resume, initial)


def _states(gains: Gains) -> int:
    """Return the number of the observer's own states s."""
    return len(gains.initial_matrix)


def _passed_on(gains: Gains) -> dict[int, Held]:
    """Return the states that hold nothing but an input of the past, also at a restart."""
    size, s = _states(gains), len(gains.inputs)
    passed_on: dict[int, Held] = {}
    sources = {size + j: Held(0, j) for j in range(s)}
    for _ in range(size):
        for i in range(size):
            (columns,) = np.nonzero(gains.step_matrix[i])
            if i in passed_on or len(columns) != 1 or gains.step_matrix[i, columns[0]] != 1.0:
                continue
            newer = sources.get(int(columns[0]))
            if newer is None:
                continue
            past = Held(newer.delay + 1, newer.source)
            start = np.arange(gains.initial_matrix.shape[1]) == past.source
            if past not in passed_on.values() and np.array_equal(gains.initial_matrix[i], start):
                passed_on[i] = sources[i] = past
    return passed_on


def _starts(counts: Sequence[int]) -> list[int]:
    return [0, *np.cumsum(counts, dtype=int).tolist()]
