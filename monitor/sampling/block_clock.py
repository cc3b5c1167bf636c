"""The vehicle's clock over a stretch of messages: its line of delays as it changes, and Unix times by it.

The rules are those of :class:`monitor.sampling.clock.VehicleClock`, whose own code takes every message that changes
the line; a test holds both together.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from monitor.sampling.clock import BUCKET_NS, TOLERANCE_NS, TURNS_NS, Line, Point, VehicleClock

Stamps = NDArray[np.int64]

_WINDOW = 512
_MAX_PRODUCT = 1 << 62
_SECOND_NS = 1_000_000_000


class LineChange(NamedTuple):
    """From the message at a place of a block on, this line holds."""

    place: int
    line: Line


def unwrapped(stamps: Stamps, newest_ns: Stamps, within_ns: int = TOLERANCE_NS) -> Stamps:
    """Return stamps (m,) with the turns of their counter added that bring them near the newest stamps (m,).

    Stamps that are not older than a second stay as they are. With the default of ``within_ns`` it is what
    :meth:`monitor.sampling.clock.VehicleClock.unwrap` does.
    """
    old = np.flatnonzero(stamps < newest_ns - _SECOND_NS)
    if not len(old):
        return stamps
    turned = stamps.copy()
    wrapped, newest = stamps[old], newest_ns[old]
    # Last comes first: what a turn that counts more finds is not to be overwritten.
    for turn_ns in reversed(TURNS_NS):
        near = wrapped + np.rint((newest - wrapped) / turn_ns).astype(np.int64) * turn_ns
        fits = (wrapped < turn_ns) & (np.abs(near - newest) <= within_ns)
        turned[old[fits]] = near[fits]
    return turned


def observe_block(
    clock: VehicleClock, place: NDArray[np.intp], stamps: Stamps, received_ns: Stamps
) -> list[LineChange]:
    """Let a clock that runs take stamps near its newest ones, in order of arrival; return how its line changes.

    Parameters
    ----------
    clock : VehicleClock
        The clock.
    place : NDArray[np.intp]
        Places of the messages in the block (m,).
    stamps, received_ns : NDArray[np.int64]
        What :meth:`monitor.sampling.clock.VehicleClock.observe` would be given (m,).
    """
    changes = [LineChange(-1, clock.line)]
    delay_ns = received_ns - stamps
    at = 0
    while at < len(stamps):
        rows = slice(at, min(len(stamps), at + _WINDOW))
        line, last = clock.line, clock.newest_point
        early_ns = _delays(line, stamps[rows]) - delay_ns[rows]
        # The line lies below the last point, so what is too early to be believed is among these.
        telling = early_ns > line.at(last.stamp_ns) - last.delay_ns
        telling |= stamps[rows] >= (last.stamp_ns // BUCKET_NS + 1) * BUCKET_NS
        first = int(telling.argmax())
        quiet = first if telling[first] else len(telling)
        if quiet:
            clock.trust()
        at += quiet
        if quiet < len(telling):
            clock.learn(Point(int(stamps[at]), int(delay_ns[at])))
            if clock.line is not line:
                changes.append(LineChange(int(place[at]), clock.line))
            at += 1
    if len(stamps):
        clock.advance(int(stamps.max()))
    return changes


def unix_times(
    changes: list[LineChange], place: NDArray[np.int64], ticks_ns: Stamps, last: tuple[int, int] | None
) -> Stamps:
    """Return the Unix times of ticks (n,) by the lines as they were at the messages that completed them.

    They never stand still while the clock's offset is being corrected: the rule of
    :class:`monitor.sampling.sampler.Sampler`, ``last`` being the tick before and its Unix time.
    """
    unix_ns = np.empty_like(ticks_ns)
    starts = np.searchsorted(place, [change.place for change in changes]).tolist()
    for change, start, stop in zip(changes, starts, [*starts[1:], len(ticks_ns)], strict=True):
        if start < stop:
            unix_ns[start:stop] = ticks_ns[start:stop] + _delays(change.line, ticks_ns[start:stop])
    if not len(ticks_ns):
        return unix_ns
    first_tick, first_unix = (int(ticks_ns[0]) - _SECOND_NS, int(unix_ns[0]) - _SECOND_NS) if last is None else last
    half_ns = np.diff(ticks_ns, prepend=first_tick) // 2
    lag_ns = np.diff(unix_ns, prepend=first_unix)
    slow = np.flatnonzero((lag_ns < half_ns) & (half_ns - lag_ns < _SECOND_NS)).tolist()
    done = -1
    for row in slow:
        if row <= done:
            continue
        at = row
        before = first_unix if at == 0 else int(unix_ns[at - 1])
        while at < len(unix_ns) and 0 < before + int(half_ns[at]) - int(unix_ns[at]) < _SECOND_NS:
            before += int(half_ns[at])
            unix_ns[at] = before
            at += 1
        done = at
    return unix_ns


def _delays(line: Line, stamps: Stamps) -> Stamps:
    """Return the line's delays at stamps (m,), rounded down."""
    point = line.point
    if not line.rise_ns or not len(stamps):
        return np.full(len(stamps), point.delay_ns)
    away_ns = stamps - point.stamp_ns
    if max(-int(away_ns.min()), int(away_ns.max())) * abs(line.rise_ns) >= _MAX_PRODUCT:
        return np.array([line.at(stamp_ns) for stamp_ns in stamps.tolist()], np.int64)
    return point.delay_ns + away_ns * line.rise_ns // line.run_ns
