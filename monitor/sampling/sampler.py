"""Messages of different rates -> samples (u, y) on a fixed-rate grid of the vehicle's clock.

Tick k is at t_k = k / rate_hz on the vehicle's own clock, rounded to a nanosecond, so a monitor that starts
late gives the same samples as one that was there from the start. The rules, in which only the messages and
their order count:

1. A measurement is (channel, stamp, value). The same channel and stamp again is a duplicate, ignored and
   counted: GPS_RAW_INT repeated with an unchanged ``time_usec`` is one measurement. Stamp 0 of a MAVLink
   message means that the sender has no time yet: ignored and counted, as is a clock field that is missing or
   no number. A channel whose message has no clock field at all takes the newest time of the vehicle.
2. Measurements may come in any order. One that is older than its channel's newest is put in its place as long
   as its stamp lies after the last tick given out or skipped; otherwise it is late: dropped and counted.
3. The grid starts when four measurements of every channel are there. Tick k is given out as soon as every
   channel has a measurement at or after t_k: ``linear`` channels are interpolated between the two
   measurements around t_k, ``previous`` ones hold the newest at or before it. So a sample comes at most one
   period of the slowest channel after its time.
4. A channel's nominal period is the median of its last 31 steps from stamp to stamp. If the measurements
   around t_k are more than 1.5 periods apart (1 ms or a quarter of a period, whichever is less, is granted
   for jitter), some were lost in between and the sample is marked ``complete=False``: an estimate, no
   evidence. If three or more of an output's are missing, of one that comes at least at every second tick, it
   is marked ``measured=False`` too: the observer coasts, for over such a stretch its model says more than a
   straight line. Without outputs any channel counts (the raw signals of a transform). If they are further apart
   than 10 periods and than ``max_gap_s``, it is a gap: its ticks are skipped and the first sample after it is
   marked ``restart=True``. The default of 0.1 s is ten samples at 100 Hz, about as long as a straight line says
   something about a body rate; an observer is better started afresh than fed with more of it.
5. A channel that stops while others go on is waited for until the vehicle's clock is 0.5 s and 10 of its
   periods ahead; then ticks are skipped and measurements that only they would have used are dropped. Memory
   is bounded.
6. Which stamps to believe is the clock's business (:class:`monitor.sampling.clock.VehicleClock`): a reboot starts all
   buffers anew, a single damaged stamp does not. A message with a doubtful stamp is held back until the next
   one decides about it; the stamp of a 32-bit counter that turned over is continued.
7. A value that is missing, no number or not finite is ignored and counted; other channels of the same message
   are not affected.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from adapters.channels import Channel
from adapters.message import Message
from adapters.sample import Sample, Samples
from monitor.sampling.clock import VehicleClock
from monitor.sampling.grid import Grid
from monitor.sampling.lane import Column, Lane, Stream

CAPACITY = 1 << 14
MAX_STAMP_NS = 1 << 62
_SECOND_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class SamplerStatistics:
    """What a sampler did so far; measurements count once per channel.

    Parameters
    ----------
    messages : int
        Messages of interest.
    duplicates, late : int
        Measurements ignored because they were known already, or came after their ticks.
    invalid : int
        Values missing, no number or not finite.
    untimed : int
        Messages without a usable stamp.
    doubted : int
        Messages dropped because no other message agreed with their stamp.
    clock_restarts : int
        Reboots and jumps of the vehicle's clock.
    samples, incomplete, restarts : int
        Samples given out, those among them with ``complete=False`` and those with ``restart=True``.
    skipped : int
        Ticks inside gaps, for which there is no sample.
    """

    messages: int
    duplicates: int
    late: int
    invalid: int
    untimed: int
    doubted: int
    clock_restarts: int
    samples: int
    incomplete: int
    restarts: int
    skipped: int


class Sampler:
    """Turns the messages of one vehicle into samples.

    Parameters
    ----------
    inputs, outputs : Sequence[Channel]
        Channels of u and of y, in the order of the plant model.
    rate_hz : float
        Samples per second of the vehicle's clock.
    clock : VehicleClock
        The vehicle's clock; several samplers may share it.
    max_gap_s : float
        Longest stretch bridged by interpolation, seconds (at least 10 periods of the channel in any case).

    The attributes without an underscore are the state that :mod:`monitor.sampling.block_sampler` works on too.
    """

    def __init__(
        self,
        inputs: Sequence[Channel],
        outputs: Sequence[Channel],
        rate_hz: float,
        clock: VehicleClock,
        max_gap_s: float = 0.1,
    ) -> None:
        channels = (*inputs, *outputs)
        if not channels or not 0 < rate_hz <= _SECOND_NS:
            raise ValueError("a sampler needs a channel and a positive rate")
        self._clock = clock
        self._boot = clock.boot
        self.inputs = len(inputs)
        # Raw signals of a transform count as inputs, and are all there is.
        self.first_measured = len(inputs) if outputs else 0
        self.size = len(channels)
        self.grid = Grid(rate_hz)
        columns: dict[tuple[object, ...], list[Column]] = {}
        for position, channel in enumerate(channels):
            key = (channel.message, channel.where, channel.clock, channel.clock_unit_ns)
            columns.setdefault(key, []).append(Column(position, channel))
        self.streams: dict[str, list[Stream]] = {}
        for group in columns.values():
            channel = group[0].channel
            stream = Stream(channel, Lane(group, round(max_gap_s * _SECOND_NS), round(2.5 * _SECOND_NS / rate_hz)))
            self.streams.setdefault(channel.message, []).append(stream)
        self.lanes = [lane for streams in self.streams.values() for stream in streams for lane in stream.lanes]
        self.waiting: Lane | None = None
        self._held: tuple[Stream, Message, int] | None = None
        self.next_tick: int | None = None
        self._tick_ns = self.due_ns = -1
        self.restarting = True
        self.last_unix: tuple[int, int] | None = None
        self._messages = self._duplicates = self._late = self._invalid = self._untimed = self._doubted = 0
        self._clock_restarts = self._samples = self._incomplete = self._restarts = self._skipped = 0

    @property
    def interests(self) -> frozenset[str]:
        """Names of the messages the channels come from; others are ignored."""
        return frozenset(self.streams)

    @property
    def unsettled(self) -> bool:
        """Whether the next message decides about one held back, or finds that the clock started anew."""
        return self._held is not None or self._boot != self._clock.boot

    def streams_of(self, names: Collection[str]) -> list[tuple[str, Stream]]:
        """Return the streams of some messages, each with the message's name, in the order of messages and streams."""
        return [(name, stream) for name, streams in self.streams.items() if name in names for stream in streams]

    def restart(self) -> None:
        """Mark the next sample as the first of a new stretch."""
        self.restarting = True

    def statistics(self) -> SamplerStatistics:
        """Return the counts so far."""
        return SamplerStatistics(
            messages=self._messages,
            duplicates=self._duplicates,
            late=self._late,
            invalid=self._invalid,
            untimed=self._untimed,
            doubted=self._doubted,
            clock_restarts=self._clock_restarts,
            samples=self._samples,
            incomplete=self._incomplete,
            restarts=self._restarts,
            skipped=self._skipped,
        )

    def feed(self, message: Message) -> list[Sample]:
        """Take one message; return the samples it completes, in order of time."""
        samples: list[Sample] = []
        for stream in self.streams.get(message.name, ()):
            if stream.where and not stream.channel.selects(message.fields):
                continue
            self._messages += 1
            stamp_ns = self._stamp(stream, message)
            if stamp_ns is None:
                self._untimed += 1
            elif stream.knows(stamp_ns):
                self._duplicates += sum(len(lane.columns) for lane in stream.lanes)
            elif stream.clockless or self._believe(stream, message, stamp_ns):
                self._store(stream, message, stamp_ns)
                self._give_out(samples)
        return samples

    def note(self, samples: Samples, messages: int, untimed: int, duplicates: int) -> None:
        """Go on behind a stretch that was taken elsewhere, with the samples it gave."""
        self._messages += messages
        self._untimed += untimed
        self._duplicates += duplicates
        count = len(samples)
        if not count:
            return
        self._samples += count
        self._restarts += self.restarting
        self._incomplete += count - int(np.count_nonzero(samples.complete))
        self.restarting = False
        self._tick_ns = int(samples.vehicle_time_ns[-1])
        self.last_unix = self._tick_ns, int(samples.time_ns[-1])
        self._go_to(int(samples.index[-1]) + 1)

    def _stamp(self, stream: Stream, message: Message) -> int | None:
        stamp_ns = stream.channel.stamp_ns(message.fields)
        newest_ns = self._clock.newest_ns
        stream.clockless = stamp_ns is None
        if stamp_ns is None:
            return newest_ns if stream.channel.clock is None and newest_ns > 0 else None
        if not 0 <= stamp_ns < MAX_STAMP_NS or (stamp_ns == 0 and message.source == "mavlink"):
            return None
        if stamp_ns < newest_ns - _SECOND_NS:
            return self._clock.unwrap(stamp_ns)
        return stamp_ns

    def _believe(self, stream: Stream, message: Message, stamp_ns: int) -> bool:
        held, clock = self._held, self._clock
        agrees = held is not None and not clock.near(stamp_ns)
        if not clock.observe(stamp_ns, message.received_ns):
            self._doubted += held is not None
            self._held = stream, message, stamp_ns
            return False
        if clock.boot != self._boot:
            self._start_anew()
        if held is not None:
            self._held = None
            if agrees or clock.near(held[2]):
                self._store(*held)
            else:
                self._doubted += 1
        return True

    def _start_anew(self) -> None:
        self._boot = self._clock.boot
        self._clock_restarts += 1
        for lane in self.lanes:
            lane.clear()
        self.waiting = self.next_tick = self.last_unix = None
        self._tick_ns = self.due_ns = -1
        self.restarting = True

    def _store(self, stream: Stream, message: Message, stamp_ns: int) -> None:
        for lane in tuple(stream.lanes):
            if lane.stamps and lane.stamps[-1] == stamp_ns:
                self._duplicates += len(lane.columns)
                continue
            row = [column.channel.value(message.fields) for column in lane.columns]
            here = lane
            if None in row:
                missing = row.count(None)
                self._invalid += missing
                if missing == len(row):
                    continue
                here = self._split(stream, lane, row)
            self._insert(here, stamp_ns, [value for value in row if value is not None])

    def _split(self, stream: Stream, lane: Lane, row: Sequence[float | None]) -> Lane:
        """Part the channels that are in a message from those that are not; return the lane of the former."""
        present, absent = lane.split([value is not None for value in row])
        for lanes in (stream.lanes, self.lanes):
            at = lanes.index(lane)
            lanes[at : at + 1] = [present, absent]
        if self.waiting is lane:
            self.waiting = None
        return present

    def _insert(self, lane: Lane, stamp_ns: int, row: list[float]) -> None:
        stamps = lane.stamps
        if not stamps or stamp_ns > stamps[-1]:
            stamps.append(stamp_ns)
            lane.rows.append(row)
            if len(stamps) > CAPACITY:
                lane.drop(CAPACITY // 2)
            return
        place = bisect_left(stamps, stamp_ns)
        if stamps[place] == stamp_ns:
            self._duplicates += len(row)
        elif stamp_ns <= self._tick_ns or len(stamps) >= CAPACITY:
            self._late += len(row)
        else:
            stamps.insert(place, stamp_ns)
            lane.rows.insert(place, row)

    def _give_out(self, samples: list[Sample]) -> None:
        """Give out all ticks for which every lane has a measurement at or after them."""
        while (waiting := self._find_waiting()) is None:
            if self.next_tick is None:
                for lane in self.lanes:
                    lane.settle()
                self._go_to(self.grid.index_at(max(lane.stamps[0] for lane in self.lanes)))
            else:
                self._tick(self.next_tick, self.due_ns, samples)
        self._give_up_waiting(waiting)

    def _find_waiting(self) -> Lane | None:
        """Return a lane without a measurement at or after the next tick; before the first, one not ready."""
        if self.next_tick is None:
            return next((lane for lane in self.lanes if not lane.ready), None)
        due_ns, lane = self.due_ns, self.waiting
        if lane is None or lane.stamps[-1] >= due_ns:
            for lane in self.lanes:
                if lane.stamps[-1] < due_ns:
                    break
            else:
                lane = None
            self.waiting = lane
        return lane

    def _go_to(self, index: int) -> None:
        self.next_tick = index
        self.due_ns = self.grid.time_ns(index)

    def _tick(self, index: int, tick_ns: int, samples: list[Sample]) -> None:
        """Give out one tick, or skip the ticks of the gap it lies in."""
        vector = [0.0] * self.size
        complete, measured, known_ns = True, True, tick_ns
        for lane in self.lanes:
            stamps = lane.stamps
            if len(stamps) > 1 and stamps[1] <= tick_ns:
                lane.pass_to(tick_ns)
            left_ns = stamps[0]
            if left_ns == tick_ns:
                for place, value in zip(lane.places, lane.rows[0], strict=True):
                    vector[place] = value
                continue
            if left_ns > tick_ns:
                self.skip_to(left_ns)
                return
            width_ns = stamps[1] - left_ns
            known_ns = max(known_ns, stamps[1])
            if width_ns > lane.loss_ns:
                if width_ns > lane.gap_ns:
                    self.skip_to(stamps[1])
                    return
                complete = False
                if width_ns > lane.line_ns and lane.places[-1] >= self.first_measured:
                    measured = False
            lane.interpolate((tick_ns - left_ns) / width_ns, vector)
        values = np.array(vector)
        samples.append(
            Sample(
                index=index,
                vehicle_time_ns=tick_ns,
                time_ns=self._unix(tick_ns),
                u=values[: self.inputs],
                y=values[self.inputs :],
                restart=self.restarting,
                complete=complete,
                known_ns=known_ns,
                measured=measured,
            )
        )
        self._samples += 1
        self._restarts += self.restarting
        self._incomplete += not complete
        self.restarting = False
        self._tick_ns = tick_ns
        self._go_to(index + 1)

    def skip_to(self, time_ns: int) -> None:
        """Skip the ticks before a time."""
        index = self.grid.index_at(time_ns)
        if self.next_tick is not None and index > self.next_tick:
            self._skipped += index - self.next_tick
            self._tick_ns = self.grid.time_ns(index - 1)
            self.restarting = True
            self._go_to(index)

    def _give_up_waiting(self, lane: Lane) -> None:
        """Drop what has been waiting too long for a lane that stopped."""
        horizon_ns = self._clock.newest_ns - lane.silence_ns
        if lane.stamps and lane.stamps[-1] >= horizon_ns:
            return
        self.skip_to(horizon_ns)
        for other in self.lanes:
            if len(other.stamps) > 1 and other.stamps[1] <= horizon_ns:
                other.pass_to(horizon_ns)

    def _unix(self, tick_ns: int) -> int:
        """Return a tick's Unix time, which never stands still while the clock's offset is being corrected."""
        unix_ns = self._clock.to_unix(tick_ns)
        if self.last_unix is not None:
            last_tick_ns, last_unix_ns = self.last_unix
            least_ns = last_unix_ns + (tick_ns - last_tick_ns) // 2
            if 0 < least_ns - unix_ns < _SECOND_NS:
                unix_ns = least_ns
        self.last_unix = tick_ns, unix_ns
        return unix_ns
