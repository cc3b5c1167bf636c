"""From (u, y) to estimates and evidence: a single observer with its isolation stage, or a bank of observers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from adapters.sample import Samples
from monitor.core.bank import IndependentIsolation, SingleFaultIsolation
from monitor.estimation.bank import Bank, EstimatorRun
from monitor.estimation.isolation_rule import BankRule, IndependentRule, IsolationRule, SingleRule, keep_share
from monitor.estimation.observer import Observer


def single_fault_isolation(rule: SingleRule, rate_hz: float, scales: NDArray[np.bool_]) -> SingleFaultIsolation:
    """Return the stage that smooths joint estimates and holds one channel responsible at a time.

    Channels that scale an input (a,) fail towards less.
    """
    return SingleFaultIsolation(
        information=np.asarray(np.linalg.inv(rule.covariance), np.float64),
        penalty=np.where(scales, rule.gain_penalty, 0.0),
        keep=keep_share(rule.smoothing_s, rate_hz),
        tolerance=rule.tolerance,
        floor=rule.score_floor,
    )


def independent_isolation(channels: int, smoothing_s: float, rate_hz: float) -> IndependentIsolation:
    """Return the stage in which every channel's smoothed estimate is its own evidence.

    For plants whose faults are well told apart by the observer.
    """
    return IndependentIsolation(channels, keep_share(smoothing_s, rate_hz))


class JointEstimator:
    """One observer for all faults together, and the isolation of its estimates.

    Its joint estimate explains whatever comes: nothing is unexplained, and the evidence of every channel counts.
    """

    def __init__(self, observer: Observer, rule: IndependentRule | SingleRule) -> None:
        self._observer = observer
        hypothesis = observer.hypotheses[0]
        if isinstance(rule, IndependentRule):
            self._isolation = independent_isolation(len(hypothesis.faults), rule.smoothing_s, observer.rate_hz)
        else:
            self._isolation = single_fault_isolation(rule, observer.rate_hz, np.array(hypothesis.scales))

    def run(
        self, samples: Samples, armed: NDArray[np.bool_], beyond: NDArray[np.float64] | None = None
    ) -> EstimatorRun:
        """Process N samples; return the estimates and the evidence after each.

        Which are evidence (``armed``) and how far they lie outside of the fitted flights changes nothing here.
        """
        restart, measured = samples.restart, samples.measured
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
        )


Estimator = JointEstimator | Bank


def make_estimator(
    observer: Observer, rule: IsolationRule, faults: Sequence[str], thresholds: Mapping[str, float]
) -> Estimator:
    """Return the estimator that a profile's isolation asks for; that of a bank has an observer of several hypotheses.

    ``faults`` are all fault channels in the order of the estimates, ``thresholds`` those of their alarms.
    """
    if isinstance(rule, BankRule):
        return Bank(observer, rule, faults, thresholds)
    return JointEstimator(observer, rule)
