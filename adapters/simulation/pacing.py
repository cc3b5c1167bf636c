"""Yields items when they are due, as a live source would, and sends packets so."""

import socket
import time
from collections.abc import Iterable, Iterator
from math import inf
from typing import TypeVar

from adapters.errors import UsageError
from adapters.mavlink.byte_link import udp_address

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


def send_paced(packets: Iterable[tuple[int, bytes]], url: str, speed: float) -> int:
    """Send packets to ``udp:HOST:PORT`` when they are due, as :func:`paced` says; return their number."""
    family, address = udp_address(url)
    count = 0
    with socket.socket(family, socket.SOCK_DGRAM) as out:
        for packet in paced(packets, speed):
            out.sendto(packet, address)
            count += 1
    return count
