"""What samplers hear of a block: stamps, the vehicle's newest time with them, and which messages are new to whom.

The rules are those of :class:`monitor.sampling.sampler.Sampler` and :class:`monitor.sampling.clock.VehicleClock`.
Each part says up to which place of the block it can speak; the message there has to be taken by itself.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from adapters.batch import Batch, Columns
from adapters.channels import Channel
from monitor.sampling.block_channels import UNTIMED, is_clockless, selected, stamps_ns, values
from monitor.sampling.block_clock import unwrapped
from monitor.sampling.block_lane import LaneBlock
from monitor.sampling.clock import TOLERANCE_NS, VehicleClock
from monitor.sampling.lane import Lane, Stream
from monitor.sampling.sampler import CAPACITY, MAX_STAMP_NS, Sampler

Integers = NDArray[np.int64]
# A message name, and what its fields have to be.
Selection = tuple[str, tuple[tuple[str, int | str], ...]]

# For how long after the beginning of a block a counter that turned over is expected near the newest stamp.
_EXPECTED_NS = 120_000_000_000
_NOWHERE = np.empty(0, np.int64)


def prepared(clock: VehicleClock, samplers: Sequence[Sampler], block: Batch) -> tuple[dict[str, Columns], int]:
    """Return the columns of interest, and the place of the first message that somebody is not prepared for."""
    wanted = frozenset[str]().union(*(sampler.interests for sampler in samplers))
    limit = min((at for at, other in block.others.items() if other.name in wanted), default=block.count)
    columns: dict[str, Columns] = {}
    for one in block.columns:
        if one.name in wanted and len(one.position):
            if one.name in columns or not clock.running:
                limit = min(limit, int(one.position[0]))
            columns.setdefault(one.name, one)
    clocks: dict[str, set[tuple[str | None, int | None]]] = {}
    for sampler in samplers:
        for name, stream in sampler.streams_of(columns):
            clocks.setdefault(name, set()).add((stream.channel.clock, stream.channel.clock_unit_ns))
            if sampler.unsettled or len(clocks[name]) > 1:
                limit = min(limit, int(columns[name].position[0]))
    return columns, limit


class Heard:
    """Messages of one name and one selection in a block.

    Parameters
    ----------
    channel : Channel
        Any of the channels taken from them.
    columns : Columns
        The messages of that name.
    limit : int
        Place in the block up to which to look.
    newest_ns : int
        Newest time on the vehicle's clock before the block.

    Attributes
    ----------
    limit : int
        Place of the first message to be taken by itself.
    chosen : NDArray[np.int64]
        Places of the messages that are meant.
    row, place, stamps : NDArray
        Of those with a stamp (m,): their rows in the columns, places in the block, stamps on the vehicle's clock.
    repeats : NDArray[np.bool_]
        Which of these have the stamp of the one before (m,); not known of the first.
    observed : NDArray[np.bool_]
        Which of these the clock gets to see (m,).
    clockless : bool
        Whether they have no stamp of their own.
    """

    def __init__(self, channel: Channel, columns: Columns, limit: int, newest_ns: int) -> None:
        self.columns, self.limit = columns, limit
        count = int(np.searchsorted(columns.position, limit))
        meant = selected(channel, columns.fields, count)
        self.chosen = columns.position[:count][meant]
        self.clockless = is_clockless(channel, columns.fields)
        stamps = None
        if not self.clockless:
            stamps = stamps_ns(channel, columns.fields, count, MAX_STAMP_NS - 1)
            if stamps is None and len(self.chosen):
                self.limit = int(self.chosen[0])
        if stamps is None:
            stamps = np.full(count, UNTIMED)
        least = 1 if columns.source == "mavlink" else 0
        row = np.flatnonzero(meant & (stamps >= least))
        self._raw = stamps[row]
        self._set(row, unwrapped(self._raw, np.full(len(row), newest_ns), _EXPECTED_NS))

    def _set(self, row: NDArray[np.intp], stamps: Integers) -> None:
        self.row: NDArray[np.intp] = row
        self.place: Integers = self.columns.position[row]
        self.stamps: Integers = stamps
        self.repeats: NDArray[np.bool_] = np.zeros(len(row), np.bool_)
        np.equal(stamps[1:], stamps[:-1], out=self.repeats[1:])
        self.observed: NDArray[np.bool_] = ~self.repeats if not self.clockless else np.zeros(len(row), np.bool_)

    def take_newest(self, newest_ns: Integers) -> None:
        """Give messages that have no clock the newest time before them; ``newest_ns`` as of :class:`Hearing`."""
        place = self.chosen[: np.searchsorted(self.chosen, self.limit)]
        row = np.searchsorted(self.columns.position, place)
        stamps = newest_ns[place]
        timed = stamps > 0
        self._set(row[timed], stamps[timed])

    def check(self, newest_ns: Integers) -> None:
        """Find the first message whose stamp is not to be believed at once, or is older than the one before."""
        before_ns = newest_ns[self.place]
        strange = unwrapped(self._raw, before_ns) != self.stamps
        strange |= self.observed & (np.abs(self.stamps - before_ns) > TOLERANCE_NS)
        strange[1:] |= self.stamps[1:] < self.stamps[:-1]
        received_ns = self.columns.received_ns[self.row]
        strange |= (received_ns >= MAX_STAMP_NS) | (received_ns <= -MAX_STAMP_NS)
        self.limit = min(self.limit, _first_place(self.place, strange))


class StreamBlock:
    """What one stream of a sampler makes of the messages heard.

    Parameters
    ----------
    stream : Stream
        The stream.
    order : int
        Its number among the streams of the sampler that take the same name.
    heard : Heard
        Its messages.

    Attributes
    ----------
    limit : int
        Place of the first message to be taken by itself.
    """

    def __init__(self, stream: Stream, order: int, heard: Heard) -> None:
        self._stream, self._order, self._heard = stream, order, heard
        self.limit = heard.limit
        self._known = heard.repeats.copy()
        if not len(heard.row):
            return
        newest = {lane.stamps[-1] if lane.stamps else UNTIMED for lane in stream.lanes}
        first_ns = int(heard.stamps[0])
        self._known[0] = stream.knows(first_ns)
        if len(newest) > 1 or first_ns < max(newest):
            self.limit = min(self.limit, int(heard.place[0]))

    def measure(self, limit: int, factor: int) -> dict[int, LaneBlock]:
        """Return the measurements up to a place of the block, by the ``id`` of their lane.

        A measurement arrives at ``factor`` times its place in the block plus the stream's order.
        """
        heard = self._heard
        fresh = np.flatnonzero(~self._known & (heard.place < limit))
        lanes = {}
        for lane in self._stream.lanes:
            found = values([column.channel for column in lane.columns], heard.columns.fields, heard.row[fresh])
            if found is None:
                self.limit = min(self.limit, _first_place(heard.place[fresh], np.ones(len(fresh), np.bool_)))
                found = np.full((len(fresh), len(lane.columns)), np.nan)
            self.limit = min(self.limit, _first_place(heard.place[fresh], np.isnan(found.sum(axis=1))))
            room = CAPACITY - len(lane.stamps)
            if len(fresh) > room:
                self.limit = min(self.limit, int(heard.place[fresh[room]]))
            arrival = heard.place[fresh] * factor + self._order
            lanes[id(lane)] = LaneBlock(lane, heard.stamps[fresh], arrival, found)
        return lanes

    def counts(self, limit: int) -> tuple[int, int, int]:
        """Return how many messages, messages without a stamp, and duplicates there are up to a place."""
        messages = int(np.searchsorted(self._heard.chosen, limit))
        timed = int(np.searchsorted(self._heard.place, limit))
        repeated = int(np.count_nonzero(self._known[:timed]))
        return messages, messages - timed, repeated * sum(len(lane.columns) for lane in self._stream.lanes)


class Hearing:
    """A block as samplers hear it.

    Parameters
    ----------
    clock : VehicleClock
        The vehicle's clock.
    samplers : Sequence[Sampler]
        The samplers, which share it.
    columns : Mapping[str, Columns]
        The messages by name.
    limit : int
        Place in the block up to which to look.

    Attributes
    ----------
    limit : int
        Place of the first message to be taken by itself.
    newest_ns : NDArray[np.int64]
        Newest time on the vehicle's clock before each message and behind the last (limit + 1,).
    streams : list[list[StreamBlock]]
        The streams of each sampler.
    """

    def __init__(
        self, clock: VehicleClock, samplers: Sequence[Sampler], columns: Mapping[str, Columns], limit: int
    ) -> None:
        self.limit = limit
        self._heard: dict[Selection, Heard] = {}
        takers: dict[Selection, list[Stream]] = {}
        for sampler in samplers:
            for name, stream in sampler.streams_of(columns):
                key = name, stream.where
                if key not in self._heard:
                    self._heard[key] = Heard(stream.channel, columns[name], self.limit, clock.newest_ns)
                takers.setdefault(key, []).append(stream)
        for key, heard in self._heard.items():
            if len(heard.row):
                heard.observed[0] &= not all(stream.knows(int(heard.stamps[0])) for stream in takers[key])
        self._follow_newest(clock.newest_ns, limit)
        self.streams = [
            [
                StreamBlock(stream, sampler.streams[name].index(stream), self._heard[name, stream.where])
                for name, stream in sampler.streams_of(columns)
            ]
            for sampler in samplers
        ]
        self.limit = min([self.limit, *(one.limit for streams in self.streams for one in streams)])

    def _follow_newest(self, newest_ns: int, limit: int) -> None:
        """Follow the vehicle's newest time, and find the first message that it does not simply go on with."""
        self.newest_ns = np.zeros(limit + 1, np.int64)
        self.newest_ns[0] = newest_ns
        for heard in self._heard.values():
            self.newest_ns[heard.place[heard.observed] + 1] = heard.stamps[heard.observed]
        np.maximum.accumulate(self.newest_ns, out=self.newest_ns)
        for heard in self._heard.values():
            if heard.clockless:
                heard.take_newest(self.newest_ns)
            else:
                heard.check(self.newest_ns)

    def lanes(self, sampler: Sampler, streams: Sequence[StreamBlock], factor: int) -> list[LaneBlock]:
        """Return the lanes of a sampler in its own order, and lower the limit to where their values are numbers."""
        found: dict[int, LaneBlock] = {}
        for stream in streams:
            found |= stream.measure(self.limit, factor)
            self.limit = min(self.limit, stream.limit)
        return [found.get(id(lane)) or _no_news(lane) for lane in sampler.lanes]

    def observations(self, limit: int) -> tuple[NDArray[np.intp], Integers, Integers]:
        """Return place, stamp and time of arrival of the messages that the clock gets to see up to a place."""
        stamps = np.full(limit, UNTIMED)
        received_ns = np.empty(limit, np.int64)
        for heard in self._heard.values():
            seen = heard.observed & (heard.place < limit)
            stamps[heard.place[seen]] = heard.stamps[seen]
            received_ns[heard.place[seen]] = heard.columns.received_ns[heard.row[seen]]
        place = np.flatnonzero(stamps >= 0)
        return place, stamps[place], received_ns[place]


def _no_news(lane: Lane) -> LaneBlock:
    return LaneBlock(lane, _NOWHERE, _NOWHERE, np.empty((0, len(lane.columns))))


def _first_place(place: Integers, marked: NDArray[np.bool_]) -> int:
    """Return the first marked place, one beyond all blocks where there is none."""
    first = int(marked.argmax()) if len(marked) else 0
    return int(place[first]) if len(marked) and marked[first] else np.iinfo(np.int64).max
