"""A bank at run time: one observer for each hypothesis; the smallest residual that explains the data names the faults.

Observer k is designed for the faults of hypothesis k alone. With r_k its smoothed residual and S_k the covariance of
that residual in healthy flight,

    J_k = r_k' S_k^-1 r_k

stays about p while the hypothesis is right and grows with what it leaves unexplained (structured residuals). A
hypothesis explains the data as long as J_k <= max(score_floor^2, tolerance^2 max_i J_i): what healthy flight shows, or
what model error makes of a fault that large. Of those that do, the ones with fewest faults are preferred, and among
them the smallest J, to which gain_penalty is added for an actuator that would have to deliver more than commanded:
actuators fail towards less, and two of opposite effect are told apart by little else. The one believed so far stays
until another is clearly better, so noise does not make names flicker. Where none explains the data nobody is held
responsible, and the score sqrt(min J) says how much is left.

All observers run all the time and none is ever reset by another's verdict: when a fault has gone, its residuals return
to their healthy size by themselves and the bank is armed for the next one.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gains.gains_file import Gains
from monitor.isolation_rule import BankRule
from monitor.observer import Observer

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

    Attributes
    ----------
    fault : NDArray[np.float64]
        Each fault as estimated under its smallest hypothesis (a,).
    evidence : NDArray[np.float64]
        Smoothed estimates of the faults of the hypothesis believed (a,), zero for all others.
    J : NDArray[np.float64]
        What each hypothesis leaves unexplained (number of hypotheses,).
    unexplained : float
        Score sqrt(min J) where no hypothesis explains the data, else zero.
    believed : int
        Index of the hypothesis believed.
    """

    def __init__(self, gains: Sequence[Gains], rule: BankRule, faults: Sequence[str]) -> None:
        self._observers = [Observer(one) for one in gains]
        self._places = [np.array([faults.index(name) for name in one.faults], dtype=np.intp) for one in gains]
        sizes = np.array([len(one.faults) for one in gains])
        self._groups = [np.flatnonzero(sizes == size) for size in np.unique(sizes)]
        self._owned = []
        for at, name in enumerate(faults):
            owner = min((k for k, one in enumerate(gains) if name in one.faults), key=sizes.__getitem__)
            self._owned.append((at, owner, gains[owner].faults.index(name)))
        p, rate_hz = len(gains[0].outputs), gains[0].rate_hz
        self._information = np.stack([np.linalg.inv(covariance) for covariance in rule.covariances])
        self._keep = float(np.exp(-1.0 / (rule.smoothing_s * rate_hz))) if rule.smoothing_s > 0 else 0.0
        self._floor = rule.score_floor**2
        self._share = rule.tolerance**2
        self._penalty = rule.gain_penalty
        self._scaling = [np.array([source is not None for source in one.fault_inputs]) for one in gains]
        self._residuals = np.zeros((len(gains), p))
        self._faults = [np.zeros(len(one.faults)) for one in gains]
        self.fault = np.zeros(len(faults))
        self.evidence = np.zeros(len(faults))
        self.J = np.zeros(len(gains))
        self.unexplained = 0.0
        self.believed = 0

    @property
    def x(self) -> NDArray[np.float64]:
        """State estimate of the hypothesis believed (n,)."""
        return self._observers[self.believed].x

    @property
    def residual(self) -> NDArray[np.float64]:
        """Residual of the hypothesis believed (p,), not smoothed."""
        return self._observers[self.believed].residual

    def restart(self, u: NDArray[np.float64], y: NDArray[np.float64]) -> None:
        """Forget the past: start all observers at the state that (u, y) explain without a fault."""
        for observer, fault in zip(self._observers, self._faults, strict=True):
            observer.restart(u, y)
            fault[:] = 0.0
        self._residuals[:] = 0.0

    def step(self, u: NDArray[np.float64], y: NDArray[np.float64]) -> None:
        """Advance all observers by one sample, u (s,) and y (p,), and choose the hypothesis to believe."""
        keep = self._keep
        self._residuals *= keep
        for k, observer in enumerate(self._observers):
            observer.step(u, y)
            self._residuals[k] += (1.0 - keep) * observer.residual
            self._faults[k] *= keep
            self._faults[k] += (1.0 - keep) * observer.fault
        r = self._residuals
        self.J = np.einsum("ki,kij,kj->k", r, self._information, r)
        self._choose()
        for at, owner, place in self._owned:
            self.fault[at] = self._observers[owner].fault[place]
        self.evidence[:] = 0.0
        if not self.unexplained:
            self.evidence[self._places[self.believed]] = self._faults[self.believed]

    def _choose(self) -> None:
        J = self.J
        limit = max(self._floor, self._share * float(J.max()))
        gains = [np.any(fault[scaling] > 0.0) for fault, scaling in zip(self._faults, self._scaling, strict=True)]
        cost = J + self._penalty * np.array(gains)
        for group in self._groups:
            explaining = group[J[group] <= limit]
            if len(explaining):
                best = int(explaining[np.argmin(cost[explaining])])
                if self.believed not in explaining or cost[self.believed] > _LOYALTY * float(cost[best]):
                    self.believed = best
                self.unexplained = 0.0
                return
        self.believed = int(np.argmin(J))
        self.unexplained = float(np.sqrt(J[self.believed]))
