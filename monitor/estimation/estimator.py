"""From (u, y) to estimates and evidence: a single observer with its isolation stage, or a bank of observers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from adapters.sample import Samples
from gains.synthesis.gains_file import Gains
from monitor.estimation.bank import Bank
from monitor.estimation.estimator_run import EstimatorRun, empty_run, pieces
from monitor.estimation.isolation import IndependentChannels, SingleFaultIsolator
from monitor.estimation.isolation_rule import BankRule, IndependentRule, IsolationRule, SingleRule
from monitor.estimation.observer_stack import ObserverStack


class JointEstimator:
    """One observer for all faults together, and who is held responsible for its estimates.

    Parameters
    ----------
    gains : Gains
        Gains of the observer.
    rule : IndependentRule | SingleRule
        Isolation part of the profile.

    Attributes
    ----------
    x, fault, residual : NDArray[np.float64]
        As of :class:`monitor.estimation.observer_stack.ObserverStack`: views that the next step overwrites.
    evidence : NDArray[np.float64]
        What each channel is held responsible for (a,).
    unexplained : float
        Always zero: a joint estimate explains whatever comes.
    speaks : NDArray[np.bool_]
        Channels whose evidence counts (a,): all.
    """

    unexplained = 0.0

    def __init__(self, gains: Gains, rule: IndependentRule | SingleRule) -> None:
        self._observer = ObserverStack([gains])
        self._isolator = _isolator(gains, rule)
        self.x = self._observer.x[0]
        self.fault = self._observer.fault
        self.residual = self._observer.residual[0]
        self.evidence = np.zeros(len(gains.faults))
        self.speaks = np.ones(len(gains.faults), dtype=np.bool_)

    @property
    def smoothed(self) -> NDArray[np.float64]:
        """What each channel is held responsible for (a,): a joint estimate has no other."""
        return self.evidence

    def restart(self, u: NDArray[np.float64], y: NDArray[np.float64]) -> None:
        """Forget the past: start at the state that (u, y) explain without a fault."""
        self._observer.restart(u, y)
        self._isolator.restart()

    def step(self, u: NDArray[np.float64], y: NDArray[np.float64], complete: bool = True) -> None:
        """Advance by one sample, u (s,) and y (p,), whether or not it was bridged across lost measurements."""
        del complete
        self._observer.step(u, y)
        self.evidence = self._isolator.update(self.fault).evidence

    def coast(self, u: NDArray[np.float64]) -> None:
        """Advance by one sample without measurements, u (s,): nothing is learned of who is responsible."""
        self._observer.coast(u)

    def run(self, samples: Samples) -> EstimatorRun:
        """Take N samples; return what the attributes hold after each, to the bits of taking them one by one."""
        run = empty_run(len(samples), len(self.x), len(self.residual), len(self.fault))
        run.speaks[:] = True
        run.unexplained[:] = 0.0
        for piece in pieces(samples):
            rows = slice(piece.start, piece.stop)
            u, y = samples.u[rows], samples.y[rows]
            if piece.restart:
                self.restart(u[0], y[0])
            if piece.measured:
                found = self._observer.run(u, y)
                run.evidence[rows] = self._isolator.run(found.fault)
                self.evidence = run.evidence[piece.stop - 1].copy()
            else:
                found = self._observer.coasted(u)
                run.evidence[rows] = self.evidence
            run.x[rows], run.fault[rows], run.residual[rows] = found.x[:, 0], found.fault, found.residual[:, 0]
        run.smoothed[:] = run.evidence
        return run


Estimator = JointEstimator | Bank


def make_estimator(
    gains: Sequence[Gains], rule: IsolationRule, faults: Sequence[str], thresholds: Mapping[str, float]
) -> Estimator:
    """Return the estimator that a profile asks for: several gains for a bank, one otherwise."""
    if isinstance(rule, BankRule):
        return Bank(gains, rule, faults, thresholds)
    return JointEstimator(gains[0], rule)


def _isolator(gains: Gains, rule: IndependentRule | SingleRule) -> IndependentChannels | SingleFaultIsolator:
    if isinstance(rule, IndependentRule):
        return IndependentChannels(len(gains.faults), rule.smoothing_s, gains.rate_hz)
    losses = np.array([source is not None for source in gains.fault_inputs], dtype=np.bool_)
    return SingleFaultIsolator(
        rule.covariance,
        rule.smoothing_s,
        gains.rate_hz,
        rule.tolerance,
        rule.score_floor,
        rule.gain_penalty,
        losses,
    )
