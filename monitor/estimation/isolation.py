"""Which single fault explains the estimates best: generalised least squares with the healthy covariance.

The joint estimate f^ of all fault channels carries disturbance along directions that healthy flight shows (a gust
looks like all motors at once). With Sigma its healthy covariance, the size of a fault of channel i alone is

    theta_i = e_i' Sigma^-1 f^ / (e_i' Sigma^-1 e_i),        J_i = theta_i^2 e_i' Sigma^-1 e_i,

J_i being the drop of the misfit when channel i is held responsible. The channel with the largest J is the suspect;
gain_penalty is how much larger J must be to believe that a channel delivers more than commanded, rather than that
another one delivers less: motors fail towards less. Others are held responsible beside it one after the other, each for
the largest drop of what the suspects so far leave unexplained, and only while that drop is beyond healthy flight
(score_floor) and beyond what model error makes of the first suspect (tolerance, a share of its score sqrt(J)); the
sizes of all suspects are then fitted together. The rules themselves are in :mod:`monitor.core.bank`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from monitor.core.bank import IndependentIsolation, SingleFaultIsolation
from monitor.estimation.isolation_rule import SingleRule
from monitor.estimation.smoothing import keep_share


def single_fault_isolation(rule: SingleRule, rate_hz: float, scales: NDArray[np.bool_]) -> SingleFaultIsolation:
    """Return the stage that smooths joint estimates and holds one channel responsible at a time.

    Parameters
    ----------
    rule : SingleRule
        Isolation part of the profile.
    rate_hz : float
        Samples per second.
    scales : NDArray[np.bool_]
        Channels (a,) that scale an input: they fail towards less.
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
