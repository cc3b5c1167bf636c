"""Alarm events of one or all vehicles from Zenoh, the current state first."""

import contextlib
import threading
from collections import deque
from typing import Any

import zenoh
from zenoh import ext

from monitor.bus.keys import ANY, vehicle_of, vehicle_root
from monitor.bus.payload import decode_payload
from monitor.bus.seal import Seal
from monitor.event import AlarmEvent, valid_event

HELD_EVENTS = 10_000
"""Most events that wait for the reader. Chosen: more than twice the history of a monitor."""
HISTORY_TIMEOUT_S = 1.0
"""Longest wait for an answer. Chosen: an answer on a network takes milliseconds; a monitor that gives none is asked
again."""
HISTORY_TRIES = 10
"""Number of attempts. Chosen: with pause and timeout up to twelve seconds, for routers and routes that come up after
the monitor."""
HISTORY_PAUSE_S = 0.2
"""Pause between attempts. Chosen: an announced monitor may declare its queryable a moment later."""


class AlarmSubscriber:
    """Collects alarm events; the reader takes them one by one.

    Parameters
    ----------
    session : zenoh.Session
        An open session; left open by :meth:`close`.
    vehicle : str
        Name of the vehicle, ``"*"`` for all.
    prefix : str
        What the keys begin with.
    history : bool
        Begin with the past events the monitor still knows, and not only with the latest of each channel.
    seal : Seal | None
        Take only what has its proof.

    Attributes
    ----------
    invalid : int
        Payloads that were no alarm events, or had no proof.
    lost : int
        Events dropped because the reader did not take them.

    Raises
    ------
    UsageError
        The vehicle's name or the prefix cannot be part of a key.
    """

    def __init__(
        self,
        session: zenoh.Session,
        vehicle: str = ANY,
        prefix: str = "fauio",
        history: bool = False,
        seal: Seal | None = None,
    ) -> None:
        self._seal = seal
        self.invalid = 0
        self.lost = 0
        self._session = session
        self._closed = False
        self._root = vehicle_root(prefix, vehicle)
        self._history = history
        self._changed = threading.Condition()
        self._events: deque[AlarmEvent] = deque()
        self._seen: dict[tuple[str, str, int, str], None] = {}
        self._live: set[str] = set()
        self._told: set[str] = set()
        self._held: deque[AlarmEvent] = deque(maxlen=HELD_EVENTS)
        # with the history asked for, the latest events would come twice and too early
        latest = None if history else ext.HistoryConfig(detect_late_publishers=True, max_samples=1)
        self._alarms: Any = ext.declare_advanced_subscriber(
            session,
            f"{self._root}/alarm/**",
            self._on_alarm,
            history=latest,
            recovery=ext.RecoveryConfig(heartbeat=True, periodic_queries=None),
        )
        self._tokens: Any = session.liveliness().declare_subscriber(f"{self._root}/live", self._on_token, history=True)

    @property
    def live(self) -> frozenset[str]:
        """Names of the vehicles with a live monitor."""
        with self._changed:
            return frozenset(self._live)

    def receive(self, timeout_s: float) -> AlarmEvent | None:
        """Return the next event, or None if none came in time."""
        with self._changed:
            self._changed.wait_for(lambda: self._events, timeout_s)
            return self._events.popleft() if self._events else None

    def close(self) -> None:
        """Stop collecting."""
        self._closed = True
        self._tokens.undeclare()
        self._alarms.undeclare()

    def _on_alarm(self, sample: zenoh.Sample) -> None:
        event = valid_event(decode_payload(sample.payload)) if self._admits(sample) else None
        if event is not None and self._history and self._hold(event):
            return
        self._take(event)

    def _hold(self, event: AlarmEvent) -> bool:
        """Hold an event back while the past of its vehicle has not come; return whether it was held back."""
        with self._changed:
            if event.vehicle in self._told:
                return False
            self._held.append(event)
            return True

    def _release(self, vehicle: str) -> None:
        """Release the events that were held back: the past of their vehicle has come, or nobody knows it."""
        with self._changed:
            self._told.add(vehicle)
            held = sorted((event for event in self._held if event.vehicle == vehicle), key=lambda event: event.seq)
            self._held = deque((event for event in self._held if event.vehicle != vehicle), maxlen=HELD_EVENTS)
        for event in held:
            self._take(event)

    def _on_token(self, sample: zenoh.Sample) -> None:
        vehicle = vehicle_of(self._root, str(sample.key_expr))
        appeared = sample.kind == zenoh.SampleKind.PUT
        with self._changed:
            (self._live.add if appeared else self._live.discard)(vehicle)
            self._changed.notify()
        if appeared and self._history:
            self._ask(vehicle, str(sample.key_expr).removesuffix("/live") + "/alarms?history=true", HISTORY_TRIES)

    def _ask(self, vehicle: str, key: str, tries: int) -> None:
        """Ask for the past events, again if nobody answers: a route may come up later than the token."""
        answers: list[zenoh.Reply] = []

        def on_reply(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                answers.append(reply)
                self._on_history(reply.ok)

        def on_end() -> None:
            if answers or tries == 1 or self._closed:
                self._release(vehicle)
                return
            again = threading.Timer(HISTORY_PAUSE_S, self._ask, (vehicle, key, tries - 1))
            again.daemon = True
            again.start()

        with contextlib.suppress(zenoh.ZError):  # the session was closed meanwhile
            self._session.get(key, zenoh.handlers.Callback(on_reply, on_end), timeout=HISTORY_TIMEOUT_S)

    def _on_history(self, reply: zenoh.Sample) -> None:
        events = decode_payload(reply.payload) if self._admits(reply) else None
        if not isinstance(events, list):
            self._take(None)
            return
        for event in events:
            self._take(valid_event(event))

    def _admits(self, sample: zenoh.Sample) -> bool:
        return self._seal is None or self._seal.holds(sample)

    def _take(self, event: AlarmEvent | None) -> None:
        with self._changed:
            if event is None:
                self.invalid += 1
                return
            # With the state, an event that clears an alarm is passed on even if its number was used before.
            mark = (event.vehicle, event.id, event.seq, event.state)
            if mark in self._seen:
                return
            self._seen[mark] = None
            if len(self._seen) > HELD_EVENTS:
                del self._seen[next(iter(self._seen))]
            if len(self._events) >= HELD_EVENTS:
                self._events.popleft()
                self.lost += 1
            self._events.append(event)
            self._changed.notify()
