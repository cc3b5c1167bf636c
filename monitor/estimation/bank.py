"""A bank at run time: one observer for each hypothesis; the smallest residual that explains the data names the faults.

Observer k is designed for the faults of hypothesis k alone. With r_k its smoothed residual and S_k the covariance of
that residual in healthy flight,

    J_k = r_k' S_k^-1 r_k

stays about p while the hypothesis is right and grows with what it leaves unexplained (structured residuals). A
hypothesis explains the data as long as J_k <= max(score_floor^2, tolerance^2 max_i J_i): what healthy flight shows, or
what model error makes of a fault that large. Of those that do, the ones with fewest faults are preferred, and among
them the smallest J. To J is added gain_penalty, or what model error makes of a fault that large, for an actuator that
would have to deliver more than commanded: actuators fail towards less, and two of opposite effect are told apart by
little else. The one believed so far stays until another is clearly better, so noise does not make names flicker. Where
none explains the data nobody is held responsible, and the score sqrt(min J) says how much is left.

A hypothesis of a sensor fault that would explain anything (a gyro bias against the motors) may be set apart: it takes
no part in the comparison, and its fault is evidence where its estimate has an edge (:mod:`monitor.estimation.edge`).

A fault whose estimate is washed out is given back (:mod:`monitor.estimation.washout`), and while it stands by that
memory its hypothesis is not left for another that explains the data as well.

All observers run all the time and none is ever reset by another's verdict: when a fault has gone, its residuals return
to their healthy size by themselves and the bank is armed for the next one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from adapters.sample import Samples
from gains.synthesis.gains_file import Gains
from monitor.estimation.edge import EdgeDetector
from monitor.estimation.estimator_run import EstimatorRun, empty_run, pieces
from monitor.estimation.isolation_rule import BankRule
from monitor.estimation.observer_stack import ObserverStack
from monitor.estimation.smoothing import smooth
from monitor.estimation.washout import Unwash

_HEALTHY = 3.5
"""J / p up to which a hypothesis with an edge is believed: one healthy sample in a thousand has more, for p = 4."""

_RANK_TOLERANCE = 1e-6
_LOYALTY = 2.0
"""How many times smaller another hypothesis' J has to be before it replaces the one believed so far."""


class Bank:
    """The observers of a bank and the hypothesis believed at present.

    Parameters
    ----------
    gains : Sequence[Gains]
        Gains of each hypothesis, in the order of the rule.
    rule : BankRule
        Isolation part of the profile.
    faults : Sequence[str]
        Names of all fault channels (a,), in the order of the estimates.
    thresholds : Mapping[str, float]
        Alarm thresholds by channel: edges smaller than theirs are not held, washed-out faults smaller not given back.

    Attributes
    ----------
    fault : NDArray[np.float64]
        Each fault as estimated under its smallest hypothesis (a,).
    evidence : NDArray[np.float64]
        Smoothed estimates of the faults of the hypothesis believed (a,), edges that are held, zero for all others.
    speaks : NDArray[np.bool_]
        Channels whose evidence counts (a,): not those of the comparison where no hypothesis explains the data.
    J : NDArray[np.float64]
        What each hypothesis leaves unexplained (number of hypotheses,).
    unexplained : float
        Score sqrt(min J) where no hypothesis explains the data, else zero.
    believed : int
        Index of the hypothesis believed.
    """

    def __init__(
        self, gains: Sequence[Gains], rule: BankRule, faults: Sequence[str], thresholds: Mapping[str, float]
    ) -> None:
        self._stack = ObserverStack(gains)
        self._places = [np.array([faults.index(name) for name in one.faults], dtype=np.intp) for one in gains]
        sizes = np.array([len(one.faults) for one in gains])
        compared = ~np.array(rule.edges)
        self._groups = [np.flatnonzero((sizes == size) & compared) for size in np.unique(sizes[compared])]
        self._compared = np.flatnonzero(compared)
        self._owned = np.array(
            [
                self._stack.spans[k].start + gains[k].faults.index(name)
                for name, k in zip(faults, owners(gains, faults), strict=True)
            ]
        )
        p, rate_hz = len(gains[0].outputs), gains[0].rate_hz
        self._whitening = whitening(rule.covariances)
        self._keep = float(np.exp(-1.0 / (rule.smoothing_s * rate_hz))) if rule.smoothing_s > 0 else 0.0
        self._floor = rule.score_floor**2
        self._share = rule.tolerance**2
        self._penalty = rule.gain_penalty
        self._scaling = np.array([source is not None for one in gains for source in one.fault_inputs])
        self._first = np.array([span.start for span in self._stack.spans])
        self._smoothed = np.zeros(len(gains) * p + len(self._stack.fault))
        self._residuals = self._smoothed[: len(gains) * p].reshape(len(gains), p)
        self._faults = self._smoothed[len(gains) * p :]
        self._edges = [
            (k, int(self._places[k][0]), EdgeDetector(rate_hz, _HEALTHY * p, thresholds.get(one.faults[0])))
            for k, one in enumerate(gains)
            if rule.edges[k]
        ]
        self._washed = [
            (faults.index(name), Unwash(tau, rate_hz, thresholds[name]), thresholds[name])
            for name, tau in rule.washouts.items()
            if thresholds.get(name, 0.0) > 0.0
        ]
        common = set[int]().union(*map(set, self._places)).intersection(*(set(self._places[k]) for k in self._compared))
        self._own = [frozenset(places.tolist()) - common for places in self._places]
        self._keepers = np.array([[place in own for own in self._own] for place, _, _ in self._washed], dtype=np.bool_)
        self._standing: set[int] = set()
        self._comparison = np.ones(len(faults), dtype=np.bool_)
        self._comparison[[place for _, place, _ in self._edges]] = False
        self.speaks = np.ones(len(faults), dtype=np.bool_)
        self.fault = np.zeros(len(faults))
        self.evidence = np.zeros(len(faults))
        self.J = np.zeros(len(gains))
        self.unexplained = 0.0
        self.believed = int(self._groups[0][0])

    @property
    def smoothed(self) -> NDArray[np.float64]:
        """Smoothed estimate of each fault under its smallest hypothesis (a,), whichever is believed."""
        return np.asarray(self._faults[self._owned])

    @property
    def x(self) -> NDArray[np.float64]:
        """State estimate of the hypothesis believed (n,)."""
        return np.asarray(self._stack.x[self.believed])

    @property
    def residual(self) -> NDArray[np.float64]:
        """Residual of the hypothesis believed (p,), not smoothed."""
        return np.asarray(self._stack.residual[self.believed])

    def restart(self, u: NDArray[np.float64], y: NDArray[np.float64]) -> None:
        """Forget the past: start all observers at the state that (u, y) explain without a fault."""
        self._stack.restart(u, y)
        for _, _, detector in self._edges:
            detector.restart()
        for _, unwash, _ in self._washed:
            unwash.restart()
        self._standing.clear()
        self._residuals[:] = 0.0
        self._faults[:] = 0.0

    def step(self, u: NDArray[np.float64], y: NDArray[np.float64], complete: bool = True) -> None:
        """Advance all observers by one sample, u (s,) and y (p,), and choose the hypothesis to believe.

        ``complete`` says whether the sample was measured, and not bridged across lost measurements.
        """
        stack, keep = self._stack, self._keep
        stack.step(u, y)
        self._residuals *= keep
        self._residuals += (1.0 - keep) * stack.residual
        self._faults *= keep
        self._faults += (1.0 - keep) * stack.fault
        white = np.matmul(self._whitening, self._residuals[:, :, None])[:, :, 0]
        self.J = np.vecdot(white, white)
        self._choose()
        np.take(stack.fault, self._owned, out=self.fault)
        self.evidence[:] = 0.0
        if not self.unexplained:
            self.evidence[self._places[self.believed]] = self._faults[stack.spans[self.believed]]
        self._give_back()
        self.speaks[self._comparison] = not self.unexplained
        for k, place, detector in self._edges:
            self.evidence[place] = detector.update(float(stack.fault[stack.spans[k].start]), float(self.J[k]), complete)
            if detector.held and self.J[k] <= self._floor:
                self.unexplained = 0.0

    def coast(self, u: NDArray[np.float64]) -> None:
        """Advance all observers by one sample without measurements, u (s,): what is believed stands."""
        self._stack.coast(u)
        np.take(self._stack.fault, self._owned, out=self.fault)

    def run(self, samples: Samples) -> EstimatorRun:
        """Take N samples; return what the attributes hold after each, to the bits of taking them one by one.

        A test holds the two together.
        """
        run = empty_run(len(samples), self._stack.x.shape[1], self._residuals.shape[1], len(self.fault))
        for piece in pieces(samples):
            rows, part = slice(piece.start, piece.stop), run.part(piece.start, piece.stop)
            if piece.restart:
                self.restart(samples.u[piece.start], samples.y[piece.start])
            if piece.measured:
                self._steps(samples.u[rows], samples.y[rows], samples.complete[rows], part)
            else:
                found = self._stack.coasted(samples.u[rows])
                part.x[:], part.residual[:] = found.x[:, self.believed], found.residual[:, self.believed]
                part.fault[:], part.evidence[:] = found.fault[:, self._owned], self.evidence
                part.speaks[:], part.unexplained[:] = self.speaks, self.unexplained
                part.smoothed[:] = self._faults[self._owned]
                self.fault[:] = part.fault[-1]
        return run

    def _steps(
        self, u: NDArray[np.float64], y: NDArray[np.float64], complete: NDArray[np.bool_], run: EstimatorRun
    ) -> None:
        """Advance by N samples with measurements, as :meth:`step` does by one."""
        count = len(u)
        stack, rows = self._stack.run(u, y), np.arange(count)
        found = smooth(np.hstack((stack.residual.reshape(count, -1), stack.fault)), self._keep, self._smoothed)
        residuals, faults = np.split(found, [self._residuals.size], axis=1)
        white = np.matmul(self._whitening, residuals.reshape(*stack.residual.shape, 1))[..., 0]
        J = np.vecdot(white, white)
        sizes = [unwash.run(faults[:, self._owned[place]]) for place, unwash, _ in self._washed]
        believed, unexplained = self._choices(J, faults, sizes)
        explained = unexplained == 0.0
        run.x[:], run.residual[:] = stack.x[rows, believed], stack.residual[rows, believed]
        run.fault[:], run.smoothed[:] = stack.fault[:, self._owned], faults[:, self._owned]
        run.evidence[:] = 0.0
        for k in np.unique(believed).tolist():
            here = np.flatnonzero(explained & (believed == k))
            run.evidence[np.ix_(here, self._places[k])] = faults[here, self._stack.spans[k]]
            for (place, _, _), size in zip(self._washed, sizes, strict=True):
                if place in self._places[k]:
                    run.evidence[here, place] = size[here]
        run.speaks[:] = True
        run.speaks[:, self._comparison] = explained[:, None]
        for k, place, detector in self._edges:
            run.evidence[:, place], held = detector.run(stack.fault[:, self._stack.spans[k].start], J[:, k], complete)
            unexplained = np.where((held != 0.0) & (J[:, k] <= self._floor), 0.0, unexplained)
        run.unexplained[:] = unexplained
        self.J, self.believed, self.unexplained = J[-1].copy(), int(believed[-1]), float(unexplained[-1])
        self.fault[:], self.evidence[:], self.speaks[:] = run.fault[-1], run.evidence[-1], run.speaks[-1]

    def _choices(
        self, J: NDArray[np.float64], faults: NDArray[np.float64], sizes: Sequence[NDArray[np.float64]]
    ) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
        """Return who is believed (N,) and the score of what nobody explains (N,), as :meth:`_choose` chooses.

        Whom each sample would have believed next is found for everyone who may have been believed before it.
        """
        rows, compared = np.arange(len(J)), J[:, self._compared]
        share = self._share * compared.max(axis=1)
        limit = np.where(share > self._floor, share, self._floor)
        penalty = np.where(share > self._penalty, share, self._penalty)
        more = np.add.reduceat((faults > 0.0) & self._scaling, self._first, axis=1) > 0
        cost = J + np.where(more, penalty[:, None], 0.0)
        explains = limit[:, None] >= J
        stays = self._loyal(sizes, len(J)) & explains
        best = self._compared[np.argmin(compared, axis=1)]
        explained = np.zeros(len(J), dtype=np.bool_)
        for group in self._groups:
            explaining = explains[:, group]
            first = explaining.any(axis=1) & ~explained
            price = np.where(explaining, cost[:, group], np.inf)
            least = price.min(axis=1)
            cheapest = np.where(least < np.inf, np.argmin(price, axis=1), np.argmax(explaining, axis=1))
            best = np.where(first, group[cheapest], best)
            cheaper = (_LOYALTY * least)[:, None] < cost[:, group]
            stays[:, group] |= first[:, None] & explaining & ~cheaper
            explained |= first
        chosen, believed = self.believed, []
        for following in np.where(stays, np.arange(J.shape[1]), best[:, None]).tolist():
            chosen = following[chosen]
            believed.append(chosen)
        found = np.array(believed, dtype=np.intp)
        return found, np.where(explained, 0.0, np.sqrt(J[rows, found]))

    def _loyal(self, sizes: Sequence[NDArray[np.float64]], count: int) -> NDArray[np.bool_]:
        """Return which hypotheses stay while they explain (N, K): a washed-out fault of theirs stood before."""
        standing = np.zeros((count + 1, len(self._washed)), dtype=np.bool_)
        for column, (place, _, threshold), size in zip(standing.T, self._washed, sizes, strict=True):
            column[0], column[1:] = place in self._standing, np.abs(size) > threshold
        self._standing = {place for (place, _, _), stands in zip(self._washed, standing[-1], strict=True) if stands}
        loyal = np.zeros((count, len(self._own)), dtype=np.bool_)
        for stands, keepers in zip(standing[:-1].T, self._keepers, strict=True):
            if stands.any():
                loyal |= stands[:, None] & keepers
        return loyal

    def _give_back(self) -> None:
        """Take washed-out faults back to their size, whichever hypothesis is believed, and show the believed one's."""
        believed = frozenset[int]() if self.unexplained else frozenset(self._places[self.believed].tolist())
        for place, unwash, threshold in self._washed:
            size = unwash.update(float(self._faults[self._owned[place]]))
            if place in believed:
                self.evidence[place] = size
            if abs(size) > threshold:
                self._standing.add(place)
            else:
                self._standing.discard(place)

    def _choose(self) -> None:
        J = self.J
        worst = float(J[self._compared].max())
        limit = max(self._floor, self._share * worst)
        if J[self.believed] <= limit and not self._own[self.believed].isdisjoint(self._standing):
            self.unexplained = 0.0
            return
        more = np.add.reduceat((self._faults > 0.0) & self._scaling, self._first) > 0
        cost = J + np.where(more, max(self._penalty, self._share * worst), 0.0)
        for group in self._groups:
            explaining = group[J[group] <= limit]
            if len(explaining):
                best = int(explaining[np.argmin(cost[explaining])])
                if self.believed not in explaining or cost[self.believed] > _LOYALTY * float(cost[best]):
                    self.believed = best
                self.unexplained = 0.0
                return
        self.believed = int(self._compared[np.argmin(J[self._compared])])
        self.unexplained = float(np.sqrt(J[self.believed]))


def owners(gains: Sequence[Gains], faults: Sequence[str]) -> list[int]:
    """Return the index of the smallest hypothesis that each fault is in: the one whose estimate is shown for it."""
    sizes = [len(one.faults) for one in gains]
    return [min((k for k, one in enumerate(gains) if name in one.faults), key=sizes.__getitem__) for name in faults]


def whitening(covariances: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return W_k (p, p) of each covariance with W_k' W_k = S_k^-1, stacked.

    Directions in which a residual cannot move count nothing: a sensor fault takes up all that its output does, so the
    residual under its hypothesis has no part there.
    """
    scale = np.sqrt(np.max([np.diag(covariance) for covariance in covariances], axis=0))
    found = np.zeros((len(covariances), len(scale), len(scale)))
    for W, covariance in zip(found, covariances, strict=True):
        values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
        kept = values > _RANK_TOLERANCE * values[-1]
        W[kept] = (vectors[:, kept] / np.sqrt(values[kept])).T / scale
    return found
