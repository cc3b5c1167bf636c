"""Ticks of a sampler over a stretch of messages: which come, with which message, and what they hold.

The rules are those of :class:`monitor.sampling.sampler.Sampler`; a test holds both together. A sampler either gives
out ticks (:class:`Ticks`) or waits for a channel and drops what gets too old meanwhile (:class:`Waits`). Both find the
first message that has to be taken by itself before anything is changed, and go there with ``commit``.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from adapters.sample import Samples, stacked
from monitor.sampling.block_clock import LineChange, unix_times
from monitor.sampling.block_lane import LaneBlock, Passage
from monitor.sampling.lane import FIRST_STEPS, Lane
from monitor.sampling.sampler import Sampler

Integers = NDArray[np.int64]

_NEVER = int(np.iinfo(np.int64).max)


class Ticks:
    """Ticks given out while every channel goes on.

    Parameters
    ----------
    sampler : Sampler
        A sampler whose grid has started.
    lanes : Sequence[LaneBlock]
        Its lanes, in order.
    factor : int
        A measurement that arrives at a is in the message at place a // factor.
    newest_ns : NDArray[np.int64]
        Newest time on the vehicle's clock before each message and behind the last.
    limit : int
        Place of the block up to which to look.

    Attributes
    ----------
    limit : int
        Place of the first message to be taken by itself.
    """

    def __init__(
        self, sampler: Sampler, lanes: Sequence[LaneBlock], factor: int, newest_ns: Integers, limit: int
    ) -> None:
        self._sampler, self._lanes, self._factor = sampler, lanes, factor
        due = sampler.next_tick or 0
        count = max(0, sampler.grid.index_at(min(int(lane.stamps[-1]) for lane in lanes) + 1) - due)
        most = 4 * limit + 64
        self._first = due
        self._ticks_ns = ticks_ns = sampler.grid.times_ns(due, min(count, most))
        self._complete = np.ones(len(ticks_ns), np.bool_)
        self._measured = self._complete.copy()
        self._known_ns = ticks_ns.copy()
        arrival = np.full(len(ticks_ns), -1)
        gap = np.zeros(len(ticks_ns), np.bool_)
        self._around = [lane.around(ticks_ns) for lane in lanes]
        self._passages = [
            lane.passage(np.maximum(around.left, 0)) for lane, around in zip(lanes, self._around, strict=True)
        ]
        for lane, around, passage in zip(lanes, self._around, self._passages, strict=True):
            np.maximum(arrival, lane.arrival[around.right], out=arrival)
            np.maximum(self._known_ns, lane.stamps[around.right], out=self._known_ns)
            width_ns = lane.stamps[around.right] - lane.stamps[around.left]
            limits = passage.at_events()
            lost = width_ns > limits[:, 0]
            gap |= (lost & (width_ns > limits[:, 2])) | (around.left < 0)
            self._complete &= ~lost
            if lane.lane.places[-1] >= sampler.first_measured:
                self._measured &= ~(lost & (width_ns > limits[:, 1]))
        self._arrival = arrival
        unusual = np.flatnonzero(gap | (arrival < 0))
        self.limit = _first_given_up(lanes, self._passages, factor, newest_ns, limit)
        if len(unusual):
            self.limit = min(self.limit, max(0, int(arrival[unusual[0]]) // factor))
        if count > most:
            self.limit = min(self.limit, max(0, int(arrival[-1]) // factor))

    def commit(self, limit: int, counts: tuple[int, int, int], changes: list[LineChange]) -> tuple[Samples, Integers]:
        """Go up to a place; return the samples and the places of the messages that completed them.

        Parameters
        ----------
        limit : int
            The place.
        counts : tuple[int, int, int]
            Messages, those without a stamp, and duplicates up to there.
        changes : list[LineChange]
            How the clock's line changes up to there.
        """
        sampler, end = self._sampler, limit * self._factor
        count = int(np.searchsorted(self._arrival, end))
        place, ticks_ns = self._arrival[:count] // self._factor, self._ticks_ns[:count]
        vector = np.empty((count, sampler.size))
        for lane, around in zip(self._lanes, self._around, strict=True):
            vector[:, lane.lane.places] = lane.between(ticks_ns, around.until(count))
        restart = np.zeros(count, np.bool_)
        restart[:1] = sampler.restarting
        samples = Samples(
            index=np.arange(self._first, self._first + count),
            vehicle_time_ns=ticks_ns,
            time_ns=unix_times(changes, place, ticks_ns, sampler.last_unix),
            u=vector[:, : sampler.inputs],
            y=vector[:, sampler.inputs :],
            restart=restart,
            complete=self._complete[:count],
            known_ns=self._known_ns[:count],
            measured=self._measured[:count],
        )
        arrived = [int(np.searchsorted(lane.arrival, end)) for lane in self._lanes]
        sampler.note(samples, *counts)
        sampler.waiting = self._waiting(arrived, count)
        for lane, passage, there in zip(self._lanes, self._passages, arrived, strict=True):
            lane.commit(passage, count, there)
        return samples, place

    def _waiting(self, arrived: Sequence[int], count: int) -> Lane | None:
        """Return the lane that is waited for: the first one behind, each time the one waited for has caught up."""
        due_ns = self._sampler.due_ns
        behind = [
            int(np.searchsorted(lane.stamps[:there], due_ns)) for lane, there in zip(self._lanes, arrived, strict=True)
        ]
        caught_up = [
            int(lane.arrival[at]) if at < there else _NEVER
            for lane, at, there in zip(self._lanes, behind, arrived, strict=True)
        ]
        waiting = self._sampler.waiting
        if count:
            now = int(self._arrival[count - 1])
        elif waiting is not None:
            now = caught_up[next(i for i, lane in enumerate(self._lanes) if lane.lane is waiting)]
        else:
            news = [
                int(lane.arrival[lane.waiting])
                for lane, there in zip(self._lanes, arrived, strict=True)
                if there > lane.waiting
            ]
            now = min(news, default=_NEVER)
        while now != _NEVER:
            at = next(i for i, arrival in enumerate(caught_up) if arrival > now)
            waiting, now = self._lanes[at].lane, caught_up[at]
        return waiting


def no_samples(sampler: Sampler) -> Samples:
    """Return the samples of a sampler where there is none."""
    return stacked((), sampler.inputs, sampler.size - sampler.inputs)


def is_waiting(sampler: Sampler, newest_ns: int) -> bool:
    """Return whether a sampler gives out nothing before a certain channel comes, and drops what others bring."""
    if sampler.next_tick is None:
        return True
    lane = sampler.waiting
    return lane is not None and lane.stamps[-1] < min(sampler.due_ns, newest_ns - lane.silence_ns)


class Waits:
    """A sampler that waits for one channel: before the grid has started, or for one that stopped.

    Parameters as of :class:`Ticks`.
    """

    def __init__(
        self, sampler: Sampler, lanes: Sequence[LaneBlock], factor: int, newest_ns: Integers, limit: int
    ) -> None:
        self._sampler, self._lanes, self._factor = sampler, lanes, factor
        started = sampler.next_tick is not None
        waiting = next(lane for lane in lanes if (lane.lane is sampler.waiting if started else not lane.lane.ready))
        # A lane that waits with several measurements may learn its period, and with it how long to wait.
        enough = 1 if started else FIRST_STEPS + 1 - waiting.lane.learned - waiting.waiting
        last = waiting.waiting + enough - 1
        self.limit = min(limit, int(waiting.arrival[last]) // factor if last < len(waiting.stamps) else limit)
        events = _events(lanes)
        events = events[events < self.limit * factor]
        if started and waiting.waiting > 1 and len(events):
            self.limit = int(events[0]) // factor
            events = events[:0]
        horizon_ns = newest_ns[events // factor + 1] - waiting.lane.silence_ns
        newest = np.searchsorted(waiting.arrival, events, side="right") - 1
        given_up = newest < 0
        given_up[~given_up] = waiting.stamps[newest[~given_up]] < horizon_ns[~given_up]
        self._events, self._horizon_ns = events[given_up], horizon_ns[given_up]
        self._passages = []
        for lane in lanes:
            there = np.searchsorted(lane.arrival, self._events, side="right")
            oldest = np.minimum(np.searchsorted(lane.stamps, self._horizon_ns, side="right"), there) - 1
            self._passages.append(lane.passage(np.maximum(oldest, 0)))

    def commit(self, limit: int, counts: tuple[int, int, int], changes: list[LineChange]) -> tuple[Samples, Integers]:
        """Go up to a place, as :meth:`Ticks.commit` does; there are no samples."""
        sampler, end = self._sampler, limit * self._factor
        events = int(np.searchsorted(self._events, end))
        if events:
            sampler.skip_to(int(self._horizon_ns[events - 1]))
        for lane, passage in zip(self._lanes, self._passages, strict=True):
            lane.commit(passage, events, int(np.searchsorted(lane.arrival, end)))
        samples = no_samples(sampler)
        sampler.note(samples, *counts)
        return samples, np.empty(0, np.int64)


def _first_given_up(
    lanes: Sequence[LaneBlock], passages: Sequence[Passage], factor: int, newest_ns: Integers, limit: int
) -> int:
    """Return the place of the first message behind which a lane may have been waited for too long, or ``limit``."""
    # With several streams of one name, one may give up waiting for what another is about to store.
    late = 0 if factor == 1 else 1
    for lane, passage in zip(lanes, passages, strict=True):
        until = np.append(lane.arrival[lane.waiting :] // factor, limit)
        horizon_ns = lane.stamps[lane.waiting - 1 :] + int(passage.limits[:, 3].min())
        silent = np.flatnonzero(newest_ns[np.minimum(until + late, len(newest_ns) - 1)] > horizon_ns)
        if not len(silent):
            continue
        events = _events(lanes) // factor
        told = np.searchsorted(events, np.searchsorted(newest_ns[1:], horizon_ns[silent], side="right"))
        real = told < len(events)
        found = events[told[real]]
        limit = min([limit, *found[found < until[silent][real] + late][:1].tolist()])
    return limit


def _events(lanes: Sequence[LaneBlock]) -> Integers:
    """Return when measurements arrive, in order."""
    events = np.concatenate([lane.arrival[lane.waiting :] for lane in lanes])
    events.sort()
    return events
