"""Hands items out when they are due, as a live source would."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from math import inf
from typing import TypeVar

from adapters.errors import UsageError

T = TypeVar("T")


def paced(items: Iterable[tuple[int, T]], speed: float, catch_up_s: float = inf) -> Iterator[T]:
    """Return the items in order, each not before its time (nanoseconds), at so many times real time; the first at once.

    The schedule is absolute: an item that came late does not delay those behind it, unless it came later than
    ``catch_up_s``: a machine that stood still is no burst of telemetry.

    Raises
    ------
    UsageError
        The speed is not positive.
    """
    if not speed > 0.0:
        raise UsageError(f"speed {speed:g}: has to be positive")
    start: tuple[int, int] | None = None
    for time_ns, item in items:
        if start is None:
            start = time_ns, time.monotonic_ns()
        wait_ns = start[1] + (time_ns - start[0]) / speed - time.monotonic_ns()
        if wait_ns > 0:
            time.sleep(wait_ns / 1e9)
        elif wait_ns < -1e9 * catch_up_s:
            start = time_ns, time.monotonic_ns()
        yield item
