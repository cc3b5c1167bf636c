"""Observers of one plant under several hypotheses as one affine map with scalar nonlinearities.

Every design compiles offline to the same recursion (symbols of the theory; v = curve(u) is the known static input
nonlinearity, past v are part of the state s and carry motor lag and transport delay):

    nu = argument_matrix [s; v; y; 1]                     arguments of the nonlinearities, from x^
    [s+; zeta^; fa^; yt] = step_matrix [s; v; y; 1; g(nu)],      s = [eta; q; v(k-1); ...]

A row without measurements is the same product with another matrix (:mod:`monitor.estimation.coasting`), and so is the
first one after it. Stacked, the observers of a bank are one such map, whose zeros cost nothing, and the past inputs
they share are kept once. With z = [c; v; past v; y; 1; g; d; f] the outputs are [c+; x; f; yt], each observer's parts
one after the other. A state that only hands on what an input was a sample before (v(k-1), v(k-2), ...) is the same for
all observers and is kept once, as past v; the others are the cores c.

Where effects bend (:attr:`gains.plants.plant.Plant.bends`), those that a fault f has changed bend otherwise: each
observer adds d = bend(v + f) - bend(v) to the known inputs, f from the sample before. Without it a motor that had lost
a fifth seemed to be two in flights with more throttle than hover: a fault's column of B is exact at hover alone. The
proofs of gains leave d out; it is at most the bend of the effect that the fault takes away.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gains.analysis.riccati import doubled
from gains.plants.expression import compile_expression
from gains.plants.plant import Plant
from gains.synthesis.gains_file import Gains
from monitor.core.observers import AffineMap
from monitor.estimation.coasting import StepMap, coasting_maps
from monitor.estimation.observer import ErrorSystem, FaultSet, ObserverRun


class Held(NamedTuple):
    """A past input: its age in samples, and its number."""

    delay: int
    source: int


@dataclass(frozen=True, slots=True, eq=False)
class StackLayout:
    """One recursion for K observers."""

    held: tuple[Held, ...]  # the inputs in past v, by delay
    faults: tuple[int, ...]  # number of faults of each observer
    step: StepMap  # of [c; v; past v; y; 1; g; d] and, for the arguments, of the same without g
    # of z: the step without measurements and the first one after it, see :mod:`monitor.estimation.coasting`
    coast: StepMap
    resume: StepMap
    initial: NDArray[np.float64]  # c = initial [v; past v; y; 1] at a restart


# Observers of one profile share them, as do the replays that measure which faults a profile detects.
@functools.lru_cache(maxsize=16)
def stack_layout(gains: tuple[Gains, ...]) -> StackLayout:
    """Return the matrices of observers with the same inputs, outputs and states; nobody may change them."""
    first, K = gains[0], len(gains)
    s, p, n = first.known, len(first.outputs), len(first.states)
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
    e = s - len(first.inputs)
    sources = np.array([*range(s), *(past.source for past in held)])
    estimates = width + at_g[-1] + K * e
    shape = cores + K * (n + p) + nf, estimates + nf
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
        known = np.concatenate([columns, estimates + f])
        nu = np.arange(at_nu[k], at_nu[k + 1])
        alone = StepMap(observer.step_matrix, observer.argument_matrix), *coasting_maps(observer)
        for stacked, single in zip(maps, alone, strict=True):
            stacked.step[np.ix_(into, known[: single.step.shape[1]])] = single.step[rows]
            stacked.arguments[np.ix_(nu, known[: single.arguments.shape[1]])] = single.arguments
            for r in range(e):  # d drives the states as r does that lasted (the taps sum to 1)
                acting = cores + np.flatnonzero(sources == s - e + r)
                stacked.step[c, width + at_g[-1] + k * e + r] = stacked.step[np.ix_(c, acting)].sum(axis=1)
        initial[np.ix_(c, np.concatenate([v, y]) - cores)] = observer.initial_matrix[own[k]]
    step, coast, resume = maps
    step = StepMap(step.step[:, :estimates], step.arguments[:, :width])
    return StackLayout(held, tuple(len(observer.faults) for observer in gains), step, coast, resume, initial)


def _states(gains: Gains) -> int:
    """Return the number of the observer's own states s."""
    return len(gains.initial_matrix)


def _passed_on(gains: Gains) -> dict[int, Held]:
    """Return the states that hold nothing but a past input, also at a restart."""
    size, s = _states(gains), gains.known
    passed_on: dict[int, Held] = {}
    sources = {size + j: Held(0, j) for j in range(s)}
    into = gains.step_matrix[:size]
    copies = np.flatnonzero(((into != 0.0).sum(axis=1) == 1) & ((into == 1.0).sum(axis=1) == 1))
    copied = dict(zip(copies.tolist(), into[copies].argmax(axis=1).tolist(), strict=True))
    for _ in copied:
        for i, source in copied.items():
            newer = sources.get(source)
            if i in passed_on or newer is None:
                continue
            past = Held(newer.delay + 1, newer.source)
            start = np.arange(gains.initial_matrix.shape[1]) == past.source
            if past not in passed_on.values() and np.array_equal(gains.initial_matrix[i], start):
                passed_on[i] = sources[i] = past
    return passed_on


def _starts(counts: Sequence[int]) -> list[int]:
    return [0, *np.cumsum(counts, dtype=int).tolist()]


_FORGOTTEN = 0.05
"""Share of its largest error below which a fault estimate has forgotten a wrong start. Chosen: a smaller share waits
longer after each restart, a larger one may show a wrong start as a fault."""
_NEGLIGIBLE = 1e-9
"""Singular values and errors, relative to the largest and to effects near 1, below which there is only rounding."""
_LONGEST_S = 60.0
"""Longest wait, seconds. Chosen: a longer wait would leave little of a flight to watch."""

_BLOCK = 64
"""Steps that are computed at once. Measured on the arm at 250 Hz: 3 ms with 64 to 256, 6.6 with 16, 70 with one."""


# Shared as the results of :func:`stack_layout`; each bank has several gains.
@functools.lru_cache(maxsize=64)
def settling_s(gains: Gains) -> float:
    """Return the time after which a wrong start moves no fault estimate by more than a twentieth of its largest error.

    In seconds, at most a minute. A restart computes the states from the outputs, x = C^+ y; the part of x that the
    outputs do not show starts at zero, whatever the vehicle does. Two copies of one observer fed with the same (u, y)
    differ by d(k) = M_ss^k d(0), so the compiled step alone gives the errors of the fault estimates after a start that
    is wrong by d(0) = [L1; L_q] x, C x = 0. An observer all of whose states are measured has nothing to forget, however
    slow its poles. Gains of another structure than :mod:`gains.analysis.augment` count as zero: nothing tells which of
    their states the outputs show.
    """
    n, a = len(gains.states), len(gains.faults)
    if not gains.L1.size or not a:
        return 0.0
    unseen = unseen_states(gains)
    if not len(unseen):
        return 0.0
    ns = len(gains.initial_matrix)
    M_ss, M_fs = gains.step_matrix[:ns, :ns], gains.step_matrix[ns + n : ns + n + a, :ns]
    d = np.zeros((ns, len(unseen)))
    d[: len(_into(gains))] = _into(gains) @ unseen.T
    steps, rows = round(_LONGEST_S * gains.rate_hz), [M_fs]
    for _ in range(_BLOCK - 1):
        rows.append(rows[-1] @ M_ss)
    seen, leap, errors = np.stack(rows), np.linalg.matrix_power(M_ss, _BLOCK), []
    for _ in range(0, steps, _BLOCK):
        errors.append(np.abs(seen @ d).max(axis=2))
        d = leap @ d
    series = np.concatenate(errors)[:steps]
    largest = series.max(axis=0)
    off = np.any((series > _FORGOTTEN * largest) & (largest > _NEGLIGIBLE), axis=1)
    return float(np.flatnonzero(off)[-1] + 1) / gains.rate_hz if off.any() else 0.0


def _into(gains: Gains) -> NDArray[np.float64]:
    """Return [L1; L_q] (nz + nq, n), which maps x to the observer's own states."""
    return np.vstack([gains.L1, gains.L_q if gains.L_q.size else np.zeros((len(gains.L_i), gains.L1.shape[1]))])


def unseen_states(gains: Gains) -> NDArray[np.float64]:
    """Return orthonormal directions of the states that the outputs do not show, as rows (k, n).

    They are the null space of C, and so of F C = [I; 0] - L1, which the gains hold.
    """
    _, sizes, Vt = np.linalg.svd(np.eye(*gains.L1.shape) - gains.L1)
    return np.asarray(Vt[int(np.sum(sizes > _NEGLIGIBLE * sizes[0])) :])


_MEASURED = 0
"""Index of the system in which all outputs are measured."""
_PRIOR_S = 1.0
"""Time for which an actuator fault that existed before a restart counts as having grown at its rate, seconds. Chosen: a
longer time makes estimates after a restart more uncertain, and for longer."""


@functools.lru_cache(maxsize=64)
def error_system(gains: Gains, plant: Plant) -> ErrorSystem:
    """Return the error system of one observer on a sampled plant, which may have more faults than the observer.

    It says how far the estimates may be off, from the very matrices that run.

    With the exact observer state S [x; f_a] = [L1 x; f_a + L_q x], the error delta = s - S [x; f_a] of the recursion
    and the error phi = f^ - f of its fault estimates follow

        [delta; phi]+ = A [delta; phi] + B w,        w = [w_1; w_2; df_a; df_s] white, each as large as designed for,

    with other A and B for a sample that was measured, coasted or resumed (:mod:`monitor.estimation.coasting`):
    disturbances E_1 w_1 and the steps df of the faults, rate / rate_hz each, move the plant away from what the observer
    carries on, noise D_1 w_2 enters with each measurement. A sensor fault may do anything while it is measured; while
    it is not, it is held to move at its rate too. Nonlinearities count with their mean slopes.
    """
    n, s, p, a = len(gains.states), gains.known, len(gains.outputs), len(gains.faults)
    nz, m, a1 = len(gains.L1), len(gains.nonlinearities), gains.fault_kinds.count("actuator")
    nd, ns = nz + len(gains.L_i), len(gains.initial_matrix)
    of_y, of_g = slice(ns + s, ns + s + p), slice(ns + s + p + 1, ns + s + p + 1 + m)
    rows = np.concatenate([np.arange(nd), ns + nz + np.arange(a1), ns + np.arange(n, nz)])
    arguments = np.array([len(g.slopes) for g in plant.nonlinearities], np.intp)
    means = np.array([slope for g in plant.nonlinearities for slope in g.slopes.mean(axis=1)])
    slopes = np.repeat(np.eye(m), arguments, axis=1) * means
    disturbed, noisy, moving = _inputs(gains, plant)
    A, Q = np.zeros((2, 3, nd + a, nd + a))
    for kind, chosen in enumerate((_measured(gains), *coasting_maps(gains))):
        M = chosen.step[rows]
        if m:
            M = M + M[:, of_g] @ slopes @ chosen.arguments
        A[kind] = np.hstack([M[:, :nd], M[:, -a:]])
        B = M[:, of_y] @ noisy
        B[:nd] -= disturbed
        if kind != _MEASURED:
            B -= M[:, -a:] @ moving
        Q[kind] = B @ B.T
    start = np.zeros((nd + a, nd + a))
    wrong = _into(gains) @ (unseen_states(gains).T @ (unseen_states(gains) * plant.state_errors))
    start[:nd, :nd] = wrong @ wrong.T
    seen = gains.initial_matrix[:nd, s : s + p] @ noisy
    start[:nd, :nd] += seen @ seen.T
    of_q = np.arange(nz, nz + a1)
    rates = {fault.name: fault.rate for fault in plant.faults}
    start[of_q, of_q] += [(_PRIOR_S * rates[name]) ** 2 for name in gains.faults[:a1]]
    of_all = A[_MEASURED]
    # A unit step of a fault of the plant takes 1 from its delta; sum_k -phi(k) / rate_hz of what follows is its delay.
    lag_s = np.zeros(a)
    lag_s[:a1] = np.diag(np.linalg.inv(np.eye(nd + a) - of_all)[nd : nd + a1, of_q]) / gains.rate_hz
    return ErrorSystem(A, Q, doubled(of_all.T, np.zeros_like(of_all), Q[_MEASURED]), start, lag_s)


def _inputs(gains: Gains, plant: Plant) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return how w = [w_1; w_2; df_a; df_s] of unit variance moves S [x; f_a], y, and the sensor faults."""
    nz, a1, p = len(gains.L1), gains.fault_kinds.count("actuator"), len(gains.outputs)
    rates = {fault.name: fault.rate for fault in plant.faults}
    steps = np.diag([rates[name] / gains.rate_hz for name in gains.faults])
    E_1 = np.array([w.scale * w.column for w in plant.disturbances]).reshape(-1, len(gains.states)).T
    D_1 = np.array([w.scale * w.column for w in plant.noises]).reshape(-1, p).T
    q1, q2, a = E_1.shape[1], D_1.shape[1], len(steps)
    disturbed, noisy, moving = (np.zeros((k, q1 + q2 + a)) for k in (nz + len(gains.L_i), p, a))
    disturbed[:, :q1] = _into(gains) @ E_1
    disturbed[nz : nz + a1, q1 + q2 : q1 + q2 + a1] = steps[:a1, :a1]
    noisy[:, q1 : q1 + q2] = D_1
    moving[:, q1 + q2 :] = steps
    return disturbed, noisy, moving


def _measured(gains: Gains) -> StepMap:
    """Return the plain step over [s; v; y; 1; g; f]; it does not use f."""
    a, m = len(gains.faults), len(gains.nonlinearities)
    unused = ((0, 0), (0, a))
    return StepMap(np.pad(gains.step_matrix, unused), np.pad(gains.argument_matrix, ((0, 0), (0, m + a))))


class AffineObserver:
    """Compiled gains as an :class:`monitor.estimation.observer.Observer`: one observer, or all observers of a bank.

    Those of a bank have the same inputs, outputs and states.
    """

    def __init__(self, gains: Sequence[Gains]) -> None:
        self.gains = tuple(gains)
        first, layout = gains[0], stack_layout(self.gains)
        self.rate_hz = first.rate_hz
        self.hypotheses = tuple(
            FaultSet(single.faults, tuple(source is not None for source in single.fault_inputs)) for single in gains
        )
        nonlinearities = [g for single in gains for g in single.nonlinearities]
        s = first.known
        entry = {(0, j): j for j in range(s)} | {held: s + i for i, held in enumerate(layout.held)}
        lagged = np.zeros((s, layout.initial.shape[1]))
        for (delay, j), at in entry.items():
            if delay < len(first.input_taps):
                lagged[j, at] = first.input_taps[delay]
        self._map = AffineMap(
            maps=(layout.step, layout.coast, layout.resume),
            initial=layout.initial,
            curves=first.input_curves,
            bends=first.input_bends,
            lagged=lagged[: len(first.inputs)],
            newer=np.array([entry[delay - 1, j] for delay, j in layout.held], np.intp),
            source=np.array([j for _, j in layout.held], np.intp),
            functions=[compile_expression(g.expression, g.arguments) for g in nonlinearities],
            spans=np.cumsum([0, *(len(g.arguments) for g in nonlinearities)]),
            owner=np.repeat(np.arange(len(gains)), layout.faults),
            scaled=np.array([-1 if source is None else source for single in gains for source in single.fault_inputs]),
            observers=len(gains),
            states=len(first.states),
            outputs=len(first.outputs),
        )

    def run(
        self,
        u: NDArray[np.float64],
        y: NDArray[np.float64],
        measured: NDArray[np.bool_] | None = None,
        restart: NDArray[np.bool_] | None = None,
    ) -> ObserverRun:
        """Process N rows; see :meth:`monitor.estimation.observer.Observer.run`."""
        if measured is None:
            measured = np.ones(len(u), np.bool_)
        if restart is None:
            restart = np.zeros(len(u), np.bool_)
        return ObserverRun(*self._map.run(u, y, measured, restart))

    def error_systems(self, plant: Plant) -> tuple[ErrorSystem, ...] | None:
        """Return the error system of each hypothesis, None if the gains do not come from a discrete design."""
        if not all(single.L1.size and single.domain == "discrete" for single in self.gains):
            return None
        return tuple(error_system(single, plant) for single in self.gains)

    def settling_s(self) -> float:
        """Return the time after which a wrong start has no effect on fault estimates any more, seconds."""
        return max(settling_s(single) for single in self.gains)
