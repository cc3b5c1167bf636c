"""How far each fault estimate may be off: the covariance of its error, sample by sample.

With the exact observer state S [x; f_a] = [L1 x; f_a], the error delta = s - S [x; f_a] of the recursion of
:mod:`monitor.estimation.observer` and the error phi = f^ - f of its fault estimates follow, from the very matrices
that run,

    [delta; phi]+ = A [delta; phi] + B w,        w = [w_1; w_2; df_a; df_s] white, each as large as designed for,

with other A and B for a sample that was measured, coasted or resumed (:mod:`monitor.estimation.coasting`): disturbances
E_1 w_1 and the steps df of the faults, rate / rate_hz each, move the plant away from what the observer carries on,
noise D_1 w_2 enters with each measurement. A sensor fault may do anything while it is measured; while it is not, it is
held to move at its rate too. Then P+ = A P A^T + B B^T. While all is measured P stands at the solution of the Lyapunov
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

from gains.plants.discretise import discretise
from gains.plants.plant import Plant
from gains.synthesis.gains_file import Gains
from monitor.estimation.bank import owners
from monitor.estimation.coasting import StepMap, coasting_maps
from monitor.estimation.settling import unseen_states

_BACK = 0.01
_PRIOR_S = 1.0
_LONGEST_COURSE = 10_000
_AHEAD = 64
"""Steps taken before it is looked at whether one of them came back to rest."""


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
        # A stretch steps from a restart to rest once: sd after each sample so far, P after the last, how many samples
        # of it are behind, and how many of them P has not been taken through.
        self._course = np.empty((0, len(faults)))
        self._course_end = self._start
        self._along: int | None = None
        self._behind = 0

    def restart(self) -> None:
        """Take up the uncertainty of a restart, before its first sample."""
        self._coasted = False
        if self._known:
            self._P, self._at_rest = self._start, False
            self._along, self._behind = None, 0

    def follow(self, measured: bool) -> None:
        """Take what is known of one sample: whether its outputs were measured."""
        if (self._at_rest and measured) or not self._known:
            return
        if self._along is not None:
            self._catch_up()
        step = Step.COASTED if not measured else Step.RESUMED if self._coasted else Step.MEASURED
        self._coasted = not measured
        A = self._A[:, step]
        self._P = A @ self._P @ A.swapaxes(1, 2) + self._Q[:, step]
        self.sd = self._read()
        self._at_rest = measured and bool(np.all(self._is_back(self.sd)))
        if self._at_rest:
            self._P, self.sd = self._rest, self._sd_at_rest

    def run(self, measured: NDArray[np.bool_], restart: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Take a stretch of samples as :meth:`restart` and :meth:`follow` do; a test holds them together to the bit.

        Parameters
        ----------
        measured : NDArray[np.bool_]
            What :meth:`follow` is told of each sample (n,).
        restart : NDArray[np.bool_]
            Whether it is restarted before that (n,).

        Returns
        -------
        NDArray[np.float64]
            ``sd`` after each sample (n, a).
        """
        found = np.empty((len(measured), len(self.sd)))
        if not self._known:
            found[:] = self.sd
            return found
        eventful = np.flatnonzero(restart | ~measured)
        row = 0
        while row < len(measured):
            if restart[row]:
                self.restart()
                self._along = 0
            following = int(np.searchsorted(eventful, row, side="right"))
            end = int(eventful[following]) if following < len(eventful) else len(measured)
            if not measured[row] or self._coasted:
                self.follow(bool(measured[row]))
                found[row] = self.sd
                row += 1
            elif self._at_rest:
                found[row:end] = self.sd
                row = end
            else:
                steps = self._settle(min(end - row, _AHEAD))
                found[row : row + len(steps)] = steps
                row += len(steps)
        return found

    def _settle(self, count: int) -> NDArray[np.float64]:
        """Take measured samples until at rest, ``count`` at most; return ``sd`` after each of one or more of them."""
        if self._along is None:
            return self._steps(count)
        found = self._course[self._along : self._along + count]
        if len(found):
            self.sd = found[-1]
            self._behind += len(found)
        else:
            found = self._steps(count)
            self._course, self._course_end = np.concatenate([self._course, found]), self._P
        self._along += len(found)
        if self._along == len(self._course):
            self._P, self._behind = self._course_end, 0
            self._at_rest = self._P is self._rest
            if self._at_rest or self._along >= _LONGEST_COURSE:
                self._along = None
        return found

    def _catch_up(self) -> None:
        """Step P through the samples for which the course was known."""
        for _ in range(self._behind):
            self._P = self._measured_step()
        self._behind, self._along = 0, None

    def _measured_step(self) -> NDArray[np.float64]:
        A = self._A[:, Step.MEASURED]
        return np.asarray(A @ self._P @ A.swapaxes(1, 2) + self._Q[:, Step.MEASURED])

    def _steps(self, count: int) -> NDArray[np.float64]:
        entries = []
        for _ in range(count):
            self._P = self._measured_step()
            entries.append(self._P[self._hypothesis, self._entry, self._entry])
        found = np.sqrt(np.maximum(np.stack(entries), 0.0))
        back = np.flatnonzero(np.all(self._is_back(found), axis=1))
        self._at_rest = len(back) > 0
        if self._at_rest:
            found = found[: back[0] + 1]
            found[-1] = self._sd_at_rest
            self._P = self._rest
        self.sd = self._sd_at_rest if self._at_rest else found[-1].copy()
        return found

    def _is_back(self, sd: NDArray[np.float64]) -> NDArray[np.bool_]:
        return np.asarray(np.abs(sd - self._sd_at_rest) <= _BACK * self._sd_at_rest)

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
