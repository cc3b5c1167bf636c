"""A lane over a stretch of messages: its measurements as arrays, what it learns of its period, values between them.

The rules are those of :class:`monitor.sampling.lane.Lane`; a test holds both together. Measurements are named by their
place in ``stamps``: first those that wait in the lane, then the new ones in the order they come.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from monitor.sampling.lane import RELEARN_EVERY, STEPS, Lane, Limits

Integers = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Passage:
    """How a lane's oldest measurements are passed and its period learned, event by event.

    Parameters
    ----------
    oldest : NDArray[np.intp]
        The oldest measurement that is left after each event (k,).
    relearned : NDArray[np.intp]
        Events at which the period is learned again (r,).
    periods_ns : list[int]
        What is learned there.
    limits : NDArray[np.int64]
        Rows of :class:`monitor.sampling.lane.Limits`: those before the first event, then those of each learned period.
    """

    oldest: NDArray[np.intp]
    relearned: NDArray[np.intp]
    periods_ns: list[int]
    limits: Integers

    def at_events(self) -> Integers:
        """Return the limits that hold after each event: one row for all, or one row for each event."""
        if not len(self.relearned):
            return self.limits
        return self.limits[np.searchsorted(self.relearned, np.arange(len(self.oldest)), side="right")]


@dataclass(frozen=True, slots=True)
class Bracket:
    """Which measurements lie around ticks.

    Parameters
    ----------
    left, right : NDArray[np.intp]
        The newest one at or before each tick, below 0 where there is none, and the one behind it (n,); the same one
        where there is none behind it.
    exact : NDArray[np.bool_]
        Where the left one lies at the tick (n,).
    """

    left: NDArray[np.intp]
    right: NDArray[np.intp]
    exact: NDArray[np.bool_]

    def until(self, count: int) -> Bracket:
        """Return those of the first ticks."""
        return Bracket(self.left[:count], self.right[:count], self.exact[:count])


class LaneBlock:
    """A lane's measurements, those waiting in it and new ones.

    Parameters
    ----------
    lane : Lane
        The lane as it is before the stretch.
    stamps : NDArray[np.int64]
        Stamps of the new measurements (m,), ascending, newer than those in the lane.
    arrival : NDArray[np.int64]
        When they arrive (m,), ascending from 0; those in the lane have -1.
    values : NDArray[np.float64]
        Their values (m, number of columns).
    """

    def __init__(self, lane: Lane, stamps: Integers, arrival: Integers, values: NDArray[np.float64]) -> None:
        self.lane = lane
        self.waiting = len(lane.stamps)
        self.stamps = np.concatenate([np.array(lane.stamps, np.int64), stamps])
        self.arrival = np.concatenate([np.full(self.waiting, -1), arrival])
        self.values = np.concatenate([np.array(lane.rows).reshape(-1, len(lane.columns)), values])

    def around(self, ticks_ns: Integers) -> Bracket:
        """Return the measurements around ticks (n,), all of them at or before the newest measurement."""
        left = np.searchsorted(self.stamps, ticks_ns, side="right") - 1
        exact = self.stamps[left] == ticks_ns
        exact &= left >= 0
        return Bracket(left, left + ~exact, exact)

    def passage(self, oldest: NDArray[np.intp]) -> Passage:
        """Return what happens where events leave ``oldest`` (k,), not descending, as the oldest measurement."""
        lane = self.lane
        count = oldest.copy()
        count[1:] -= oldest[:-1]
        learned = oldest + lane.learned
        relearned = np.flatnonzero((count > 0) & (learned >= STEPS) & (learned % RELEARN_EVERY < count))
        limits = [Limits(lane.loss_ns, lane.line_ns, lane.gap_ns, lane.silence_ns)]
        if not len(relearned):
            return Passage(oldest, relearned, [], np.array(limits))
        steps = np.concatenate([np.array(lane.steps, np.int64), np.diff(self.stamps)])
        windows = oldest[relearned, None] + np.arange(len(lane.steps) - STEPS, len(lane.steps))
        middle = (STEPS - 1) // 2
        periods = np.partition(steps[windows], middle, axis=1)[:, middle].tolist()
        places = {period: place for place, period in enumerate(dict.fromkeys(periods), 1)}
        limits += [lane.limits(period) for period in places]
        if len(set(limits)) == 1:
            return Passage(oldest, relearned[:0], [], np.array(limits[:1]))
        return Passage(oldest, relearned, periods, np.array(limits)[[0, *(places[period] for period in periods)]])

    def between(self, ticks_ns: Integers, around: Bracket) -> NDArray[np.float64]:
        """Return the values at ticks (n, number of columns), interpolated as :class:`Lane` does."""
        lane, stamps = self.lane, self.stamps
        left, right, exact = around.left, around.right, around.exact
        width_ns = stamps[right] - stamps[left]
        width_ns[exact] = 1
        fraction = (ticks_ns - stamps[left]) / width_ns
        before, after = self.values[left], self.values[right]
        found: NDArray[np.float64] = after - before
        found *= fraction[:, None]
        found += before
        for column, period in lane.wrapping:
            step = (after[:, column] - before[:, column] + 0.5 * period) % period - 0.5 * period
            found[:, column] = before[:, column] + step * fraction
        for column in lane.held:
            found[:, column] = before[:, column]
        found[exact] = before[exact]
        return found

    def commit(self, passage: Passage, events: int, arrived: int) -> None:
        """Leave the lane as it is after some of the events and of the measurements, counted in ``stamps``."""
        lane = self.lane
        oldest = int(passage.oldest[events - 1]) if events else 0
        lane.steps.extend(np.diff(self.stamps[max(0, oldest - STEPS) : oldest + 1]).tolist())
        lane.learned += oldest
        relearned = int(np.searchsorted(passage.relearned, events))
        if relearned:
            lane.set_limits(passage.periods_ns[relearned - 1])
        lane.stamps[:] = self.stamps[oldest:arrived].tolist()
        lane.rows[:] = self.values[oldest:arrived].tolist()
