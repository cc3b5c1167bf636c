"""How far each fault estimate may be off: the covariance of its error, sample by sample.

With the exact observer state S [x; f_a] = [L1 x; f_a], the error delta = s - S [x; f_a] of the recursion of
:mod:`monitor.observer` and the error phi = f^ - f of its fault estimates follow, from the very matrices that run,

    [delta; phi]+ = A [delta; phi] + B w,        w = [w_1; w_2; df_a; df_s] white, each as large as designed for,

with other A and B for a sample that was measured, coasted or resumed (:mod:`monitor.coasting`): disturbances E_1 w_1
and the steps df of the faults, rate / rate_hz each, move the plant away from what the observer carries on, noise
D_1 w_2 enters with each measurement. A sensor fault may do anything while it is measured; while it is not, it is held
to move at its rate too. Then P+ = A P A^T + B B^T. While all is measured P stands at the solution of the Lyapunov
equation P = A P A^T + B B^T and nothing has to be computed; only after a loss or a restart it is stepped until it is
back. Nonlinearities count with their mean slopes.

The scales are those of the design: where they are larger than what a flight shows, so is this.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, solve_discrete_lyapunov

from gains.discretise import discretise
from gains.gains_file import Gains
from gains.plant import Plant
from monitor.bank import owners
from monitor.coasting import StepMap, coasting_maps
from monitor.settling import unseen_states

_BACK = 0.01
_PRIOR_S = 1.0


class Step(IntEnum):
    """What an observer did with a sample."""

    MEASURED = 0
    COASTED = 1
    RESUMED = 2


class _Errors(NamedTuple):
    """A and B B^T of each kind of step, P at rest and after a restart, of one observer; phi are its last entries."""

    A: NDArray[np.float64]
    Q: NDArray[np.float64]
    rest: NDArray[np.float64]
    start: NDArray[np.float64]


class Uncertainty:
    """Standard deviations of the fault estimates of one observer or bank.

    Parameters
    ----------
    gains : Sequence[Gains]
        Its gains.
    plant : Plant | None
        The model they were designed for.
    faults : Sequence[str]
        Names of all fault channels (a,), in the order of the estimates.

    Attributes
    ----------
    sd : NDArray[np.float64]
        One standard deviation of each fault estimate (a,), effect units; a new array whenever it changes. Not a number
        where there is no plant, or the gains are not those of a discrete design.
    """

    def __init__(self, gains: Sequence[Gains], plant: Plant | None, faults: Sequence[str]) -> None:
        self.sd = np.full(len(faults), np.nan)
        self._at_rest = True
        self._coasted = False
        self._known = plant is not None and all(one.L1.size and one.domain == "discrete" for one in gains)
        if plant is None or not self._known:
            return
        owned = owners(gains, faults)
        used = sorted(set(owned))
        found = [_errors(gains[k], discretise(plant, gains[k].rate_hz)) for k in used]
        size = max(len(one.rest) for one in found)
        self._A, self._Q, self._rest, self._start = (
            np.stack([_padded(one[i], size) for one in found]) for i in range(4)
        )
        self._hypothesis = np.array([used.index(k) for k in owned], dtype=np.intp)
        self._entry = np.array(
            [size - len(gains[k].faults) + gains[k].faults.index(name) for name, k in zip(faults, owned, strict=True)],
            dtype=np.intp,
        )
        self._P = self._rest
        self._sd_at_rest = self._read()
        self.sd = self._sd_at_rest

    def restart(self) -> None:
        """Take up the uncertainty of a restart, before its first sample."""
        self._coasted = False
        if self._known:
            self._P, self._at_rest = self._start, False

    def follow(self, measured: bool) -> None:
        """Take what is known of one sample: whether its outputs were measured."""
        if (self._at_rest and measured) or not self._known:
            return
        step = Step.COASTED if not measured else Step.RESUMED if self._coasted else Step.MEASURED
        self._coasted = not measured
        A = self._A[:, step]
        self._P = A @ self._P @ A.swapaxes(1, 2) + self._Q[:, step]
        self.sd = self._read()
        self._at_rest = measured and bool(np.all(np.abs(self.sd - self._sd_at_rest) <= _BACK * self._sd_at_rest))
        if self._at_rest:
            self._P, self.sd = self._rest, self._sd_at_rest

    def _read(self) -> NDArray[np.float64]:
        return np.asarray(np.sqrt(np.maximum(self._P[self._hypothesis, self._entry, self._entry], 0.0)))


def _errors(gains: Gains, plant: Plant) -> _Errors:
    """Return the error system of one observer on a sampled plant, which may have more faults than the observer."""
    n, s, p, a = len(gains.states), len(gains.inputs), len(gains.outputs), len(gains.faults)
    nz, m, a1 = len(gains.L1), len(gains.nonlinearities), gains.fault_kinds.count("actuator")
    nd, ns = nz + len(gains.L_i), len(gains.initial_matrix)
    of_y, of_g = slice(ns + s, ns + s + p), slice(ns + s + p + 1, ns + s + p + 1 + m)
    rows = np.concatenate([np.arange(nd), ns + nz + np.arange(a1), ns + np.arange(n, nz)])
    slopes = block_diag(*(g.slopes.mean(axis=1)[None] for g in plant.nonlinearities))
    disturbed, noisy, moving = _inputs(gains, plant)
    A, Q = np.zeros((2, len(Step), nd + a, nd + a))
    for kind, chosen in zip(Step, (_measured(gains), *coasting_maps(gains)), strict=True):
        M = chosen.step[rows]
        if m:
            M = M + M[:, of_g] @ slopes @ chosen.arguments
        A[kind] = np.hstack([M[:, :nd], M[:, -a:]])
        B = M[:, of_y] @ noisy
        B[:nd] -= disturbed
        if kind is not Step.MEASURED:
            B -= M[:, -a:] @ moving
        Q[kind] = B @ B.T
    start = np.zeros((nd + a, nd + a))
    wrong = gains.L1 @ (unseen_states(gains).T @ (unseen_states(gains) * plant.state_errors))
    start[:nz, :nz] = wrong @ wrong.T
    seen = gains.initial_matrix[:nd, s : s + p] @ noisy
    start[:nd, :nd] += seen @ seen.T
    of_q = np.arange(nz, nz + a1)
    start[of_q, of_q] += (_PRIOR_S * gains.rate_hz * disturbed[of_q].sum(axis=1)) ** 2
    return _Errors(A, Q, solve_discrete_lyapunov(A[Step.MEASURED], Q[Step.MEASURED]), start)


def _inputs(gains: Gains, plant: Plant) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return how w = [w_1; w_2; df_a; df_s] of unit variance moves S [x; f_a], y, and the sensor faults."""
    nz, a1, p = len(gains.L1), gains.fault_kinds.count("actuator"), len(gains.outputs)
    rates = {fault.name: fault.rate for fault in plant.faults}
    steps = np.diag([rates[name] / gains.rate_hz for name in gains.faults])
    E_1 = np.array([w.scale * w.column for w in plant.disturbances]).reshape(-1, len(gains.states)).T
    D_1 = np.array([w.scale * w.column for w in plant.noises]).reshape(-1, p).T
    q1, q2, a = E_1.shape[1], D_1.shape[1], len(steps)
    disturbed, noisy, moving = (np.zeros((k, q1 + q2 + a)) for k in (nz + len(gains.L_i), p, a))
    disturbed[:nz, :q1] = gains.L1 @ E_1
    disturbed[nz : nz + a1, q1 + q2 : q1 + q2 + a1] = steps[:a1, :a1]
    noisy[:, q1 : q1 + q2] = D_1
    moving[a1:, q1 + q2 + a1 :] = steps[a1:, a1:]
    return disturbed, noisy, moving


def _measured(gains: Gains) -> StepMap:
    """Return the plain step over [s; v; y; 1; g; f], of which it does not use f."""
    a, m = len(gains.faults), len(gains.nonlinearities)
    unused = ((0, 0), (0, a))
    return StepMap(np.pad(gains.step_matrix, unused), np.pad(gains.argument_matrix, ((0, 0), (0, m + a))))


def _padded(matrix: NDArray[np.float64], size: int) -> NDArray[np.float64]:
    more = size - matrix.shape[-1]
    return np.pad(matrix, [(0, 0)] * (matrix.ndim - 2) + [(more, 0), (more, 0)])
