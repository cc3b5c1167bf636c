"""One bounded queue between the links' threads and the monitor: when it is full the oldest message goes, counted."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from adapters.message import Message

_POLL_S = 0.2
_STUCK_S = 5.0
_AFTER_ERROR_S = 0.2
_TURN = 512


class Link(Protocol):
    """Where messages come from."""

    def receive(self, timeout_s: float) -> list[Message]:
        """Return the messages that are there, waiting at most ``timeout_s`` for the first."""
        ...


class Arrival(NamedTuple):
    """A message and the vehicle whose own link it came over; None: of a link that vehicles share."""

    vehicle: str | None
    message: Message


@dataclass(frozen=True, slots=True)
class InboxStatistics:
    """What went through an inbox so far.

    Parameters
    ----------
    arrived, dropped : int
        Messages put in, and those dropped because the monitor did not keep up.
    waiting : int
        Messages in it now.
    errors : int
        Exceptions of links; they went on afterwards.
    """

    arrived: int
    dropped: int
    waiting: int
    errors: int


class Inbox:
    """Collects the messages of all links, in the order in which they arrive.

    Parameters
    ----------
    limit : int
        Largest number of messages waiting.
    """

    def __init__(self, limit: int) -> None:
        self._queue: deque[Arrival] = deque()
        self.limit = limit
        self._changed = threading.Condition()
        self._closed = False
        self._threads: list[threading.Thread] = []
        self._answered: dict[str, float] = {}
        self._arrived = self._dropped = self._errors = 0

    def listen(self, name: str, link: Link, vehicle: str | None = None) -> None:
        """Read a link in a thread of its own until the inbox is closed.

        Parameters
        ----------
        name : str
            The link's name, for :meth:`stuck`.
        link : Link
            The link; closing it afterwards is the caller's.
        vehicle : str | None
            Name of the vehicle whose own link it is.
        """
        thread = threading.Thread(target=self._read, args=(name, link, vehicle), name=f"link {name}", daemon=True)
        self._threads.append(thread)
        self._answered[name] = time.monotonic()
        thread.start()

    def put(self, messages: Sequence[Message], vehicle: str | None = None) -> None:
        """Add messages; the oldest waiting ones make room."""
        if not messages:
            return
        with self._changed:
            self._queue.extend(Arrival(vehicle, message) for message in messages)
            self._arrived += len(messages)
            while len(self._queue) > self.limit:
                self._queue.popleft()
                self._dropped += 1
            self._changed.notify()

    def take(self, timeout_s: float) -> list[Arrival]:
        """Return some messages in order of arrival, waiting at most ``timeout_s`` for the first."""
        with self._changed:
            if not self._queue:
                self._changed.wait(timeout_s)
            return [self._queue.popleft() for _ in range(min(len(self._queue), _TURN))]

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
        return InboxStatistics(self._arrived, self._dropped, len(self._queue), self._errors)

    def close(self) -> None:
        """Stop reading; what waits stays."""
        self._closed = True
        for thread in self._threads:
            thread.join(2 * _POLL_S + 1.0)

    def _read(self, name: str, link: Link, vehicle: str | None) -> None:
        while not self._closed:
            try:
                self.put(link.receive(_POLL_S), vehicle)
            except Exception:
                # Whatever a link meets, monitoring of the others goes on.
                self._errors += 1
                logging.getLogger(__name__).exception("link %s failed; it is read again", name)
                time.sleep(_AFTER_ERROR_S)
            self._answered[name] = time.monotonic()
