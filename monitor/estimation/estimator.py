"""From (u, y) to estimates and evidence: a single observer, or a bank of observers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from adapters.sample import Given
from monitor.core.bank import IndependentIsolation
from monitor.estimation.bank import Bank, EstimatorRun
from monitor.estimation.isolation_rule import BankRule, IndependentRule, IsolationRule, keep_share
from monitor.estimation.observer import Observer


class JointEstimator:
    """One observer for all faults together, each of which answers for its own smoothed estimate.

    Its joint estimate explains any data: nothing is unexplained, and the evidence of every channel counts.
    """

    def __init__(self, observer: Observer, rule: IndependentRule) -> None:
        self._observer = observer
        keep = keep_share(rule.smoothing_s, observer.rate_hz)
        self._isolation = IndependentIsolation(len(observer.hypotheses[0].faults), keep)

    def forget(self) -> None:
        """Do nothing: no restart keeps a fault."""

    def run(self, given: Given, armed: NDArray[np.bool_]) -> EstimatorRun:
        """Process N samples; return the estimates and the evidence after each.

        It does not matter here which are evidence (``armed``), lie outside of the fitted flights or were corrected.
        """
        samples, restart, measured = given.samples, given.samples.restart, given.samples.measured
        run = self._observer.run(samples.u, samples.y, measured, restart)
        evidence = self._isolation.run(run.fault, measured, restart)
        return EstimatorRun(
            x=run.x[:, 0],
            fault=run.fault,
            residual=run.residual[:, 0],
            evidence=evidence,
            counted=np.ones(evidence.shape, np.bool_),
            smoothed=evidence,
            unexplained=np.zeros(len(evidence)),
            level=np.ones(len(evidence)),
            rival=np.full(evidence.shape, -1, np.intp),
            let_go=np.zeros(evidence.shape, np.bool_),
        )


Estimator = JointEstimator | Bank


def make_estimator(
    observer: Observer, rule: IsolationRule, faults: Sequence[str], thresholds: Mapping[str, float]
) -> Estimator:
    """Return the estimator for a profile's isolation; that of a bank has an observer of several hypotheses.

    ``faults`` are all fault channels in the order of the estimates, ``thresholds`` those of their alarms.
    """
    if isinstance(rule, BankRule):
        return Bank(observer, rule, faults, thresholds)
    return JointEstimator(observer, rule)
