"""Yields items when they are due, as a live source would."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from math import inf
from typing import TypeVar

from adapters.errors import UsageError

T = TypeVar("T")


def paced(items: Iterable[tuple[int, T]], speed: float, catch_up_s: float = inf) -> Iterator[T]:
    """Yield the items in order, none before its time (nanoseconds), at ``speed`` times real time; the first at once.

    The schedule is absolute: a late item does not delay the following ones, unless it is later than ``catch_up_s``:
    after a pause of the machine there is no burst of telemetry.

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
