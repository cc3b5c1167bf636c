"""Measurements waiting to become samples, kept by groups of channels that come together."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

from adapters.channels import Channel

STEPS = 31
FIRST_STEPS = 3
RELEARN_EVERY = 8
_JITTER_NS = 1_000_000
_SILENCE_NS = 500_000_000
_GAP_PERIODS = 10
_LINE_PERIODS = 3


@dataclass(frozen=True, slots=True)
class Column:
    """One channel and its place in [u; y]."""

    position: int
    channel: Channel


class Limits(NamedTuple):
    """What follows from a lane's period, in the order and meaning of :class:`Lane`'s attributes, nanoseconds."""

    loss_ns: int
    line_ns: int
    gap_ns: int
    silence_ns: int


class Lane:
    """Measurements of channels that came together: one stamp and one row of values each, in order of time.

    Parameters
    ----------
    columns : list[Column]
        The channels, in the order of a row.
    max_gap_ns : int
        Longest stretch that may be bridged, whatever the channels' period.
    slow_ns : int
        Period from which on straight lines are all there is between measurements, lost ones or not.

    Attributes
    ----------
    stamps : list[int]
        Times on the vehicle's clock, nanoseconds, ascending.
    rows : list[list[float]]
        Values at these times.
    loss_ns : int
        Distance of neighbours from which on measurements are missing between them.
    line_ns : int
        Distance of neighbours beyond which a model says more of an output than the straight line between them.
    gap_ns : int
        Distance of neighbours beyond which nothing is interpolated.
    silence_ns : int
        How long a lane that stopped is waited for.
    steps : deque[int]
        The newest ``STEPS`` distances of neighbours among the measurements dropped.
    learned : int
        Number of steps learned.
    held : list[int]
        Columns that keep their newest value.
    wrapping : list[tuple[int, float]]
        Columns whose values wrap, and their periods.
    """

    def __init__(self, columns: list[Column], max_gap_ns: int, slow_ns: int) -> None:
        self.columns = columns
        self.places = [column.position for column in columns]
        self.stamps: list[int] = []
        self.rows: list[list[float]] = []
        self.held = [i for i, c in enumerate(columns) if c.channel.interpolation == "previous"]
        self.wrapping = [(i, c.channel.period) for i, c in enumerate(columns) if c.channel.period is not None]
        self._max_gap_ns, self._slow_ns = max_gap_ns, slow_ns
        self.steps: deque[int] = deque(maxlen=STEPS)
        self.learned = 0
        self.set_limits(0)

    def limits(self, period_ns: int) -> Limits:
        """Return what follows from a period."""
        gap_ns = max(self._max_gap_ns, _GAP_PERIODS * period_ns)
        loss_ns = period_ns + period_ns // 2 + min(_JITTER_NS, period_ns // 4)
        line_ns = gap_ns if period_ns >= self._slow_ns else loss_ns + (_LINE_PERIODS - 1) * period_ns
        return Limits(loss_ns, line_ns, gap_ns, max(_SILENCE_NS, _GAP_PERIODS * period_ns))

    def set_limits(self, period_ns: int) -> None:
        """Take a period."""
        self.loss_ns, self.line_ns, self.gap_ns, self.silence_ns = self.limits(period_ns)

    @property
    def ready(self) -> bool:
        """Whether enough measurements came to tell their period."""
        return self.learned + len(self.stamps) > FIRST_STEPS

    def settle(self) -> None:
        """Take the period from all that came so far."""
        self.set_limits(median([*self.steps, *(b - a for a, b in pairwise(self.stamps))]))

    def clear(self) -> None:
        """Forget everything."""
        self.stamps.clear()
        self.rows.clear()
        self.steps.clear()
        self.learned = 0
        self.set_limits(0)

    def drop(self, count: int) -> None:
        """Drop the oldest measurements."""
        del self.stamps[:count], self.rows[:count]

    def pass_to(self, time_ns: int) -> None:
        """Drop what is older than the newest measurement at or before a time, and learn the steps passed."""
        stamps = self.stamps
        count = 0
        while count + 1 < len(stamps) and stamps[count + 1] <= time_ns:
            self.steps.append(stamps[count + 1] - stamps[count])
            count += 1
        self.learned += count
        self.drop(count)
        if self.learned >= STEPS and self.learned % RELEARN_EVERY < count:
            self.set_limits(median(self.steps))

    def interpolate(self, fraction: float, vector: list[float]) -> None:
        """Write the values between the two oldest measurements into [u; y]."""
        left, right = self.rows[0], self.rows[1]
        for place, a, b in zip(self.places, left, right, strict=True):
            vector[place] = a + (b - a) * fraction
        for column, period in self.wrapping:
            step = (right[column] - left[column] + 0.5 * period) % period - 0.5 * period
            vector[self.places[column]] = left[column] + step * fraction
        for column in self.held:
            vector[self.places[column]] = left[column]

    def split(self, keep: Sequence[bool]) -> tuple[Lane, Lane]:
        """Return two lanes with the same past, one of the columns to keep and one of the others."""
        parts = []
        for wanted in (True, False):
            chosen = [i for i, kept in enumerate(keep) if kept is wanted]
            part = Lane([self.columns[i] for i in chosen], self._max_gap_ns, self._slow_ns)
            part.stamps = self.stamps.copy()
            part.rows = [[row[i] for i in chosen] for row in self.rows]
            part.steps = self.steps.copy()
            part.learned = self.learned
            part.loss_ns, part.line_ns = self.loss_ns, self.line_ns
            part.gap_ns, part.silence_ns = self.gap_ns, self.silence_ns
            parts.append(part)
        return parts[0], parts[1]


def median(steps: Collection[int]) -> int:
    """Return the middle one, of an even number the smaller of the two."""
    return sorted(steps)[(len(steps) - 1) // 2]


class Stream:
    """Channels that share message, selection and clock.

    Parameters
    ----------
    channel : Channel
        Any of them.
    lane : Lane
        The lane they start in; a message that holds only some of them splits it.

    Attributes
    ----------
    clockless : bool
        Whether the newest message had no time of its own.
    """

    def __init__(self, channel: Channel, lane: Lane) -> None:
        self.channel = channel
        self.where = channel.where
        self.lanes = [lane]
        self.clockless = False

    def knows(self, stamp_ns: int) -> bool:
        """Return whether all channels have a newest measurement of this time."""
        for lane in self.lanes:  # noqa: SIM110 - a generator costs three times as much, for each message
            if not lane.stamps or lane.stamps[-1] != stamp_ns:
                return False
        return True
