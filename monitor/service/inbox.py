"""One bounded queue between the links' threads and the monitor: when it is full the oldest messages go, counted."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from adapters.batch import Batch, cut
from adapters.link_figures import LinkFigures, LinkMeter

_POLL_S = 0.2
"""How long a link waits for telemetry before its thread looks whether it is to end; closing waits that long."""
_STUCK_S = 5.0
"""A link comes back every 0.2 s, or after a connection attempt of 1 s: longer than this it hangs."""
_AFTER_ERROR_S = 0.2
"""Chosen: a link that fails at once again does not fill the log or a core."""
_TURN = 4096
"""Messages after which :meth:`Inbox.take` returns: about 0.1 s of work, so that what is due in between (status,
watchdog, election) is not held up by a backlog."""


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


class Inbox:
    """Collects the batches of all links in the order in which they arrive, ``limit`` messages in all at most."""

    def __init__(self, limit: int) -> None:
        self._queue: deque[Arrival] = deque()
        self.limit = limit
        self._changed = threading.Condition()
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
        """Add a batch; the oldest waiting messages make room."""
        if not batch.count:
            return
        with self._changed:
            self._queue.append(Arrival(vehicle, batch))
            self._arrived += batch.count
            self._waiting += batch.count
            while (excess := self._waiting - self.limit) > 0:
                oldest = self._queue.popleft()
                dropped = min(excess, oldest.batch.count)
                if dropped < oldest.batch.count:
                    rest = cut(oldest.batch, dropped, oldest.batch.count)
                    self._queue.appendleft(oldest._replace(batch=rest))
                self._dropped += dropped
                self._waiting -= dropped
            self._changed.notify()

    def take(self, timeout_s: float) -> list[Arrival]:
        """Return batches in order of arrival, waiting at most ``timeout_s`` for the first.

        A backlog is returned in portions of about 4096 messages.
        """
        with self._changed:
            if not self._queue:
                self._changed.wait(timeout_s)
            taken: list[Arrival] = []
            count = 0
            while self._queue and count < _TURN:
                taken.append(self._queue.popleft())
                count += taken[-1].batch.count
            self._waiting -= count
            return taken

    @property
    def empty(self) -> bool:
        """Whether nothing waits."""
        return not self._queue

    def stuck(self) -> tuple[str, ...]:
        """Return the names of links whose thread has not come back for 5 s."""
        now = time.monotonic()
        return tuple(name for name, at in self._answered.items() if now - at > _STUCK_S)

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
            except Exception:
                # Whatever a link meets, monitoring of the others goes on.
                self._errors += 1
                logging.getLogger(__name__).exception("link %s failed; it is read again", name)
                time.sleep(_AFTER_ERROR_S)
            self._answered[name] = time.monotonic()
