"""A bank: one observer for each hypothesis; the smallest residual that explains the data names the faults.

Observer k is designed for the faults of hypothesis k alone. With r_k its smoothed residual and S_k the covariance of
that residual in healthy flight,

    J_k = r_k' S_k^-1 r_k = |W_k r_k|^2

stays about p while the hypothesis is right, and grows with the fault that it does not explain (structured residuals). A
hypothesis explains the data as long as J_k <= max(score_floor^2, tolerance^2 max_i J_i): the level of healthy flight,
or the level of model error for a fault of that size. Of the hypotheses that explain the data, those with the fewest
faults are preferred, and among them the smallest J.

The level of healthy flight is that of its liveliest moment, which many faults stay below. What a fault leaves under a
wrong hypothesis lasts, though, and a manoeuvre's errors do not: the lasting J is that of the mean residual over
level_s, by the healthy covariance of that mean.

Actuators fail towards less. A hypothesis under which one would have to deliver more than commanded competes with that
of an actuator of opposite effect that delivers less: it is believed if its mean J is smaller by gain_penalty, or if its
lasting J is smaller by gain_penalty times lambda (which may be below 1 here) and at most a quarter of the other's;
while either is smaller by a share of this, neither is held responsible. Hypotheses of several actuators that would have
to deliver more are never believed: others that deliver less have the same effect. Two actuators that deliver less are
believed, although one of them alone explains the data up to the level of health or of model error, if the mean J of the
two is smaller by far, or the lasting J by gain_penalty and at most a quarter, and neither loss is small beside the
other. Turns that no fitted flight had look like losses of two opposite motors where commands come slowly. So a
hypothesis may be believed in calm alone: where no output was larger than its ``calm`` for level_s, over which means
forget most of a turn, and where its lasting J is smaller than that of each single fault by twice gain_penalty and at
most a quarter.

The hypothesis believed so far stays until another is clearly better (half its J), so noise does not make names
flicker. If none explains the data no fault is named, and the score sqrt(min J) is reported as unexplained.

A hypothesis that differs from the one believed in one channel, explains the data too and is not 14 behind in its mean J
or its lasting J (odds of a thousand) makes that channel the other's rival: events say that the two are not told apart.

Flights may have more wind than those that were fitted, and be livelier. The residual of the hypothesis believed shows
it, as it does not contain the hypothesis' own fault: with lambda the mean of the smallest J over ``level_s`` relative
to that of healthy flight, every J is divided by max(1, lambda), and sizes that raise alarms grow with its root
(:class:`monitor.chain.ObserverChain`).

A hypothesis of a sensor fault that would explain anything (a gyro bias against the motors) may be set apart: it takes
no part in the comparison, and a fault that no compared hypothesis has is evidence if its estimate has an edge
(:class:`monitor.core.bank.EdgeDetector`).

The size of a fault whose estimate is washed out is restored (:class:`monitor.core.bank.Washout`); while this memory
holds it, its hypothesis is not left for another that explains the data as well.

All observers run all the time and none is ever reset by another's verdict: after the end of a fault its residuals
return to their healthy size by themselves, and the bank is armed for the next one.

The rules themselves, row after row, are :class:`monitor.core.bank.Choice`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from math import nan
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adapters.sample import Given, Samples
from monitor.core.bank import Choice, EdgeDetector, Washout
from monitor.estimation.isolation_rule import BankRule, keep_share
from monitor.estimation.observer import FaultSet, Observer


class EstimatorRun(NamedTuple):
    """Estimates and evidence after each of N samples."""

    # state estimate (N, n), each fault as estimated (N, a), in a bank under its smallest hypothesis, and residual (N,
    # p), not smoothed; x and residual are those of the hypothesis believed
    x: NDArray[np.float64]
    fault: NDArray[np.float64]
    residual: NDArray[np.float64]
    evidence: NDArray[np.float64]  # size of each fault that is held responsible (N, a), zero for all others
    # channels whose evidence counts (N, a): all but the compared ones of a bank in which no hypothesis explains the
    # data
    counted: NDArray[np.bool_]
    # smoothed estimate of each fault (N, a), in a bank under its smallest hypothesis, whichever is believed
    smoothed: NDArray[np.float64]
    unexplained: NDArray[np.float64]  # score sqrt(min J) if no hypothesis explains the data, otherwise zero (N,)
    # the residuals' mean square relative to that of healthy flight (N,); below 1 in calm
    level: NDArray[np.float64]
    # channel that may be responsible in place of each (N, a), -1 where what was measured tells the two apart
    rival: NDArray[np.intp]
    # channels with a fault that was let go without having been seen to end (N, a)
    let_go: NDArray[np.bool_]


def washout_inverse(tau: float, rate_hz: float, threshold: float) -> Washout:
    """Return the inverse of the washout (tau, seconds) of one fault channel; :meth:`Washout.run` processes n rows.

    Its input is the smoothed estimate of the channel under its own hypothesis in every sample, whichever hypothesis is
    believed: switching it off and on would cut pieces out of the integral. ``threshold`` is the channel's alarm
    threshold.
    """
    return Washout(0.5 / (tau * rate_hz), threshold, round(_SETTLED_S * rate_hz), round(_STANDS_S * rate_hz))


_SETTLED_S = 1.0
"""Time for which a fault has to be over before it is forgotten. Chosen: eight time constants of the inertial bank's
smoothing, through which a step down passes zero."""
_STANDS_S = 30.0
"""Time for which the washed-out size of a fault is restored without support from a measurement: one time constant of
the washouts. Chosen: an older size is no longer the present one."""


_FLAT = 10.0 / 3.0
"""Time that a level has to last, relative to its jump. Chosen: with jump and mean an edge is known within 0.2 s at 100
Hz."""
HOLD_S = 10.0
"""Time for which an edge is held, seconds. Chosen: a longer one shows an old bias whose present size this sensor alone
cannot tell, a shorter one clears alarms whose fault still exists."""


def edge_detector(
    rate_hz: float, limit: float, smallest: float | None, hold_s: float = HOLD_S, jump_s: float = 0.03
) -> EdgeDetector:
    """Return a detector of edges in one sensor fault's estimate; :meth:`EdgeDetector.run` processes n rows.

    ``limit`` is the largest J = r' S^-1 r of the sensor's own hypothesis at which it is believed; ``smallest`` the
    smallest edge that is held, in the unit of the estimate (None: edges are only shown), for at most ``hold_s``
    seconds. ``jump_s`` is the time that the estimate may take to jump, and the length of the mean that gives a level.
    """
    return EdgeDetector(
        mean=max(1, round(jump_s * rate_hz)),
        gap=max(1, round(jump_s * rate_hz)),
        flat=max(2, round(_FLAT * jump_s * rate_hz)),
        longest=round(hold_s * rate_hz),
        limit=limit,
        smallest=nan if smallest is None else smallest,
    )


CALM_LEVELS = 1.0
"""How long outputs have to be small for a hypothesis that is believed in calm alone, in level_s. Measured on a flight
with turns at 4.6 rad/s, watched with the profile of calmer ones: the lasting J of opposite motors was smaller than
that of each single one by up to 655 in turns, 22 after one level_s without a turn, 2 after two; 10 % of both make 140
and more."""
_HEALTHY = 3.5
"""J / p up to which a hypothesis with an edge is believed: one healthy sample in a thousand has more, for p = 4."""

_RANK_TOLERANCE = 1e-6
"""Smallest variance, relative to the largest, that is not taken for zero. Measured on the fitted profiles of five
vehicles: directions in which a residual cannot move have at most 1e-16, all others at least 4e-6."""


class Bank:
    """The observers of a bank and the hypothesis believed at present.

    Observer and rule have the hypotheses in one order, ``faults`` are all fault channels (a,) in the order of the
    estimates. Edges smaller than a channel's alarm threshold are not held, and washed-out faults smaller than it not
    restored.
    """

    def __init__(
        self, observer: Observer, rule: BankRule, faults: Sequence[str], thresholds: Mapping[str, float]
    ) -> None:
        self._observer = observer
        self._newest_ns, self._forgets = 0, False
        hypotheses, rate_hz = observer.hypotheses, observer.rate_hz
        sizes = np.array([len(hypothesis.faults) for hypothesis in hypotheses])
        compared = ~np.array(rule.edges)
        spans = np.concatenate([[0], np.cumsum(sizes)])
        members = np.array([[name in hypothesis.faults for name in faults] for hypothesis in hypotheses])
        p, (white, lasting) = len(rule.covariances[0]), _whitenings(rule)
        self._choice = Choice(
            whitening=white,
            lasting=lasting,
            spans=spans,
            channel=[faults.index(name) for hypothesis in hypotheses for name in hypothesis.faults],
            shown=[
                spans[k] + hypotheses[k].faults.index(name)
                for name, k in zip(faults, owners(hypotheses, faults), strict=True)
            ],
            scaling=[scales for hypothesis in hypotheses for scales in hypothesis.scales],
            groups=[np.flatnonzero((sizes == size) & compared) for size in np.unique(sizes[compared])],
            own=members & ~members[compared].all(axis=0),
            edges=[
                (k, spans[k] + i, edge_detector(rate_hz, _HEALTHY * p, thresholds.get(name), jump_s=rule.jump_s))
                for k in np.flatnonzero(rule.edges).tolist()
                for i, name in enumerate(hypotheses[k].faults)
                if not members[compared, faults.index(name)].any()
            ],
            washouts=[
                (faults.index(name), washout_inverse(tau, rate_hz, thresholds[name]))
                for name, tau in rule.washouts.items()
                if thresholds.get(name, 0.0) > 0.0
            ],
            keep=keep_share(rule.smoothing_s, rate_hz),
            floor=rule.score_floor**2,
            share=rule.tolerance**2,
            penalty=rule.gain_penalty,
            usual=rule.usual_score**2,
            follow=1.0 - keep_share(rule.level_s, rate_hz),
            calm=np.array(rule.calm or np.zeros((len(hypotheses), p))),
            calm_rows=round(CALM_LEVELS * rule.level_s * rate_hz),
        )

    def forget(self) -> None:
        """Forget all faults at the next restart."""
        self._forgets = True

    def run(self, given: Given, armed: NDArray[np.bool_]) -> EstimatorRun:
        """Process N samples; return the estimates under the hypothesis believed and the evidence after each.

        ``armed`` tells which samples are evidence (N,); the residuals of corrected samples have no meaning.
        """
        samples, beyond, corrected = given.samples, given.beyond, given.corrected
        restart, measured = samples.restart, samples.measured
        run = self._observer.run(samples.u, samples.y, measured, restart)
        return EstimatorRun(
            *self._choice.run(
                run.x,
                run.fault,
                run.residual,
                samples.y,
                measured,
                samples.complete,
                restart,
                armed,
                beyond,
                corrected,
                self._resumed(samples),
            )
        )

    def _resumed(self, samples: Samples) -> NDArray[np.bool_]:
        """Return the restarts at which the same flight goes on (N,).

        A gap that is longer than washed-out faults are held ends them.
        """
        times_ns, resumed = samples.vehicle_time_ns, samples.restart
        # Most batches have no restart, and the rest takes a twentieth of a small batch's time.
        if np.count_nonzero(resumed):
            apart_ns = np.diff(times_ns, prepend=self._newest_ns)
            resumed = resumed & (apart_ns > 0) & (apart_ns <= _STANDS_S * 1e9)
            if self._forgets:
                self._forgets, resumed[samples.restart.argmax()] = False, False
        self._newest_ns = int(times_ns[-1]) if len(times_ns) else self._newest_ns
        return resumed


def owners(hypotheses: Sequence[FaultSet], faults: Sequence[str]) -> list[int]:
    """Return the index of the smallest hypothesis that contains each fault: its estimate is the one shown."""
    sizes = [len(hypothesis.faults) for hypothesis in hypotheses]
    return [
        min((k for k, hypothesis in enumerate(hypotheses) if name in hypothesis.faults), key=sizes.__getitem__)
        for name in faults
    ]


def smallest(hypotheses: Sequence[Sequence[str]]) -> NDArray[np.bool_]:
    """Return which hypotheses contain no other one (K,)."""
    sets = [set(faults) for faults in hypotheses]
    return np.array([not any(other < faults for other in sets) for faults in sets])


# Shared as the settling time of gains: vehicles, and the trials of a fit, have the rules of one profile.
@lru_cache(maxsize=64)
def _whitenings(rule: BankRule) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return W_k of the residuals under each hypothesis, and of those that last."""
    fewest = smallest(rule.hypotheses)
    return whitening(rule.covariances, fewest), whitening(rule.lasting or rule.covariances, fewest)


def whitening(
    covariances: Sequence[NDArray[np.float64]], measure: NDArray[np.bool_] | None = None
) -> NDArray[np.float64]:
    """Return W_k (p, p) of each covariance with W_k' W_k = S_k^-1, stacked.

    Directions in which a residual cannot move count nothing: a sensor fault absorbs all that its output does, so the
    residual under its hypothesis has no component there. ``measure`` tells the hypotheses (K,) whose residuals show how
    large an output's are (all).
    """
    diagonals = np.array([np.diag(covariance) for covariance in covariances])
    scale = np.sqrt(diagonals[slice(None) if measure is None else measure].max(axis=0))
    stacked = np.zeros((len(covariances), len(scale), len(scale)))
    for W, covariance in zip(stacked, covariances, strict=True):
        values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
        kept = values > _RANK_TOLERANCE * values[-1]
        W[kept] = (vectors[:, kept] / np.sqrt(values[kept])).T / scale
    return stacked
