"""A histogram of latencies that is cheap enough to add every message to: fixed size, quantiles within 6.3 %.

Sixteen buckets for each factor of two, the layout of HdrHistogram (hdrhistogram.org): a latency's bucket is its
five leading bits and how many follow.
"""

from __future__ import annotations

import time
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate

_LEADING_BITS = 5
"""A bucket is 2 ^ -4 of its octave wide: percentiles are exact to 6 %."""
_PER_OCTAVE = 1 << (_LEADING_BITS - 1)
_LARGEST_NS = (1 << 40) - 1
"""18 minutes: what is later counts as this late."""
_BUCKETS = (_LARGEST_NS.bit_length() - _LEADING_BITS) * _PER_OCTAVE + (1 << _LEADING_BITS)
# upper bounds offered to Prometheus: each factor of two from 16 us to 17 s is a bucket boundary here too
_EXPORTED_EXPONENTS = range(14, 35)


_STEP_NS = 1_000_000_000
"""Unix time that moves by more against the monotonic clock was set. Chosen: from there on a monitor is said to lag."""
_SET_NS = 60_000_000_000
"""So long what arrived before the clock was set may still wait: six times what a link believes of the kernel."""


class ArrivalClock:
    """Tells how long ago messages arrived, also those that came before Unix time was set."""

    def __init__(self) -> None:
        self._ahead_ns = self._before_ns = time.time_ns() - time.monotonic_ns()
        self._set_ns = 0

    def ages_ns(self, received_ns: Sequence[int]) -> list[int]:
        """Return the ages of messages by Unix times of arrival, each by the clock that makes it the younger one."""
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
    """Latencies of a span of time; quantiles are never below the truth and at most 6.3 % above."""

    count: int = 0
    # median and 99th percentile, seconds; 0 where there is none
    p50_s: float = 0.0
    p99_s: float = 0.0
    max_s: float = 0.0  # the largest, exactly


@dataclass(frozen=True, slots=True)
class LatencyBuckets:
    """A cumulative histogram as Prometheus knows it."""

    bounds_s: tuple[float, ...]  # upper bounds, seconds, without the last (infinity)
    counts: tuple[int, ...]  # how many latencies are below each bound; one more entry for all of them
    sum_s: float  # sum of all latencies, seconds


class LatencyHistogram:
    """Latencies since the start and over the last interval.

    One thread adds and ends intervals; others may read.
    """

    def __init__(self) -> None:
        self._counts = [0] * _BUCKETS
        self._before = [0] * _BUCKETS
        self._sum_ns = 0
        self._max_ns = 0
        self._interval_max_ns = 0
        self._interval = LatencyStatistics()

    def add(self, latencies_ns: Sequence[int]) -> None:
        """Count latencies, nanoseconds; below zero (a clock was set back) one counts as zero, above 18 min as that."""
        limited_ns = [0 if given < 0 else _LARGEST_NS if given > _LARGEST_NS else given for given in latencies_ns]
        for latency_ns in limited_ns:
            shift = latency_ns.bit_length() - _LEADING_BITS
            self._counts[latency_ns if shift <= 0 else (shift << 4) + (latency_ns >> shift)] += 1
        self._sum_ns += sum(limited_ns)
        self._interval_max_ns = max(self._interval_max_ns, *limited_ns, 0)

    def end_interval(self) -> LatencyStatistics:
        """Return the statistics since the last call, and begin the next interval."""
        counts = self._counts.copy()
        self._interval = _statistics(
            [now - before for now, before in zip(counts, self._before, strict=True)], self._interval_max_ns
        )
        self._before = counts
        self._max_ns = max(self._max_ns, self._interval_max_ns)
        self._interval_max_ns = 0
        return self._interval

    def interval(self) -> LatencyStatistics:
        """Return the statistics of the last interval that ended."""
        return self._interval

    def statistics(self) -> LatencyStatistics:
        """Return the statistics since the start."""
        return _statistics(self._counts.copy(), max(self._max_ns, self._interval_max_ns))

    def buckets(self) -> LatencyBuckets:
        """Return the histogram since the start, coarse enough to be scraped."""
        below, sum_ns = [0, *accumulate(self._counts)], self._sum_ns
        counts = [below[_first_bucket(exponent)] for exponent in _EXPORTED_EXPONENTS]
        bounds = tuple((1 << exponent) / 1e9 for exponent in _EXPORTED_EXPONENTS)
        return LatencyBuckets(bounds, (*counts, below[-1]), sum_ns / 1e9)


def _first_bucket(exponent: int) -> int:
    """Return the bucket that begins at ``2 ** exponent`` nanoseconds."""
    return (exponent - _LEADING_BITS + 2) * _PER_OCTAVE


def _upper_ns(bucket: int) -> int:
    """Return the largest latency of a bucket."""
    shift = max(bucket // _PER_OCTAVE - 1, 0)
    return ((bucket - shift * _PER_OCTAVE + 1) << shift) - 1


def _statistics(counts: Sequence[int], max_ns: int) -> LatencyStatistics:
    cumulative = list(accumulate(counts))
    count = cumulative[-1]
    if count == 0:
        return LatencyStatistics()
    # the upper bounds of the buckets that hold the latencies of these ranks, counted from 1
    ranks = (-(-count * percent // 100) for percent in (50, 99))
    p50_ns, p99_ns = (min(_upper_ns(bisect_left(cumulative, rank)), max_ns) for rank in ranks)
    return LatencyStatistics(count, p50_ns / 1e9, p99_ns / 1e9, max_ns / 1e9)
