"""Delivers notices off the main thread: each outlet has a queue and a thread, limits its rate and retries.

While an outlet pauses after messages or after a failure, new notices wait and are sent as one summary: a fleet's flood
of alarms makes a few messages.
"""

import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

from monitor.event import AlarmEvent
from monitor.notify.notices import OCCASIONS, Notice, Notices, Occasion
from monitor.notify.outlets import DeliveryError, Outlet

MAX_WAITING = 200
"""Largest number of notices that wait for an outlet; beyond it the oldest are dropped and counted. Chosen: more than a
summary can list."""
BURST = 3
"""Messages sent at once before the limit of the rate applies. Chosen: an alarm, its consequence, and that they
cleared."""
GATHER_S = 0.5
"""Seconds for which notices are gathered. Chosen: the consequences of one cause follow within it and make one message;
nobody notices the delay."""
FIRST_RETRY_S, LAST_RETRY_S = 1.0, 300.0
"""Seconds between tries, doubled from the first to the last. Chosen: a service that is down for an hour is tried often
enough, and not all the time."""
_CLOSE_S = 3.0
"""Seconds that a message in progress may take at the end. Chosen: systemd waits 90 s."""


@dataclass(frozen=True, slots=True)
class OutletHealth:
    """Counts of an outlet's messages."""

    name: str
    sent: int = 0  # messages
    failed: int = 0  # tries
    dropped: int = 0  # notices that were never delivered
    waiting: int = 0  # notices


class Messenger:
    """Notifies people of alarm events until closed; :meth:`event` never waits.

    ``per_minute`` is the largest rate of messages of each outlet; ``on_failure`` is called with an outlet's name and
    the reason, in its thread, when a message fails and when the next one succeeds (reason None).
    """

    def __init__(
        self,
        outlets: Sequence[Outlet],
        occasions: Collection[Occasion] = OCCASIONS,
        per_minute: float = 6.0,
        on_failure: Callable[[str, str | None], None] = lambda name, reason: None,
    ) -> None:
        self._notices = Notices(occasions)
        self._workers = [_Worker(outlet, 60.0 / per_minute, on_failure) for outlet in outlets]

    def event(self, event: AlarmEvent) -> None:
        """Process an alarm event."""
        if (notice := self._notices.take(event)) is not None:
            for worker in self._workers:
                worker.put(notice)

    def health(self) -> tuple[OutletHealth, ...]:
        """Return the counts of each outlet."""
        return tuple(worker.health() for worker in self._workers)

    def close(self) -> None:
        """Send the waiting notices, with one try, and end."""
        for worker in self._workers:
            worker.close()
        until = time.monotonic() + _CLOSE_S
        for worker in self._workers:
            worker.join(max(0.0, until - time.monotonic()))


class _Worker:
    """The queue and the thread of one outlet."""

    def __init__(self, outlet: Outlet, period_s: float, on_failure: Callable[[str, str | None], None]) -> None:
        self._outlet, self._period_s, self._on_failure = outlet, period_s, on_failure
        self._changed = threading.Condition()
        self._waiting: deque[Notice] = deque()
        self._closing = False
        self._sent = self._failed = self._dropped = 0
        self._thread = threading.Thread(target=self._run, name=f"notify {outlet.name}", daemon=True)
        self._thread.start()

    def put(self, notice: Notice) -> None:
        with self._changed:
            self._waiting.append(notice)
            self._make_room()
            self._changed.notify()

    def health(self) -> OutletHealth:
        with self._changed:
            return OutletHealth(self._outlet.name, self._sent, self._failed, self._dropped, len(self._waiting))

    def close(self) -> None:
        with self._changed:
            self._closing = True
            self._changed.notify()

    def join(self, timeout_s: float) -> None:
        self._thread.join(timeout_s)

    def _run(self) -> None:
        # the time of the next message if all had come evenly: at most a burst ahead of now
        even_s, retry_s, due_s = time.monotonic(), FIRST_RETRY_S, 0.0
        while (notices := self._take(max(due_s, even_s - (BURST - 1) * self._period_s))) is not None:
            failure = self._send(notices)
            now_s = time.monotonic()
            if failure is None:
                if retry_s > FIRST_RETRY_S:
                    self._on_failure(self._outlet.name, None)
                even_s, retry_s, due_s = max(even_s, now_s) + self._period_s, FIRST_RETRY_S, 0.0
            elif not self._closing:
                self._on_failure(self._outlet.name, failure)
                due_s, retry_s = now_s + retry_s, min(2 * retry_s, LAST_RETRY_S)

    def _take(self, due_s: float) -> list[Notice] | None:
        """Wait for notices and for the time to send; return them, or None at the end."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._closing)
            until_s = max(due_s, time.monotonic() + GATHER_S)
            while not self._closing and (left_s := until_s - time.monotonic()) > 0:
                self._changed.wait(left_s)
            notices = list(self._waiting)
            self._waiting.clear()
        return notices or None

    def _send(self, notices: list[Notice]) -> str | None:
        """Send notices; if that fails, keep them and return the reason."""
        try:
            self._outlet.send(notices)
        except DeliveryError as error:
            reason = str(error)
        except Exception as error:  # a plug-in may raise anything
            reason = type(error).__name__
        else:
            with self._changed:
                self._sent += 1
            return None
        with self._changed:
            self._failed += 1
            self._waiting.extendleft(reversed(notices))
            self._make_room()
            if self._closing:
                self._dropped += len(self._waiting)
                self._waiting.clear()
        return reason

    def _make_room(self) -> None:
        while len(self._waiting) > MAX_WAITING:
            self._waiting.popleft()
            self._dropped += 1
