"""Fit alarm thresholds to healthy evidence, for a stated rate of false alarms.

Each path of a channel's alarm (fast, plain, slow) compares a statistic of the evidence with a size. The size is the
level that the statistic exceeds at the path's share of the observer's granted rate, by an extreme-value fit over
healthy flights (:mod:`monitor.fitting.extremes`); for the lasting path by the scatter of the flights' means
(:mod:`monitor.fitting.lasting`). It is never below a floor: the smallest fault for which the model is accurate enough.
The confidence limits of the level are reported: minutes of flight leave them wide.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from adapters.sample import Given
from monitor.alarms.alarm import AlarmRule
from monitor.chain import ChainRun, ObserverChain
from monitor.core.lagged import exponential_mean
from monitor.core.sampling import VehicleClock
from monitor.estimation.isolation_rule import edge_faults
from monitor.fitting.extremes import ReturnLevel, return_level, standing
from monitor.fitting.flights import Flight
from monitor.fitting.lasting import Scatter
from monitor.profile import ObserverProfile
from monitor.sampling.gate import GateRule

FALSE_ALARMS_PER_HOUR = 0.1
"""False alarms an hour granted to each observer: one in ten hours. Chosen: rare against the flights of a day; lower
rates extrapolate further beyond minutes of healthy flight and raise every threshold."""
CONFIDENCE = 0.95
"""Confidence of the rates that healthy flights exclude, whatever the law of their extremes. Chosen: the usual one."""
_PATHS = 3
"""Number of paths that share a channel's rate: fast, plain and slow; lasting gets as much, if there is no sudden
path."""
_USUAL = 0.9
"""Least share of healthy evidence below the size that clears an alarm: the debounce then counts up four fifths of the
time, and 0.5 s without evidence are counted in 0.63 s. Half of a threshold near the noise would hold half of the
evidence."""
_LEAD_S = 30.0
"""Lead time before evidence, seconds: longer than any observer takes to settle."""
_LEAST_PER_100H = 0.01
"""False alarms in 100 hours below which a tail is not reported: one in a year is beyond minutes of flight."""


@dataclass(frozen=True, slots=True)
class Times:
    """How long evidence has to last on each path, and to be absent, seconds; ``slow_s`` is the mean's time constant."""

    fast_s: float = 0.06
    raise_s: float = 0.15
    slow_s: float = 2.0
    clear_s: float = 0.5
    latch_s: float = 60.0


@dataclass(frozen=True, slots=True)
class Levels:
    """Healthy levels of the three paths' statistics, in the unit of what was pooled."""

    fast: ReturnLevel
    plain: ReturnLevel
    slow: ReturnLevel
    usual: float  # size below which healthy evidence is nine tenths of the time


@dataclass(frozen=True, slots=True)
class Calibrated:
    """A rule and its basis: the level of the plain path with its confidence, per ``scale``.

    Without a level the evidence is zero in healthy operation: an earlier calibration decides when it is not.
    """

    rule: AlarmRule
    level: ReturnLevel | None
    scale: float = 1.0
    levels: Levels | None = None  # those of all paths, per ``scale``
    # the likelihood of sudden changes in healthy flight, and how many channels share it
    sudden: ReturnLevel | None = None
    sharing: int = 1
    scatter: Scatter | None = None  # that of healthy flights' means, per ``mean_scale``
    mean_scale: float = 1.0

    def rated(self, flight_s: float) -> AlarmRule:
        """Return the rule with its rate of false alarms: what is expected, and what flights of that length exclude.

        Each path's statistic exceeds its size as often as its tail says (:mod:`monitor.fitting.extremes`). That no size
        is below the largest value of these flights is all that is known without a tail: the chance of a next, larger
        one is below -log(0.05) over the number of independent values, at 95 % (Wilks, Ann. Math. Statistics 12(1),
        1941; for none in so many, the rule of three).
        """
        rule, levels = self.rule, self.levels
        if levels is None or not flight_s > 0.0 or not self.scale > 0.0:
            return rule
        sizes = (levels.plain, rule.threshold), (levels.fast, rule.fast), (levels.slow, rule.slow)
        per_hour = sum(level.per_hour(size / self.scale) for level, size in sizes if math.isfinite(size))
        if self.sudden is not None:
            per_hour += self.sudden.per_hour(rule.nats) / self.sharing
        if self.scatter is not None:
            per_hour += self.scatter.per_hour(rule.lasting / self.mean_scale)
        excluded = 100.0 * -math.log(1.0 - CONFIDENCE) / (flight_s / 3600.0)
        expected = max(100.0 * per_hour, _LEAST_PER_100H)
        return replace(rule, false_per_100h=float(f"{expected:.2g}"), excluded_per_100h=float(f"{excluded:.2g}"))


def healthy_evidence(
    observer: ObserverProfile, gate: GateRule, flights: Sequence[Flight], *, own: bool = False
) -> list[NDArray[np.float64]]:
    """Run an observer's chain over healthy samples as the monitor does.

    With ``own`` the evidence of a fault is its smoothed estimate under its own hypothesis, whichever is believed, in
    effect units: a hypothesis that is hardly ever believed in healthy flight would otherwise seem to have less noise
    than it has. Return evidence (N, a + 1) of each stretch of samples that count, divided by the scale of its sizes
    there, or by the root of the residuals' level; the last column is the unexplained score.
    """
    edges = edge_faults(observer.isolation)
    levelled = [observer.excitation is None and channel.name not in edges for channel in observer.faults]
    found = []
    for run, stretches in healthy_runs(observer, gate, flights):
        sizes = run.found.smoothed if own else run.estimates.isolated
        scale = np.where(levelled, np.maximum(run.scale, np.sqrt(run.found.level)[:, None]), run.scale)
        evidence = np.column_stack([sizes / scale, run.found.unexplained])
        found += [evidence[rows] for rows in stretches]
    return found


def healthy_runs(
    observer: ObserverProfile, gate: GateRule, flights: Sequence[Flight]
) -> Iterator[tuple[ChainRun, list[slice]]]:
    """Yield the results of an observer's chain for each healthy flight, and the rows of each stretch that counts."""
    for flight in flights:
        watched = flight.rows(_watched(flight, observer.rate_hz * max(_LEAD_S, 3.0 * gate.settle_s)))
        chain = ObserverChain(observer, "healthy", gate, VehicleClock())
        run = chain.estimate(Given(watched.samples), watched.armed)
        yield run, list(watched.stretches(at_restart=False))


def _watched(flight: Flight, lead: float) -> NDArray[np.intp]:
    """Return the rows of a flight, without those that no evidence follows within ``lead`` samples, as on the ground."""
    evidence = flight.evidence
    if not len(evidence):
        return evidence
    rows = np.arange(evidence[-1] + 1)
    following = evidence[np.searchsorted(evidence, rows)]
    return rows[following - rows <= lead]


def healthy_levels(
    evidence: Sequence[NDArray[np.float64]],
    rate_hz: float,
    alarms_per_hour: float,
    times: Times,
    most: float = math.inf,
) -> Levels:
    """Return the levels that signed healthy evidence exceeds at a rate of false alarms granted to each channel.

    ``evidence`` has an array for each stretch (N_i,); channels of one kind are pooled in a unit that makes them
    comparable: a calm log of one motor cannot foresee what a gusty one of another has shown. The paths share the rate;
    a level is at most ``most`` times the largest value of the series.
    """
    per_path = alarms_per_hour / _PATHS

    def level(statistic: Callable[[NDArray[np.float64]], NDArray[np.float64]]) -> ReturnLevel:
        series = [statistic(flight) for flight in evidence]
        found = return_level(series, rate_hz, per_path)
        largest = max((float(stretch.max(initial=0.0)) for stretch in series), default=0.0)
        return found if math.isinf(most) else replace(found, level=min(found.level, most * largest))

    return Levels(
        fast=level(lambda evidence: standing(np.abs(evidence), round(times.fast_s * rate_hz))),
        plain=level(lambda evidence: standing(np.abs(evidence), round(times.raise_s * rate_hz))),
        slow=level(lambda evidence: np.abs(weighted_mean(evidence, times.slow_s, rate_hz))),
        usual=float(np.quantile(np.abs(np.concatenate([[0.0], *evidence])), _USUAL)),
    )


def calibrated(
    rule: AlarmRule, levels: Levels, scale: float, *, floor: float, critical: float, times: Times
) -> Calibrated:
    """Return a channel's alarm rule with its sizes and times.

    Healthy levels were divided by ``scale``, in the rule's unit; ``floor`` is the smallest size worth an alarm,
    ``critical`` the size of a critical fault, at least twice the threshold.
    """
    threshold = max(scale * levels.plain.level, floor)
    return Calibrated(
        replace(
            rule,
            threshold=_rounded(threshold),
            clear=_rounded(min(threshold, max(threshold / 2, scale * levels.usual))),
            critical=_rounded(max(critical, 2 * threshold)),
            raise_s=times.raise_s,
            clear_s=times.clear_s,
            fast=_rounded(max(scale * levels.fast.level, 2 * threshold)),
            fast_s=times.fast_s,
            slow=_rounded(max(scale * levels.slow.level, threshold / 2)),
            slow_s=times.slow_s,
            latch_s=times.latch_s,
            healthy=_rounded(scale * levels.plain.level),
        ),
        levels.plain,
        scale,
        levels,
    )


def with_lasting(
    found: Calibrated, scatter: Scatter, scale: float, *, floor: float, alarms_per_hour: float
) -> Calibrated:
    """Return the alarm with its lasting path, if that path detects smaller faults than the slow one."""
    size = max(scale * scatter.level(alarms_per_hour / _PATHS), floor)
    if size >= found.rule.slow:
        return found
    return replace(found, rule=replace(found.rule, lasting=_rounded(size)), scatter=scatter, mean_scale=scale)


def plain_only(found: Calibrated) -> Calibrated:
    """Return the alarm with its plain path alone: an edge does not fade, and a mean of scores has no meaning."""
    return replace(found, rule=replace(found.rule, fast=math.inf, slow=math.inf, latch_s=0.0, healthy=0.0))


def weighted_mean(evidence: NDArray[np.float64], seconds: float, rate_hz: float) -> NDArray[np.float64]:
    """Return the exponentially weighted mean (N,) of evidence (N,) with a time constant in seconds."""
    keep = float(np.exp(-1.0 / (seconds * rate_hz)))
    return exponential_mean(evidence[:, None], keep)[:, 0]


def _rounded(value: float) -> float:
    return float(f"{value:.4g}")
