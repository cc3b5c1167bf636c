"""What a recording holds: time, vehicles, messages, what could be watched with them, alarms, damage."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeVar

from adapters.batch import Batch, Columns, one_message
from adapters.errors import TelemetryError
from adapters.logs.recordings import Recording, recorded_alarms, recorded_metadata, recording_kind
from adapters.mavlink.heartbeat import enumerated, is_autopilot_heartbeat
from adapters.message import Message
from adapters.source import MAVLINK, ZENOH
from monitor.event import AlarmEvent
from monitor.fitting.progress import track
from monitor.fitting.survey import Survey, of_one_vehicle, survey
from monitor.sampling.slow_telemetry import slow_messages
from monitor.vehicles.base import Preview, VehicleKind, likely_kinds, load
from monitor.vehicles.kinds import KINDS

Event = TypeVar("Event", AlarmEvent, dict[str, Any])


def first_raised(events: Iterable[Event]) -> list[Event]:
    """Return the first event of each alarm that was raised: an alarm is raised again when an operator unshelves it.

    Parameters
    ----------
    events : Iterable[AlarmEvent] | Iterable[dict]
        Alarm events, or their JSON objects from a recording, which may hold anything where it is damaged.
    """
    found: dict[str, Event] = {}
    for event in events:
        if isinstance(event, Mapping):
            state, number = event.get("state"), repr(event.get("id"))
        else:
            state, number = event.state, event.id
        if state == "raised":
            found.setdefault(number, event)
    return list(found.values())


_ARMED = 128
"""MAV_MODE_FLAG_SAFETY_ARMED."""
# what comes all at once, as the head of a log does, has no rate
_SHORTEST_NS = 1_000_000
_MAX_FIELDS = 400
_MAX_ELEMENTS = 16


@dataclass(slots=True)
class _Sender:
    """What one system of a recording sent."""

    messages: int = 0
    components: set[int] = field(default_factory=set)
    type: int | None = None
    autopilot: int | None = None
    armed_since_ns: int | None = None
    armed_ns: int = 0


class _Tally:
    """Counts messages that pass, by name and by sender."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.spans: dict[str, tuple[int, int]] = {}
        self.senders: dict[int, _Sender] = {}
        self.examples: dict[str, Mapping[str, Any]] = {}
        self.first_ns: int | None = None
        self.last_ns = 0
        self.watched: int | None = None

    def count(self, batches: Iterable[Batch]) -> Iterator[Batch]:
        """Yield the batches."""
        for batch in batches:
            arrivals: dict[str, list[tuple[int, int]]] = {}
            heartbeats: list[tuple[int, Message]] = []
            for columns in batch.columns:
                ends = (0, -1)
                arrivals.setdefault(columns.name, []).extend(
                    (int(columns.position[end]), int(columns.received_ns[end])) for end in ends
                )
                self._count_sender(columns, len(columns.position))
                if columns.source is ZENOH:
                    self.examples[columns.name] = one_message(columns, -1).fields
                elif columns.name == "HEARTBEAT":
                    heartbeats += [(int(at), one_message(columns, row)) for row, at in enumerate(columns.position)]
            for index, message in batch.others.items():
                arrivals.setdefault(message.name, []).append((index, message.received_ns))
                self._count_sender(message, 1)
                if message.source is ZENOH:
                    self.examples[message.name] = message.fields
                elif message.name == "HEARTBEAT":
                    heartbeats.append((index, message))
            for _, message in sorted(heartbeats, key=lambda heartbeat: heartbeat[0]):
                if message.source is MAVLINK:
                    _note(self.senders[message.system], message)
            for name, found in arrivals.items():
                first_ns, last_ns = min(found)[1], max(found)[1]
                self.spans[name] = self.spans.get(name, (first_ns, last_ns))[0], last_ns
            everything = [arrival for found in arrivals.values() for arrival in found]
            if everything:
                self.first_ns = min(everything)[1] if self.first_ns is None else self.first_ns
                self.last_ns = max(everything)[1]
            yield batch

    def _count_sender(self, messages: Columns | Message, count: int) -> None:
        self.counts[messages.name] += count
        if messages.source is MAVLINK:
            sender = self.senders.setdefault(messages.system, _Sender())
            sender.messages += count
            sender.components.add(messages.component)

    def watch(self, batches: Iterable[Batch]) -> Iterator[Batch]:
        """Yield the messages of the vehicle that a fit would take, and note which it is."""
        for batch in of_one_vehicle(batches):
            systems = [columns.system for columns in batch.columns] + [m.system for m in batch.others.values()]
            if systems:
                self.watched = systems[0]
            yield batch


def _note(sender: _Sender, message: Message) -> None:
    """Take a heartbeat: the autopilot's says what the vehicle is, any other what its sender is."""
    fields = message.fields
    if is_autopilot_heartbeat(message) or sender.autopilot is None:
        sender.type, sender.autopilot = (_whole(fields.get(name)) for name in ("type", "autopilot"))
    mode = fields.get("base_mode")
    if not is_autopilot_heartbeat(message) or not isinstance(mode, int):
        return
    if sender.armed_since_ns is not None:
        sender.armed_ns += max(0, message.received_ns - sender.armed_since_ns)
    sender.armed_since_ns = message.received_ns if mode & _ARMED else None


def _whole(value: Any) -> int | None:
    return value if type(value) is int else None


def log_info(path: Path) -> dict[str, Any]:
    """Go through a recording and return what it holds, as a JSON object.

    Raises
    ------
    TelemetryError
        It is no recording, or holds nothing of its kind.
    """
    kind = recording_kind(path)
    tally, recording = _Tally(), Recording(path)
    batches = track(recording.batches(), f"reading {path.name}", weigh=lambda batch: batch.count)
    found = survey(tally.watch(tally.count(batches)))
    first_ns = tally.first_ns
    return {
        "file": str(path),
        "kind": "recording",
        "format": kind,
        "start_ns": first_ns,
        "start": None if first_ns is None else _moment(first_ns),
        "duration_s": 0.0 if first_ns is None else (tally.last_ns - first_ns) / 1e9,
        "count": tally.counts.total(),
        "messages": {name: _message(name, tally, found) for name in sorted(tally.counts)},
        "systems": [_system(number, sender) for number, sender in sorted(tally.senders.items())],
        "vehicle": _fits(found, tally),
        "fields": {name: _paths(fields) for name, fields in sorted(tally.examples.items())},
        "recorded": recorded_metadata(path) or None,
        "alarms": first_raised(recorded_alarms(path)),
        "damage": [damage.to_json() for damage in recording.damage()],
    }


def _moment(time_ns: int) -> str:
    return datetime.fromtimestamp(time_ns // 1_000_000_000, UTC).isoformat().replace("+00:00", "Z")


def _message(name: str, tally: _Tally, found: Survey) -> dict[str, Any]:
    """Return count and rate: on the vehicle's clock where the message has a time, else as it arrived."""
    count, (first, last) = tally.counts[name], tally.spans[name]
    rate = found.rate_hz.get(name) if found.counts.get(name) == count else None
    if rate is None and last - first > _SHORTEST_NS:
        rate = (count - 1) * 1e9 / (last - first)
    return {"count": count, "rate_hz": rate}


def _system(number: int, sender: _Sender) -> dict[str, Any]:
    return {
        "system": number,
        "components": sorted(sender.components),
        "type": _enumerated("MAV_TYPE", sender.type),
        "autopilot": _enumerated("MAV_AUTOPILOT", sender.autopilot),
        "messages": sender.messages,
        "armed_s": sender.armed_ns / 1e9,
    }


def _enumerated(enumeration: str, number: int | None) -> str | None:
    return None if number is None else enumerated(enumeration, number)


def _fits(found: Survey, tally: _Tally) -> dict[str, Any] | None:
    """Return which observers could be fitted to the vehicle's messages, None where there is no vehicle."""
    sender = None if tally.watched is None else tally.senders.get(tally.watched)
    if sender is None:
        fits = {kind.name: _fit(kind, found) for kind in KINDS if kind.types}
        if not any(fit["possible"] for fit in fits.values()):
            return None
        return {"system": None, "likely": None, "fits": fits}
    says = _enumerated("MAV_TYPE", sender.type) or ""
    likely = likely_kinds(KINDS, says)
    return {
        "system": tally.watched,
        "likely": likely[0].name if likely else None,
        "fits": {kind.name: _fit(kind, found) for kind in KINDS if kind.preview},
    }


def _fit(kind: VehicleKind, found: Survey) -> dict[str, Any]:
    try:
        preview: Preview = load(kind.preview)(found)
    except TelemetryError as error:
        return {"possible": False, "missing": [str(error)], "watches": [], "channels": {}, "rate_hz": None}
    slow = slow_messages([found.rate_hz], preview.channels, kind.wanted_hz)
    seldom = [f"{name} at {kind.wanted_hz:g} Hz: it comes at {rate:.3g} Hz" for name, rate in slow.items()]
    json = preview.to_json()
    return {"possible": True, **json, "missing": json["missing"] + seldom}


def _paths(fields: Mapping[str, Any]) -> list[str]:
    """Return the places of the numbers in a message, as a profile's channels name them."""
    found: list[str] = []

    def go(value: Any, path: str, names: Any) -> None:
        if len(found) >= _MAX_FIELDS:
            return
        if isinstance(value, Mapping):
            for key, inner in value.items():
                go(inner, f"{path}.{key}" if path else key, value.get("name"))
        elif isinstance(value, list):
            named = isinstance(names, list) and len(names) == len(value)
            for at, inner in enumerate(value[:_MAX_ELEMENTS]):
                go(inner, f"{path}[{names[at] if named else at}]", None)
        elif isinstance(value, int | float) and not isinstance(value, bool):
            found.append(path)

    go(fields, "", None)
    return found
