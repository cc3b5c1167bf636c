"""Zenoh outputs of one vehicle's monitor: alarms, estimates, status, and answers to later queries."""

import contextlib
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import zenoh
from zenoh import ext

from monitor.bus.keys import alarm_key, estimate_key, vehicle_root
from monitor.bus.payload import estimate_json, to_json
from monitor.bus.seal import Seal
from monitor.estimate import Estimates, Layout
from monitor.event import AlarmEvent

HISTORY_EVENTS = 4096
"""Events that late subscribers can ask for. Chosen: one every 3.5 s for four hours; the journal has all of them."""
CACHED_EVENTS = 64
"""Events that Zenoh sends again to a subscriber that missed some. Chosen: more than a failure of some seconds
causes."""
HISTORIES = 8
"""Queries for the past that are queued in a process, which answers one after the other; more are refused. Chosen: those
of the consoles and standbys of one vehicle, which ask again."""
HISTORY_WAIT_S = 5.0
"""Longest wait of a query for the past: half of what a client waits for an answer by default."""
HEARTBEAT_S = 1.0
"""Within this time a subscriber learns that it missed the last event."""

_histories = threading.BoundedSemaphore(HISTORIES)
_reading = threading.Lock()


class Publisher:
    """Publishes the monitor's results under the keys of the contract; the session is left open by :meth:`close`.

    Events are published with :class:`zenoh.ext.AdvancedPublisher`, so that an advanced subscriber gets the current
    state when it joins and recovers events that it missed. A plain client gets the same with a ``get`` on the alarm
    keys. Nothing waits for a slow client: what does not fit into its queue is dropped for it. Queries for the past are
    answered in threads of their own, one at a time, with the newest 4096 events at most.

    At most ``estimate_rate_hz`` estimates a second are published per observer, by the samples' own time; 0 publishes
    none. ``journal`` returns all past events from a Unix time in nanoseconds on; without it, a bounded number of the
    published events is kept here. A ``seal`` proves to the other monitors of the vehicle who published an event.

    Raises UsageError if the vehicle's name or the prefix cannot be part of a key.
    """

    def __init__(
        self,
        session: zenoh.Session,
        vehicle: str,
        layouts: Sequence[Layout],
        prefix: str = "fauio",
        estimate_rate_hz: float = 10.0,
        journal: Callable[[int], Sequence[AlarmEvent]] | None = None,
        seal: Seal | None = None,
    ) -> None:
        self._journal = journal
        self._seal = seal
        self._session = session
        self._root = vehicle_root(prefix, vehicle)
        self._period_ns = round(1e9 / estimate_rate_hz) if estimate_rate_hz > 0 else 0
        self._slots: dict[str, int] = {}
        self._layouts = {layout.observer: layout for layout in layouts}
        # Any: zenoh's stubs declare a matching status as a bool
        self._estimates: dict[str, Any] = {
            name: session.declare_publisher(
                estimate_key(self._root, name),
                encoding=zenoh.Encoding.APPLICATION_JSON,
                congestion_control=zenoh.CongestionControl.DROP,
                priority=zenoh.Priority.DATA_LOW,
            )
            for name in self._layouts
        }
        self._status = session.declare_publisher(
            f"{self._root}/status",
            encoding=zenoh.Encoding.APPLICATION_JSON,
            congestion_control=zenoh.CongestionControl.DROP,
        )
        self._alarms: dict[str, ext.AdvancedPublisher] = {}
        self._closed = False
        self._lock = threading.Lock()
        self._latest: dict[str, AlarmEvent] = {}
        self._history: deque[AlarmEvent] = deque(maxlen=HISTORY_EVENTS)
        self._queryables = [
            session.declare_queryable(f"{self._root}/alarm/**", self._answer_current, complete=True),
            session.declare_queryable(f"{self._root}/alarms", self._answer_list, complete=True),
        ]
        # last, so that whoever sees the token finds everything else
        self._token = session.liveliness().declare_token(f"{self._root}/live")

    def event(self, event: AlarmEvent) -> None:
        """Publish an alarm event and keep it for later queries."""
        key = alarm_key(self._root, event.observer, event.channel)
        with self._lock:
            self._latest[key] = event
            self._history.append(event)
        publisher = self._alarms.get(key)
        if publisher is None:
            publisher = self._alarms[key] = ext.declare_advanced_publisher(
                self._session,
                key,
                encoding=zenoh.Encoding.APPLICATION_JSON,
                congestion_control=zenoh.CongestionControl.DROP,
                priority=zenoh.Priority.INTERACTIVE_HIGH,
                express=True,
                cache=ext.CacheConfig(CACHED_EVENTS),
                sample_miss_detection=ext.MissDetectionConfig(heartbeat=HEARTBEAT_S, sporadic_heartbeat=None),
                publisher_detection=True,
            )
        payload = to_json(event.to_json())
        publisher.put(payload, attachment=self._attachment(key, payload))

    def estimates(self, estimates: Estimates) -> None:
        """Publish the first estimate of each interval of the rate; encode nothing if nobody subscribes."""
        if not self._period_ns:
            return
        observer = estimates.observer
        publisher = self._estimates[observer]
        for row, time_ns in enumerate(estimates.samples.time_ns.tolist()):
            if self._slots.get(observer) != (slot := time_ns // self._period_ns):
                self._slots[observer] = slot
                if publisher.matching_status.matching:
                    publisher.put(to_json(estimate_json(self._layouts[observer], estimates, row)))

    def status(self, status: Mapping[str, Any]) -> None:
        """Publish the daemon's status."""
        self._status.put(to_json(status))

    def close(self) -> None:
        """Undeclare everything, the liveliness token first; a second call does nothing."""
        if not self._closed:
            self._closed = True
            declared: list[Any] = [*self._queryables, *self._alarms.values(), *self._estimates.values()]
            for entity in (self._token, *declared, self._status):
                entity.undeclare()

    def _answer_current(self, query: zenoh.Query) -> None:
        """Answer a ``get`` on alarm keys with the latest event of each matching channel."""
        with self._lock:
            latest = dict(self._latest)
        with query:
            for key, event in latest.items():
                if query.key_expr.intersects(zenoh.KeyExpr(key)):
                    self._reply(query, key, to_json(event.to_json()))

    def _past(self, since_ns: int) -> Sequence[AlarmEvent]:
        if self._journal is not None:
            return self._journal(since_ns)
        with self._lock:
            return [event for event in self._history if event.time_ns >= since_ns]

    def _answer_list(self, query: zenoh.Query) -> None:
        """Answer with the active alarms, or with the newest of all kept events from a time on."""
        parameters = query.parameters
        try:
            since = int(parameters.get("since", "0") or 0)
            limit = min(max(int(parameters.get("limit") or HISTORY_EVENTS), 0), HISTORY_EVENTS)
        except ValueError:
            self._refuse(query, "since is not a whole number of nanoseconds, or limit is none of events")
            return
        if parameters.get("history") == "true":
            if not _histories.acquire(blocking=False):
                self._refuse(query, "too many ask for the past at once; try again")
                return
            work = threading.Thread(target=self._answer_past, args=(query, since, limit), name="history", daemon=True)
            work.start()
            return
        with self._lock:
            events = [event for event in self._latest.values() if event.state != "cleared"]
        with query:
            self._reply(query, f"{self._root}/alarms", to_json([event.to_json() for event in events]))

    def _answer_past(self, query: zenoh.Query, since_ns: int, limit: int) -> None:
        """Answer a query for the past when it has its turn; the answer may wait for the disk."""
        # A client or a session that has gone meanwhile needs no answer.
        with contextlib.ExitStack() as stack, contextlib.suppress(zenoh.ZError):
            stack.callback(_histories.release)
            if not _reading.acquire(timeout=HISTORY_WAIT_S):
                self._refuse(query, "others still ask for the past; try again")
                return
            stack.callback(_reading.release)
            try:
                events = self._past(since_ns)
            except OSError as error:
                self._refuse(query, str(error))
                return
            payload = to_json([event.to_json() for event in events[max(len(events) - limit, 0) :]])
            with query:
                self._reply(query, f"{self._root}/alarms", payload)

    def _refuse(self, query: zenoh.Query, reason: str) -> None:
        with query:
            query.reply_err(to_json({"error": reason}))

    def _reply(self, query: zenoh.Query, key: str, payload: bytes) -> None:
        encoding = zenoh.Encoding.APPLICATION_JSON
        query.reply(key, payload, encoding=encoding, attachment=self._attachment(key, payload))

    def _attachment(self, key: str, payload: bytes) -> bytes | None:
        return None if self._seal is None else self._seal.attachment(key, payload)
