"""The table of active alarms for operators, built from alarm events, most urgent first."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Literal

from adapters.errors import printable
from monitor.alarms.alarm import alarm_message
from monitor.event import AlarmEvent

KEPT_CLEARED_S = 30.0
"""Seconds for which a cleared alarm is still shown. Chosen: as long as an operator takes to look."""
MAX_ALARMS = 1000
"""Largest number of alarms kept. Rows come from the network: their memory has to be bounded."""

Group = Literal["active", "shelved", "cleared"]

_GROUPS: tuple[Group, ...] = ("active", "shelved", "cleared")

RowKey = tuple[str, str, str]


@dataclass(frozen=True, slots=True)
class AlarmRow:
    """One alarm as text, without control characters."""

    key: RowKey  # vehicle, observer and channel, as received
    id: str  # of the alarm, as received
    group: Group  # cleared: a moment ago
    # the columns; ``channel`` with its observer, ``brief`` the size without the quantity that it is a share of
    severity: str
    vehicle: str
    channel: str
    size: str
    brief: str
    age: str
    state: str
    message: str


class AlarmTable:
    """Keeps the latest event of each channel, and cleared ones for :data:`KEPT_CLEARED_S`."""

    def __init__(self) -> None:
        self._latest: dict[RowKey, AlarmEvent] = {}
        self._cleared_ns: dict[RowKey, int] = {}
        self._sizes: dict[RowKey, tuple[float, float | None]] = {}

    def resize(self, vehicle: str, observer: str, sizes: Mapping[str, float], shares: Mapping[str, float]) -> None:
        """Update the sizes of an observer's faults between alarm events, by channel; those of motors also as shares."""
        for channel, size in sizes.items():
            if (key := (vehicle, observer, channel)) in self._latest:
                self._sizes[key] = size, shares.get(channel)

    def take(self, event: AlarmEvent, now_ns: int) -> None:
        """Process an event that arrived at a Unix time; one older than the channel's latest event changes nothing.

        An alarm that cleared before any of its other events arrived is not shown.
        """
        key = (event.vehicle, event.observer, event.channel)
        known = self._latest.pop(key, None)
        self._sizes.pop(key, None)
        if known is not None and _order(event, known) < _order(known, event):
            self._latest[key] = known
            return
        if event.state != "cleared":
            self._latest[key] = event
            self._cleared_ns.pop(key, None)
            self._make_room()
        elif known is not None:
            self._latest[key] = event
            self._cleared_ns.setdefault(key, now_ns)

    def rows(self, now_ns: int) -> list[AlarmRow]:
        """Return :meth:`entries` as text."""
        return [
            _row(group, (event.vehicle, event.observer, event.channel), event, now_ns)
            for group, event in self.entries(now_ns)
        ]

    def entries(self, now_ns: int) -> list[tuple[Group, AlarmEvent]]:
        """Return the alarms at a Unix time: active ones, most severe and newest first, then shelved, then cleared."""
        for key, cleared_ns in list(self._cleared_ns.items()):
            if now_ns - cleared_ns > 1e9 * KEPT_CLEARED_S:
                del self._cleared_ns[key], self._latest[key]
                self._sizes.pop(key, None)
        rows = [(_group(event, now_ns), key, event) for key, event in self._latest.items()]
        rows.sort(key=lambda row: (_GROUPS.index(row[0]), row[2].severity != "critical", -row[2].since_ns, row[1]))
        return [(group, self._sized(key, event)) for group, key, event in rows]

    def _sized(self, key: RowKey, event: AlarmEvent) -> AlarmEvent:
        """Return the event with the current size of its fault, in its sentence, too."""
        if (now := self._sizes.get(key)) is None or event.state == "cleared":
            return event
        size, share = now
        if event.relative is None or not event.estimate:
            share = None
        elif share is None or not math.isfinite(share):
            share = size * event.relative / event.estimate
        message = event.message
        if event.estimate is not None and math.isfinite(event.estimate):
            same = event.observer, event.channel, event.kind, event.unit, event.state
            said = alarm_message(*same, event.estimate, event.relative)
            if message.startswith(said):
                message = alarm_message(*same, size, share) + message.removeprefix(said)
        return replace(event, estimate=size, relative=share, message=message)

    def _make_room(self) -> None:
        """Forget the channel without an event for longest: a sender of endless names must not fill the memory."""
        while len(self._latest) > MAX_ALARMS:
            key = next(iter(self._cleared_ns), next(iter(self._latest)))
            self._cleared_ns.pop(key, None)
            del self._latest[key]
            self._sizes.pop(key, None)


def _order(event: AlarmEvent, other: AlarmEvent) -> tuple[int, int]:
    """Return a number that grows with each event: the count within an alarm, the begin between a channel's alarms."""
    return (0, event.seq) if event.id == other.id else (event.since_ns, event.seq)


def _group(event: AlarmEvent, now_ns: int) -> Group:
    if event.state == "cleared":
        return "cleared"
    return "shelved" if event.shelved_until_ns is not None and event.shelved_until_ns > now_ns else "active"


def _row(group: Group, key: RowKey, event: AlarmEvent, now_ns: int) -> AlarmRow:
    columns = (
        event.severity,
        event.vehicle,
        f"{event.observer}/{event.channel}",
        event.display,
        event.display.partition(" of ")[0],
        age(now_ns - event.since_ns),
        _state(group, event),
        event.message,
    )
    return AlarmRow(key, event.id, group, *map(printable, columns))


def _state(group: Group, event: AlarmEvent) -> str:
    if group == "cleared":
        return "cleared"
    parts = ["acknowledged"] if event.acknowledged else []
    if event.latched:
        parts.append("latched")
    if group == "shelved":
        parts.append(f"shelved until {_time_of_day(event.shelved_until_ns or 0)}")
    return ", ".join(parts) or "raised"


def _time_of_day(time_ns: int) -> str:
    try:
        return f"{datetime.fromtimestamp(time_ns // 1_000_000_000, UTC):%H:%MZ}"
    except (OverflowError, OSError, ValueError):
        return "?"


def age(elapsed_ns: int) -> str:
    """Return a duration in its largest unit: ``12 s``, ``3 min``, ``2 h 5 min``, ``4 d``."""
    seconds = max(0, elapsed_ns) // 1_000_000_000
    if seconds < 60:
        return f"{seconds} s"
    if seconds < 3600:
        return f"{seconds // 60} min"
    if seconds < 86_400:
        return f"{seconds // 3600} h {seconds // 60 % 60} min"
    return f"{seconds // 86_400} d"
