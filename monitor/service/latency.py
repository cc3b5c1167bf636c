"""Time from the arrival of messages to their results: quantiles of late, and a histogram since the start."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

_LARGEST_NS = (1 << 40) - 1
"""Largest latency: 18 minutes; a larger one counts as this one."""
_BOUNDS = range(14, 35)
"""Bounds of the histogram: powers of two of a nanosecond, from 16 us to 17 s."""
_KEPT = 1 << 16
"""Latencies of an interval that are kept. Chosen: ten times as many as a second of one vehicle's flood has."""


_STEP_NS = 1_000_000_000
"""If Unix time moves by more than this against the monotonic clock, it was set. Chosen: a monitor that is later by this
much is reported as lagging."""
_SET_NS = 60_000_000_000
"""How long messages that arrived before the clock was set may still wait: six times what a link accepts as the kernel's
delay."""


class ArrivalClock:
    """Tells how long ago messages arrived, also those that arrived before Unix time was set."""

    def __init__(self) -> None:
        self._ahead_ns = self._before_ns = time.time_ns() - time.monotonic_ns()
        self._set_ns = 0

    def ages_ns(self, received_ns: Sequence[int]) -> list[int]:
        """Return the ages of messages from their Unix times of arrival, each by the clock that makes it younger."""
        steady_ns = time.monotonic_ns()
        before_ns, self._ahead_ns = self._ahead_ns, time.time_ns() - steady_ns
        if abs(self._ahead_ns - before_ns) > _STEP_NS:
            self._before_ns, self._set_ns = before_ns, steady_ns
        now_ns, then_ns = steady_ns + self._ahead_ns, steady_ns + self._before_ns
        if not self._set_ns or steady_ns - self._set_ns > _SET_NS:
            return [now_ns - one for one in received_ns]
        return [max(min(now_ns - one, then_ns - one, key=lambda age: (age < 0, age)), 0) for one in received_ns]


@dataclass(frozen=True, slots=True)
class LatencyStatistics:
    """Median, 99th percentile and largest of some latencies, seconds; 0 if there are none."""

    p50_s: float = 0.0
    p99_s: float = 0.0
    max_s: float = 0.0


@dataclass(frozen=True, slots=True)
class LatencyBuckets:
    """A cumulative histogram as Prometheus defines it."""

    bounds_s: tuple[float, ...]  # upper bounds, seconds, without the last (infinity)
    counts: tuple[int, ...]  # number of latencies below each bound; one more entry for all of them
    sum_s: float  # sum of all latencies, seconds


class Latencies:
    """Latencies since the start, by size, and those of the last interval (the latest 65,536 at most).

    For one thread.
    """

    def __init__(self) -> None:
        self._unread: list[int] = []
        self._counts = np.zeros(len(_BOUNDS) + 1, np.int64)
        self._sum_ns = 0
        self._latest: deque[int] = deque(maxlen=_KEPT)
        self.interval = LatencyStatistics()

    def add(self, latencies_ns: Iterable[int]) -> None:
        """Count latencies, nanoseconds.

        A negative one (a clock was set back) counts as zero, one above 18 min as 18 min.
        """
        self._unread += latencies_ns
        if len(self._unread) >= _KEPT:
            self._count()

    def _count(self) -> None:
        """Count what came since the last call: all at once costs much less than one by one."""
        latencies = np.array([min(max(one, 0), _LARGEST_NS) for one in self._unread], np.int64)
        self._unread = []
        # the exponent of a number is its length in bits
        bins = np.clip(np.frexp(latencies)[1] - _BOUNDS[0], 0, len(_BOUNDS))
        self._counts += np.bincount(bins, minlength=len(self._counts))
        self._sum_ns += int(latencies.sum())
        self._latest.extend(latencies.tolist())

    def end_interval(self) -> LatencyStatistics:
        """Return the statistics since the last call, which becomes the last interval, and begin the next one."""
        self.interval = self.statistics()
        self._latest.clear()
        return self.interval

    def statistics(self) -> LatencyStatistics:
        """Return the statistics of the current interval."""
        self._count()
        ordered = sorted(self._latest)
        if not ordered:
            return LatencyStatistics()
        p50_ns, p99_ns = (ordered[-(-len(ordered) * percent // 100) - 1] for percent in (50, 99))
        return LatencyStatistics(p50_ns / 1e9, p99_ns / 1e9, ordered[-1] / 1e9)

    def buckets(self) -> LatencyBuckets:
        """Return the histogram since the start."""
        self._count()
        counts = tuple(np.cumsum(self._counts).tolist())
        return LatencyBuckets(tuple((1 << bound) / 1e9 for bound in _BOUNDS), counts, self._sum_ns / 1e9)
