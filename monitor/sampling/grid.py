"""The grid of a sampler: ticks t_k = k / rate_hz on the vehicle's clock, in whole nanoseconds."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

_SECOND_NS = 1_000_000_000
_MAX_INT64 = (1 << 63) - 1


class Grid:
    """Ticks t_k = k / rate_hz, rounded to a nanosecond.

    Parameters
    ----------
    rate_hz : float
        Ticks per second.
    """

    def __init__(self, rate_hz: float) -> None:
        period = _SECOND_NS / Fraction(rate_hz).limit_denominator(1_000_000)
        self._numerator, self._denominator = period.numerator, period.denominator

    def time_ns(self, index: int) -> int:
        """Return the time of a tick."""
        return (2 * index * self._numerator + self._denominator) // (2 * self._denominator)

    def times_ns(self, first: int, count: int) -> NDArray[np.int64]:
        """Return the times of consecutive ticks (count,)."""
        twice = 2 * self._denominator
        start, rest = divmod(2 * first * self._numerator + self._denominator, twice)
        if rest + 2 * count * self._numerator > _MAX_INT64:
            return np.array([self.time_ns(index) for index in range(first, first + count)], np.int64)
        return start + (rest + np.arange(count) * (2 * self._numerator)) // twice

    def index_at(self, time_ns: int) -> int:
        """Return the first tick at or after a time."""
        index = -(-time_ns * self._denominator // self._numerator)
        return index - 1 if self.time_ns(index - 1) >= time_ns else index
