"""Bounded queues between the links' threads and the monitor, one for each sender: what is too much or too old goes.

So one vehicle that floods, or a monitor that cannot keep up, costs what it must, counted, and nothing that is a second
old is looked at any more: a monitor that shows the past as the present is worse than one with gaps.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, Protocol

from adapters.batch import Batch, Columns, chosen, cut, memory_bytes, sender_of
from adapters.link_figures import LinkFigures, LinkMeter
from adapters.message import Message

_POLL_S = 0.2
"""How long a link waits for telemetry before its thread looks whether it is to end; closing waits that long."""
_STUCK_S = 5.0
"""A link comes back every 0.2 s, or after a connection attempt of 1 s: longer than this it hangs."""
_COLLECTED_S = 0.1
"""How long links collect what comes while the loop is behind: few large batches cost less than many small ones. Chosen:
less than half of what ``datagrams.pyx`` waits for its reader."""
_AFTER_ERROR_S = 0.2
"""Chosen: a link that fails at once again does not fill the log or a core."""
_TURN = 1024
"""Messages of one sender in a turn: 25 ms of work, three seconds of a vehicle. What is due in between (status,
watchdog, election) is not held up by a backlog, nor are the others by one that floods."""


class Link(Protocol):
    """A source of batches."""

    def receive(self, timeout_s: float) -> Batch:
        """Return what has arrived, waiting at most ``timeout_s`` for the first message; it may be empty."""
        ...


class Arrival(NamedTuple):
    """A batch and the vehicle whose own link it came over; None: of a link that vehicles share."""

    vehicle: str | None
    batch: Batch


@dataclass(frozen=True, slots=True)
class InboxStatistics:
    """What went through an inbox so far."""

    arrived: int  # messages put in
    dropped: int  # those among them that were dropped because the monitor did not keep up
    waiting: int  # messages in it now
    errors: int  # exceptions of links; they went on afterwards


OLDEST_S = 1.0
"""What has waited longer, here or in the kernel, is dropped by a monitor that watches, and a round of all senders is to
take no longer. Chosen: half of what an operator may be told late."""
_LEAST_KEPT_S = 0.05
"""What of a sender is always kept of a round. Chosen: two batches of 20 ms and a half."""
_SIGN_OF_LIFE_S = 0.5
"""Of what is dropped for its age a message is kept so often, so that telemetry that had to wait is not taken for
silence, which begins at ``stale_s``, a second at least."""
_MOST_BYTES = 1 << 26
"""Memory of all that waits: 64 MB, ten times what 20,000 messages of MAVLink take."""
_TURN_BYTES = 1 << 22
"""Memory after which a turn ends, too: 4 MB, of JSON in some 0.1 s."""
_LONGEST_WAIT_S = 10.0
"""A message that seems to have waited longer in the kernel came before the clock was set."""
_MOST_SENDERS = 512
"""Twice the system ids of MAVLink; names of vehicles with a link of their own come from the configuration."""


class _Waiting(NamedTuple):
    """A batch that waits: since when by the monotonic clock, and its memory."""

    since_s: float
    size: int
    arrival: Arrival


class _Queue:
    """What waits of one sender."""

    def __init__(self) -> None:
        self.entries: deque[_Waiting] = deque()
        self.count = 0
        self.size = 0
        self.shown_s = 0.0
        self.kept_s = OLDEST_S
        self.waited_s = _LEAST_KEPT_S

    def put(self, entry: _Waiting) -> None:
        self.entries.append(entry)
        self.count += entry.arrival.batch.count
        self.size += entry.size

    def take(self) -> _Waiting:
        entry = self.entries.popleft()
        self.count -= entry.arrival.batch.count
        self.size -= entry.size
        return entry


class Inbox:
    """Collects the batches of all links, each sender's in the order in which they arrive.

    ``limit`` messages wait in all at most, and 64 MB: of more the sender with the most loses its oldest. What has
    waited for more than ``oldest_s`` seconds is dropped when its turn comes; None drops nothing for its age.
    """

    def __init__(self, limit: int, oldest_s: float | None = None) -> None:
        self._queues: dict[tuple[str | None, int | None], _Queue] = {}
        self._size = 0
        self._oldest_s = oldest_s
        self.limit = limit
        lock = threading.Lock()
        self._changed = threading.Condition(lock)
        self._emptied = threading.Condition(lock)
        self._closed = False
        self._threads: list[threading.Thread] = []
        self._answered: dict[str, float] = {}
        self._meters: dict[str, LinkMeter] = {}
        self._waiting = self._arrived = self._dropped = self._errors = 0

    def listen(self, name: str, link: Link, vehicle: str | None = None) -> None:
        """Read a link in a thread of its own until the inbox is closed; closing the link afterwards is the caller's.

        ``name`` is the link's for :meth:`stuck`, ``vehicle`` the name of the vehicle whose own link it is.
        """
        thread = threading.Thread(target=self._read, args=(name, link, vehicle), name=f"link {name}", daemon=True)
        self._threads.append(thread)
        self._answered[name] = time.monotonic()
        self._meters[name] = LinkMeter()
        thread.start()

    def figures(self, name: str, received: int, lost: int | None) -> LinkFigures:
        """Return what a link does to its telemetry, having numbered and ``lost`` so many packets."""
        meter = self._meters.get(name)
        return LinkFigures() if meter is None else meter.figures(received, lost)

    def put(self, batch: Batch, vehicle: str | None = None) -> None:
        """Add a batch; the oldest waiting messages of the sender that has the most make room."""
        if not batch.count:
            return
        now_s = time.monotonic()
        parts = [(key, part, memory_bytes(part), now_s - _waited_s(part)) for key, part in _by_sender(batch)]
        with self._changed:
            for key, part, size, since_s in parts:
                self._arrived += part.count
                queue = self._queues.get((vehicle, key))
                if queue is None:
                    if len(self._queues) >= _MOST_SENDERS:
                        self._queues = {key: queue for key, queue in self._queues.items() if queue.entries}
                    queue = self._queues[vehicle, key] = _Queue()
                queue.put(_Waiting(since_s, size, Arrival(vehicle, part)))
                self._waiting += part.count
                self._size += size
            while (excess := self._waiting - self.limit) > 0:
                self._drop(max(self._queues.values(), key=lambda queue: queue.count), excess)
            while self._size > _MOST_BYTES:
                self._drop(max(self._queues.values(), key=lambda queue: queue.size), self.limit)
            self._changed.notify()

    def take(self, timeout_s: float) -> list[Arrival]:
        """Return what waits of the sender whose turn it is, in order, waiting at most ``timeout_s`` for any.

        About 1024 messages at most; what is left waits until all others have had their turn.
        """
        with self._changed:
            if not self._waiting:
                self._changed.wait(timeout_s)
            key = next((key for key, queue in self._queues.items() if queue.entries), None)
            if key is None:
                return []
            queue = self._queues[key] = self._queues.pop(key)
            taken = [] if self._oldest_s is None else self._shed(queue, self._oldest_s)
            count = size = 0
            while queue.entries and count < _TURN and size < _TURN_BYTES:
                entry = self._next(queue)
                taken.append(entry.arrival)
                count += entry.arrival.batch.count
                size += entry.size
            if not self._waiting:
                self._emptied.notify_all()
            return taken

    def _next(self, queue: _Queue) -> _Waiting:
        entry = queue.take()
        self._waiting -= entry.arrival.batch.count
        self._size -= entry.size
        return entry

    def _drop(self, queue: _Queue, excess: int) -> None:
        """Drop the oldest batch of a queue, or so many of its messages."""
        entry = self._next(queue)
        batch = entry.arrival.batch
        self._dropped += min(excess, batch.count)
        if excess < batch.count:
            rest = cut(batch, excess, batch.count)
            kept = _Waiting(entry.since_s, entry.size, entry.arrival._replace(batch=rest))
            queue.entries.appendleft(kept)
            queue.count += rest.count
            queue.size += kept.size
            self._waiting += rest.count
            self._size += kept.size

    def _shed(self, queue: _Queue, oldest_s: float) -> list[Arrival]:
        """Drop what is too old; return the messages of it that are kept as signs of life.

        What waits came since the sender's turn before. Where two were longer ago than ``oldest_s``, one after the
        other, less of each sender is kept, so that the next round takes as long.
        """
        now_s = time.monotonic()
        before_s, queue.waited_s = queue.waited_s, max(now_s - queue.entries[0].since_s, _LEAST_KEPT_S)
        queue.kept_s *= oldest_s / min(before_s, queue.waited_s)
        queue.kept_s = min(max(queue.kept_s, _LEAST_KEPT_S), oldest_s)
        kept = []
        while queue.entries and now_s - queue.entries[0].since_s > queue.kept_s:
            entry = self._next(queue)
            self._dropped += entry.arrival.batch.count
            if entry.since_s - queue.shown_s >= _SIGN_OF_LIFE_S:
                queue.shown_s = entry.since_s
                kept.append(entry.arrival._replace(batch=cut(entry.arrival.batch, 0, 1)))
                self._dropped -= 1
        return kept

    @property
    def empty(self) -> bool:
        """Whether nothing waits."""
        return not self._waiting

    def stuck(self) -> tuple[str, ...]:
        """Return the names of links whose thread has not come back for 5 s."""
        now = time.monotonic()
        return tuple(name for name, at in self._answered.items() if now - at > _STUCK_S)

    @property
    def unread_s(self) -> float:
        """Seconds since which telemetry may wait in a link unread, those that do not answer left out."""
        now = time.monotonic()
        return max((now - at for at in self._answered.values() if now - at <= _STUCK_S), default=0.0)

    def statistics(self) -> InboxStatistics:
        """Return the counts so far."""
        return InboxStatistics(self._arrived, self._dropped, self._waiting, self._errors)

    def close(self) -> None:
        """Stop reading; what waits stays."""
        self._closed = True
        for thread in self._threads:
            thread.join(2 * _POLL_S + 1.0)

    def _read(self, name: str, link: Link, vehicle: str | None) -> None:
        while not self._closed:
            try:
                batch = link.receive(_POLL_S)
                self._meters[name].count(batch)
                self.put(batch, vehicle)
                if self._waiting > batch.count:
                    # Not for what was put just now: it is taken while the link waits for more.
                    with self._emptied:
                        self._emptied.wait_for(lambda: self._closed or not self._waiting, _COLLECTED_S)
            except Exception:
                # Whatever a link meets, monitoring of the others goes on.
                self._errors += 1
                logging.getLogger(__name__).exception("link %s failed; it is read again", name)
                time.sleep(_AFTER_ERROR_S)
            self._answered[name] = time.monotonic()


def _waited_s(batch: Batch) -> float:
    """Return for how long the first message of a batch has waited in the kernel, seconds."""
    first_ns = min(
        *(int(columns.received_ns[0]) for columns in batch.columns),
        *(message.received_ns for message in batch.others.values()),
        time.time_ns(),
        time.time_ns(),
    )
    waited_s = (time.time_ns() - first_ns) / 1e9
    return waited_s if waited_s < _LONGEST_WAIT_S else 0.0


def _by_sender(batch: Batch) -> list[tuple[int | None, Batch]]:
    """Return the parts of a batch by system id; None stands for sources without."""
    systems = set(map(sender_of, batch.entries))
    if len(systems) == 1:
        return [(systems.pop(), batch)]
    return [(system, chosen(batch, partial(_is_of, system))) for system in systems]


def _is_of(system: int | None, entry: Columns | Message) -> bool:
    return sender_of(entry) == system
