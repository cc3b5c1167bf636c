"""The console's bounded history of a vehicle: estimates, link, track, flight modes, messages."""

import base64
import math
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from adapters.channels import number
from adapters.errors import printable
from monitor.bus.estimate_watch import live_shares
from monitor.event import AlarmEvent

ROWS: Final = 3600
"""Rows kept. Chosen: 15 minutes of estimates four times a second, an hour of the status: a flight of a battery."""
SLOT_NS: Final = 250_000_000
"""Nanoseconds between two estimates kept. Chosen: a plot that moves four times a second looks live."""
MAX_OBSERVERS: Final = 16
"""Largest number of observers of a vehicle: names come from the network. Chosen: a profile has two to five."""
MAX_CHANNELS: Final = 64
"""Largest number of channels of an observer: names come from the network. Chosen: the largest observer has a dozen."""
MAX_ENTRIES: Final = 200
"""Largest number of modes, messages and alarm events each. Chosen: those of a flight; more are not read."""
_LINK: Final = ("messages_per_s", "latency_ms", "lost_share", "delay_s", "jitter_s")
_PLACES: Final = ("latitude", "longitude", "altitude", "gps_latitude", "gps_longitude", "gps_altitude")
_PULLED: Final = ("gps_north", "gps_east")
STATUS_COLUMNS: Final = (*_LINK, *_PLACES, *_PULLED)

Since = dict[str, int]
"""The data that a reader has: the number of rows or entries of each part of the history."""


class Ring:
    """The latest rows of numbers in named columns, with their times in seconds."""

    def __init__(self, names: Sequence[str]) -> None:
        self.names = tuple(names)
        self.count = 0
        self._times = np.empty(ROWS)
        self._values = np.empty((ROWS, len(names)))

    def add(self, time_s: float, values: Sequence[float]) -> None:
        """Add a row in place of the oldest."""
        row = self.count % ROWS
        self._times[row] = time_s
        self._values[row] = values
        self.count += 1

    def since(self, count: int) -> dict[str, Any]:
        """Return the rows after the first ``count``: times (float64) and values by row (float64) as base64."""
        rows = np.arange(max(count, self.count - ROWS, 0), self.count) % ROWS
        return {"rows": len(rows), "times": _base64(self._times[rows]), "values": _base64(self._values[rows])}


class VehicleHistory:
    """The history of one vehicle; all data come from the network and are checked here."""

    def __init__(self) -> None:
        self.observers: dict[str, Ring] = {}
        self._layouts: dict[str, dict[str, list[str]]] = {}
        self._generations: dict[str, int] = {}
        self._slots: dict[str, int] = {}
        self._isolated: dict[str, float] = {}
        self._status = Ring(STATUS_COLUMNS)
        self._entries: dict[str, deque[dict[str, Any]]] = {
            name: deque(maxlen=MAX_ENTRIES) for name in ("modes", "texts", "events")
        }
        self._counts: Since = dict.fromkeys(self._entries, 0)

    def take_estimate(self, observer: str, payload: Any) -> tuple[Mapping[str, float], Mapping[str, float]]:
        """Process an observer's estimate, one for each slot of time; return the isolated size of each channel.

        Also return the sizes of motors as shares of their commands: the unit of their columns.
        """
        if not isinstance(payload, Mapping) or not math.isfinite(time_ns := number(payload.get("time_ns"))):
            return {}, {}
        parts = {name: _sizes(payload.get(name)) for name in ("isolated", "sd", "residual")}
        faults, outputs = list(parts["isolated"])[:MAX_CHANNELS], list(parts["residual"])[:MAX_CHANNELS]
        for name in _PULLED:
            if name in parts["isolated"]:
                self._isolated[name] = parts["isolated"][name]
        isolated = {name: size for name, size in parts["isolated"].items() if math.isfinite(size)}
        shares = {name: live_shares(parts[name], payload.get("commands")) for name in ("isolated", "sd")}
        if not faults or self._slots.get(observer) == (slot := int(time_ns // SLOT_NS)):
            return isolated, shares["isolated"]
        layout = {"faults": faults, "outputs": outputs}
        if self._layouts.get(observer) != layout:
            if observer not in self._layouts and len(self._layouts) >= MAX_OBSERVERS:
                return {}, {}
            self._layouts[observer] = layout
            self._generations[observer] = self._generations.get(observer, 0) + 1
            width = 1 + 2 * len(faults) + len(outputs)
            self.observers[observer] = Ring([str(k) for k in range(width)])
        self._slots[observer] = slot
        row = [1.0 if payload.get("armed") is True else 0.0]
        for name in ("isolated", "sd"):
            row += [(parts[name] | shares[name]).get(channel, math.nan) for channel in faults]
        row += [parts["residual"][channel] for channel in outputs]
        self.observers[observer].add(time_ns / 1e9, row)
        return isolated, shares["isolated"]

    def take_status(self, payload: Mapping[str, Any], mode: str) -> None:
        """Process a status, sent once a second, with the name of the flight mode."""
        time_s = number(payload.get("time_ns")) / 1e9
        link = next((figures for figures in mapping(payload.get("links")).values() if isinstance(figures, Mapping)), {})
        facts = mapping(payload.get("facts"))
        row = [number((payload if name in payload else link).get(name)) for name in _LINK]
        row += [*_place(facts.get("position")), *_place(facts.get("gps"))]
        row += [self._isolated.get(name, math.nan) for name in _PULLED]
        if math.isfinite(time_s):
            self._status.add(time_s, row)
        modes = self._entries["modes"]
        if mode and (not modes or modes[-1]["mode"] != mode) and math.isfinite(time_s):
            self._add("modes", {"time_s": time_s, "mode": mode})
        texts = facts.get("texts")
        known = {(entry["time_s"], entry["text"]) for entry in self._entries["texts"]}
        for text in texts[-MAX_ENTRIES:] if isinstance(texts, list) else ():
            if not isinstance(text, Mapping) or not isinstance(said := text.get("text"), str):
                continue
            said_s, severity, words = number(text.get("time_ns")) / 1e9, text.get("severity"), printable(said[:300])
            if math.isfinite(said_s) and (said_s, words) not in known:
                level = severity if type(severity) is int else 6
                self._add("texts", {"time_s": said_s, "text": words, "severity": level})

    def take_event(self, event: AlarmEvent) -> None:
        """Add an alarm event to the time line."""
        self._add(
            "events",
            {
                "time_s": event.time_ns / 1e9,
                "since_s": event.since_ns / 1e9,
                "id": printable(event.id),
                "channel": printable(f"{event.observer}/{event.channel}"),
                "state": event.state,
                "severity": event.severity,
                "message": printable(event.message),
            },
        )

    def since(self, have: Since) -> dict[str, Any]:
        """Return the data newer than ``have``, and update ``have``; empty if there are none."""
        news: dict[str, Any] = {}
        observers = {}
        for name, ring in self.observers.items():
            new = have.get(f"layout {name}") != self._generations[name]
            known = 0 if new else have[f"rows {name}"]
            if new or known != ring.count:
                observers[printable(name)] = ring.since(known) | (self._layouts[name] if new else {})
                have |= {f"layout {name}": self._generations[name], f"rows {name}": ring.count}
        if observers:
            news["observers"] = observers
        if have.get("status") != self._status.count:
            news["status"] = self._status.since(have.get("status", 0)) | {"names": STATUS_COLUMNS}
            have["status"] = self._status.count
        for name, entries in self._entries.items():
            if (fresh := self._counts[name] - have.get(name, 0)) > 0:
                news[name] = list(entries)[-fresh:]
                have[name] = self._counts[name]
        return news

    def _add(self, name: str, entry: dict[str, Any]) -> None:
        self._entries[name].append(entry)
        self._counts[name] += 1


def _sizes(value: object) -> dict[str, float]:
    if not isinstance(value, Mapping):
        return {}
    return {printable(name[:100]): number(size) for name, size in value.items() if isinstance(name, str)}


def _place(value: object) -> list[float]:
    return [number(element) for element in value] if isinstance(value, list) and len(value) == 3 else [math.nan] * 3


def mapping(value: object) -> Mapping[str, Any]:
    """Return a mapping from the network, or an empty one if the value is no mapping."""
    return value if isinstance(value, Mapping) else {}


def _base64(values: np.ndarray[Any, Any]) -> str:
    return base64.b64encode(np.ascontiguousarray(values, dtype="<f8").tobytes()).decode()
