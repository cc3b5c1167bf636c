"""The console's data of all vehicles: alarms and states as in ``fauio alarms``, and histories."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final

from adapters.channels import number
from adapters.errors import printable
from adapters.mavlink.heartbeat import ARMED, mode_name
from monitor.bus.keys import ANY, vehicle_of, vehicle_root
from monitor.bus.payload import decode_payload
from monitor.bus.status_watch import MAX_VEHICLES, StatusWatch, VehicleStatus
from monitor.bus.subscriber import AlarmSubscriber
from monitor.console.alarm_table import AlarmTable
from monitor.console.vehicle_history import MAX_CHANNELS, MAX_OBSERVERS, Since, VehicleHistory, mapping
from monitor.display import display_unit

if TYPE_CHECKING:
    import zenoh

MAX_HISTORIES: Final = 64
"""Largest number of vehicles with a history. Chosen: four times the 16 that a console is meant for, 150 MB at most."""
MAX_SHOWN: Final = 200
"""Largest number of alarms sent to a page, the most urgent ones. Chosen: more than anyone reads; the page shows how
many more there are."""
_MAX_ESTIMATE_BYTES: Final = 65_536
"""Largest message that is processed, bytes. Chosen: ten times the largest estimate there is."""
_WAIT_S: Final = 0.25
"""Seconds for which the thread waits for events before it checks whether to stop."""
_REFRESH_NS: Final = 1_000_000_000
"""Seconds between two updates of the alarms without an event. Chosen: how late a page may show changed sizes of alarms,
and the end of shelving."""
_GONE_NS: Final = 3600 * 1_000_000_000
"""Seconds for which a vehicle without a monitor is shown. Chosen: long enough to be noticed, and not for days."""
_UNKNOWN: Final[tuple[int, dict[str, Any]]] = (0, {"state": "starting"})
"""Card of a vehicle whose monitor has sent no status yet."""


class FleetView:
    """Collects what monitors publish; :meth:`news` returns the data that a reader does not have yet.

    :meth:`close` leaves the session open.
    """

    def __init__(self, session: zenoh.Session, prefix: str = "fauio") -> None:
        self._root = vehicle_root(prefix, ANY)
        self._lock = threading.Lock()
        self._table = AlarmTable()
        self._alarms_version = 0
        self._cards: dict[str, tuple[int, dict[str, Any]]] = {}
        self._histories: dict[str, VehicleHistory] = {}
        self._closed = threading.Event()
        self.subscriber = AlarmSubscriber(session, ANY, prefix)
        self._statuses = StatusWatch(session, ANY, prefix, self._on_status)
        self._estimates: Any = session.declare_subscriber(f"{self._root}/estimate/*", self._on_estimate)
        self._thread = threading.Thread(target=self._run, name="console alarms", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop collecting."""
        self._closed.set()
        self._thread.join()
        self._estimates.undeclare()
        self._statuses.close()
        self.subscriber.close()

    def news(self, have: Since, vehicle: str | None = None) -> dict[str, Any]:
        """Return the data newer than ``have``, and update ``have``; for a named vehicle also its history."""
        now_ns = time.time_ns()
        live = self.subscriber.live
        news: dict[str, Any] = {}
        with self._lock:
            for name, (_, card) in list(self._cards.items()):
                if name not in live and now_ns - card["heard_ns"] > _GONE_NS:
                    del self._cards[name]
            names = sorted(live | set(self._cards))[:MAX_VEHICLES]
            present = hash(tuple((name, name in live) for name in names))
            cards = [
                card | {"name": name, "live": name in live}
                for name in names
                for count, card in (self._cards.get(name, _UNKNOWN),)
                if have.get("present") != present or have.get(f"card {name}") != count
            ]
            if cards or have.get("present") != present:
                news |= {"cards": cards, "names": names}
                have["present"] = present
                have |= {f"card {name}": self._cards.get(name, _UNKNOWN)[0] for name in names}
            # shelving ends, and cleared alarms go, without an event
            version = self._alarms_version, now_ns // _REFRESH_NS
            if have.get("alarms") != hash(version):
                have["alarms"] = hash(version)
                news |= self._alarms(now_ns)
            if vehicle is not None and (history := self._histories.get(vehicle)) is not None:
                past = history.since(have)
                if past:
                    news["past"] = past
        return news | {"now_ns": now_ns} if news else news

    def _alarms(self, now_ns: int) -> dict[str, Any]:
        entries = self._table.entries(now_ns)
        active = [event.severity for group, event in entries if group == "active"]
        return {
            "alarms": [_clean(event.to_json()) | {"group": group} for group, event in entries[:MAX_SHOWN]],
            "more": max(0, len(entries) - MAX_SHOWN),
            "counts": {severity: active.count(severity) for severity in ("critical", "warning")},
        }

    def _run(self) -> None:
        while not self._closed.is_set():
            event = self.subscriber.receive(_WAIT_S)
            if event is None:
                continue
            with self._lock:
                self._table.take(event, time.time_ns())
                self._alarms_version += 1
                history = self._history(event.vehicle)
                if history is not None:
                    history.take_event(event)

    def _on_status(self, status: VehicleStatus, payload: Mapping[str, Any]) -> None:
        mode = flight_mode(mapping(mapping(payload.get("facts")).get("heartbeat")))
        with self._lock:
            count = self._cards.get(status.vehicle, _UNKNOWN)[0]
            self._cards[status.vehicle] = count + 1, vehicle_card(status, payload, mode, time.time_ns())
            history = self._history(status.vehicle)
            if history is not None:
                history.take_status(payload, mode)

    def _on_estimate(self, sample: zenoh.Sample) -> None:
        if len(sample.payload) > _MAX_ESTIMATE_BYTES:
            return
        key = str(sample.key_expr)
        payload = decode_payload(sample.payload)
        vehicle, observer = vehicle_of(self._root, key), key.rpartition("/")[2]
        with self._lock:
            history = self._history(vehicle)
            if history is not None:
                self._table.resize(vehicle, observer, *history.take_estimate(observer, payload))

    def _history(self, vehicle: str) -> VehicleHistory | None:
        """Return a vehicle's history; if there are too many, replace one without a monitor, or return None."""
        if vehicle in self._histories:
            return self._histories[vehicle]
        if len(self._histories) >= MAX_HISTORIES:
            gone = next((name for name in self._histories if name not in self.subscriber.live), None)
            if gone is None:
                return None
            del self._histories[gone]
        return self._histories.setdefault(vehicle, VehicleHistory())


def flight_mode(beat: Mapping[str, Any]) -> str:
    """Return ``LOITER`` or ``LOITER, disarmed``; empty if the heartbeat, which may hold anything, has no valid mode."""
    kind, autopilot, base, custom = (beat.get(key) for key in ("type", "autopilot", "base_mode", "custom_mode"))
    if not (type(kind) is int and type(base) is int and type(custom) is int and 0 <= custom < 1 << 32):
        return ""
    name = mode_name(autopilot if type(autopilot) is int else 0, kind, base, custom) or f"mode {custom}"
    return name if base & ARMED else f"{name}, disarmed"


def _clean(event: Mapping[str, Any]) -> dict[str, Any]:
    """Return an event without control characters."""
    return {name: printable(value) if isinstance(value, str) else value for name, value in event.items()}


def _shown(channel: Mapping[str, Any]) -> tuple[float, str, float]:
    """Return a channel's threshold, the unit to display, and the factor to multiply both estimates and threshold by.

    The threshold of a motor is a share of its usual command, as its estimates are shares of commands.
    """
    unit, command = channel.get("unit"), number(channel.get("usual_command"))
    of_motor = command > 0.0
    factor, name = display_unit(unit if isinstance(unit, str) else "", 1.0 if of_motor else None)
    return number(channel.get("threshold")) / (command if of_motor else 1.0), printable(name[:60]), factor


def vehicle_card(status: VehicleStatus, payload: Mapping[str, Any], mode: str, heard_ns: int) -> dict[str, Any]:
    """Return a vehicle's data to show, received at a Unix time; all is checked, as it comes from the network."""
    links = mapping(payload.get("links"))
    watching = {
        printable(name): {
            "share": number(watch.get("share")),
            "why_not": printable(str(watch["why_not"])[:100]) if watch.get("why_not") else None,
        }
        for name, watch in list(mapping(payload.get("watching")).items())[:MAX_OBSERVERS]
        if isinstance(watch, Mapping)
    }
    channels = {
        printable(observer): {
            printable(name): [*_shown(channel)]
            for name, channel in list(mapping(of_observer).items())[:MAX_CHANNELS]
            if isinstance(channel, Mapping)
        }
        for observer, of_observer in list(mapping(payload.get("channels")).items())[:MAX_OBSERVERS]
    }
    shares = [number(link.get("lost_share")) for link in links.values() if isinstance(link, Mapping)]
    return {
        "state": status.state,
        "well": status.well,
        "reasons": [printable(reason) for reason in status.reasons],
        "mode": mode,
        "messages_per_s": number(payload.get("messages_per_s")),
        "latency_ms": number(payload.get("latency_ms")),
        "lost_share": shares[0] if shares else None,
        "heard_ns": heard_ns,
        "watching": watching,
        "channels": channels,
    }
