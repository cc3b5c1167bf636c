"""Hands items out when they are due, as a live source would."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from typing import TypeVar

from adapters.errors import TelemetryError

T = TypeVar("T")


def paced(items: Iterable[tuple[int, T]], speed: float) -> Iterator[T]:
    """Return the items in order, each not before its time.

    The schedule is absolute: an item that came late does not delay those behind it.

    Parameters
    ----------
    items : Iterable[tuple[int, T]]
        Time in nanoseconds and item; the first item is due at once.
    speed : float
        Times real time.

    Raises
    ------
    TelemetryError
        The speed is not positive.
    """
    if not speed > 0.0:
        raise TelemetryError(f"speed {speed:g}: has to be positive")
    start: tuple[int, int] | None = None
    for time_ns, item in items:
        if start is None:
            start = time_ns, time.monotonic_ns()
        wait_ns = start[1] + (time_ns - start[0]) / speed - time.monotonic_ns()
        if wait_ns > 0:
            time.sleep(wait_ns / 1e9)
        yield item
