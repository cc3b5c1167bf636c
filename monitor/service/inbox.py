"""Bounded queues between the links' threads and the monitor, one for each sender.

Messages that are too many or too old are dropped and counted. So a vehicle that floods costs only itself, and a monitor
that cannot keep up never processes messages older than a second: showing the past as the present is worse than gaps.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections import deque
from dataclasses import dataclass
from functools import partial
from queue import Empty, SimpleQueue
from typing import NamedTuple, Protocol

from adapters.batch import Batch, Columns, chosen, cut, memory_bytes, sender_of
from adapters.link_figures import LinkFigures, LinkMeter
from adapters.message import Message

_POLL_S = 0.2
"""How long a link waits for telemetry before its thread checks whether it is to end; closing waits as long."""
_STUCK_S = 5.0
"""A link returns every 0.2 s, or after a connection attempt of 1 s: after this time it counts as hanging."""
_COLLECTED_S = 0.1
"""How long links collect messages while the loop lags: few large batches cost less than many small ones. Chosen: less
than half of what ``datagrams.pyx`` waits for its reader."""
_AFTER_ERROR_S = 0.2
"""Pause after an error. Chosen: a link that fails again at once fills neither the log nor a core."""
_TURN = 1024
"""Messages of one sender in a turn: 25 ms of work, three seconds of a vehicle. A backlog therefore does not delay the
work in between (status, watchdog, election), and a sender that floods does not delay the others."""


class Link(Protocol):
    """A source of batches."""

    def receive(self, timeout_s: float) -> Batch:
        """Return the messages that have arrived, waiting at most ``timeout_s`` for the first.

        The batch may be empty.
        """
        ...


class Arrival(NamedTuple):
    """A batch, and the vehicle whose own link it came over; None: the link is shared."""

    vehicle: str | None
    batch: Batch


@dataclass(frozen=True, slots=True)
class InboxStatistics:
    """Counts of an inbox since the start."""

    arrived: int  # messages put in
    dropped: int  # messages dropped because the monitor did not keep up
    waiting: int  # messages in it now
    errors: int  # exceptions of links, which went on afterwards


OLDEST_S = 1.0
"""A live monitor drops messages that have waited for longer, here or in the kernel; a round of all senders is to take
no longer. Chosen: half of what an operator may be told late."""
_LEAST_KEPT_S = 0.05
"""Time of a round of which a sender's messages are always kept. Chosen: two and a half batches of 20 ms."""
_SIGN_OF_LIFE_S = 0.5
"""Of messages that are dropped, one of each sender is kept this often, and a heartbeat, so that what flows is not
taken for silence, which begins at ``stale_s``, a second at least."""
_MOST_SIGNS = 16
"""Most of these that wait for a sender's turn: those of 5 s, with a heartbeat a second."""
_LARGE_BYTES = 1 << 18
"""Memory of a large batch: 256 kB, some 2,000 messages of MAVLink."""
_MOST_BYTES = 1 << 26
"""Memory of all waiting messages: 64 MB, ten times what 20,000 messages of MAVLink take."""
_TURN_BYTES = 1 << 22
"""Memory after which a turn ends: 4 MB, some 0.1 s of JSON."""
_LONGEST_WAIT_S = 10.0
"""A message that seems to have waited for longer in the kernel came before the clock was set."""
_MOST_SENDERS = 512
"""Most senders: twice the system ids of MAVLink. Names of vehicles with a link of their own come from the
configuration."""


class _Waiting(NamedTuple):
    """A waiting batch: since when by the monotonic clock, and its memory."""

    since_s: float
    size: int
    arrival: Arrival


class _Queue:
    """The waiting batches of one sender."""

    def __init__(self) -> None:
        self.entries: deque[_Waiting] = deque()
        self.count = 0
        self.size = 0
        self.shown_s = self.beat_s = 0.0
        self.signs: deque[Arrival] = deque(maxlen=_MOST_SIGNS)
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

    At most ``limit`` messages and 64 MB wait in all; if there is more, the sender with the most loses its oldest.
    Messages that have waited for more than ``oldest_s`` seconds are dropped when their sender has its turn; None drops
    none for its age.
    """

    def __init__(self, limit: int, oldest_s: float | None = None) -> None:
        self._queues: dict[tuple[str | None, int | None], _Queue] = {}
        self._size = 0
        self._oldest_s = oldest_s
        self.limit = limit
        # Holds something while messages may wait: a queue wakes the loop at less cost than a condition.
        self._signal: SimpleQueue[None] = SimpleQueue()
        self._emptied = threading.Condition(threading.Lock())
        self._closed = False
        self._threads: list[threading.Thread] = []
        self._answered: dict[str, float] = {}
        self._meters: dict[str, LinkMeter] = {}
        self._waiting = self._arrived = self._dropped = self._errors = 0

    def listen(self, name: str, link: Link, vehicle: str | None = None) -> None:
        """Read a link in a thread of its own until the inbox is closed; the caller closes the link afterwards.

        ``name`` is the link's name in :meth:`stuck`, ``vehicle`` the name of the vehicle whose own link it is.
        """
        thread = threading.Thread(target=self._read, args=(name, link, vehicle), name=f"link {name}", daemon=True)
        self._threads.append(thread)
        self._answered[name] = time.monotonic()
        self._meters[name] = LinkMeter()
        thread.start()

    def figures(self, name: str, received: int, lost: int | None) -> LinkFigures:
        """Return a link's figures, given the number of packets received and of those ``lost`` by their numbers."""
        meter = self._meters.get(name)
        return LinkFigures() if meter is None else meter.figures(received, lost)

    def put(self, batch: Batch, vehicle: str | None = None) -> None:
        """Add a batch; the oldest waiting messages of the sender that has the most make room."""
        if not batch.count:
            return
        now_s = time.monotonic()
        parts = [(key, part, memory_bytes(part), now_s - _waited_s(part)) for key, part in _by_sender(batch)]
        with self._emptied:
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
            if self._signal.empty():
                self._signal.put(None)

    def take(self, timeout_s: float) -> list[Arrival]:
        """Return the waiting messages of the sender whose turn it is, in order.

        Wait at most ``timeout_s`` for any. Return about 1024 messages at most; the rest waits until all others have had
        their turn.
        """
        with contextlib.suppress(Empty):
            self._signal.get(timeout=timeout_s)
        with self._emptied:
            key = next((key for key, queue in self._queues.items() if queue.entries), None)
            if key is None:
                return []
            queue = self._queues[key] = self._queues.pop(key)
            if self._oldest_s is not None:
                self._shed(queue, self._oldest_s)
            taken = [*queue.signs]
            queue.signs.clear()
            count = size = 0
            while queue.entries and count < _TURN and size < _TURN_BYTES:
                entry = self._next(queue)
                taken.append(entry.arrival)
                count += entry.arrival.batch.count
                size += entry.size
            if self._waiting:
                self._signal.put(None)
            else:
                self._emptied.notify_all()
            return taken

    def _next(self, queue: _Queue) -> _Waiting:
        entry = queue.take()
        self._waiting -= entry.arrival.batch.count
        self._size -= entry.size
        return entry

    def _drop(self, queue: _Queue, excess: int) -> None:
        """Drop the oldest batch of a queue, or ``excess`` of its messages."""
        entry = self._next(queue)
        batch = entry.arrival.batch
        self._forget(queue, entry, min(excess, batch.count))
        if excess < batch.count:
            rest = cut(batch, excess, batch.count)
            kept = _Waiting(entry.since_s, entry.size, entry.arrival._replace(batch=rest))
            queue.entries.appendleft(kept)
            queue.count += rest.count
            queue.size += kept.size
            self._waiting += rest.count
            self._size += kept.size

    def _forget(self, queue: _Queue, entry: _Waiting, count: int) -> None:
        """Count the first messages of a batch as dropped; keep one, and a heartbeat, where signs of life are due.

        None of a large batch: it would keep the memory of the whole.
        """
        self._dropped += count
        if self._oldest_s is None or entry.size > _LARGE_BYTES:
            return
        batch, since_s = entry.arrival.batch, entry.since_s
        beat = next((int(one.position[0]) for one in batch.columns if one.name == "HEARTBEAT"), count)
        due = set()
        if since_s - queue.shown_s >= _SIGN_OF_LIFE_S:
            queue.shown_s = since_s
            due.add(0)
        if beat < count and since_s - queue.beat_s >= _SIGN_OF_LIFE_S:
            queue.beat_s = since_s
            due.add(beat)
        self._dropped -= len(due)
        queue.signs.extend(entry.arrival._replace(batch=cut(batch, at, at + 1)) for at in sorted(due))

    def _shed(self, queue: _Queue, oldest_s: float) -> None:
        """Drop messages that are too old.

        All waiting messages arrived since the sender's previous turn. If two turns in a row were longer ago than
        ``oldest_s``, less of each sender is kept, so that the next round takes at most ``oldest_s``.
        """
        now_s = time.monotonic()
        before_s, queue.waited_s = queue.waited_s, max(now_s - queue.entries[0].since_s, _LEAST_KEPT_S)
        queue.kept_s *= oldest_s / min(before_s, queue.waited_s)
        queue.kept_s = min(max(queue.kept_s, _LEAST_KEPT_S), oldest_s)
        while queue.entries and now_s - queue.entries[0].since_s > queue.kept_s:
            entry = self._next(queue)
            self._forget(queue, entry, entry.arrival.batch.count)

    @property
    def empty(self) -> bool:
        """Whether nothing waits."""
        return not self._waiting

    def stuck(self) -> tuple[str, ...]:
        """Return the names of links whose thread has not answered for 5 s."""
        now = time.monotonic()
        return tuple(name for name, at in self._answered.items() if now - at > _STUCK_S)

    @property
    def unread_s(self) -> float:
        """Seconds for which telemetry may have waited unread in a link; links that hang are left out."""
        now = time.monotonic()
        return max((now - at for at in self._answered.values() if now - at <= _STUCK_S), default=0.0)

    def statistics(self) -> InboxStatistics:
        """Return the counts so far."""
        return InboxStatistics(self._arrived, self._dropped, self._waiting, self._errors)

    def close(self) -> None:
        """Stop reading; waiting messages stay."""
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
                    # Not for the batch of just now: the loop takes it while the link waits for more.
                    with self._emptied:
                        self._emptied.wait_for(lambda: self._closed or not self._waiting, _COLLECTED_S)
            except Exception:
                # Whatever happens to a link, monitoring of the others goes on.
                self._errors += 1
                logging.getLogger(__name__).exception("link %s failed; it is read again", name)
                time.sleep(_AFTER_ERROR_S)
            self._answered[name] = time.monotonic()


def _waited_s(batch: Batch) -> float:
    """Return how long the first message of a batch has waited in the kernel, seconds."""
    now_ns = time.time_ns()
    times_ns = [int(columns.received_ns[0]) for columns in batch.columns]
    waited_s = (now_ns - min([now_ns, *times_ns, *(one.received_ns for one in batch.others.values())])) / 1e9
    return waited_s if waited_s < _LONGEST_WAIT_S else 0.0


def _by_sender(batch: Batch) -> list[tuple[int | None, Batch]]:
    """Return the parts of a batch by system id; None is for sources without ids."""
    systems = set(map(sender_of, batch.entries))
    if len(systems) == 1:
        return [(systems.pop(), batch)]
    return [(system, chosen(batch, partial(_is_of, system))) for system in systems]


def _is_of(system: int | None, entry: Columns | Message) -> bool:
    return sender_of(entry) == system
