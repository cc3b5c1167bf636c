"""The content of a recording: time, vehicles, messages, what could be watched with them, alarms, damage."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from adapters.batch import Batch, Columns, one_message
from adapters.errors import TelemetryError
from adapters.link_figures import LinkMeter
from adapters.logs.recordings import Recording, recorded_alarms, recorded_metadata, recording_kind
from adapters.mavlink.heartbeat import ARMED, enumerated, is_autopilot_heartbeat
from adapters.message import Message
from adapters.source import MAVLINK, ZENOH
from monitor.bus.alarm_text import utc
from monitor.event import AlarmEvent
from monitor.fitting.flights import phase_reports
from monitor.fitting.progress import track
from monitor.fitting.raw_streams import hidden
from monitor.fitting.survey import ESC_MESSAGES, MOTOR_MESSAGE, FlightRate, Survey, of_one_vehicle, survey
from monitor.sampling.identity import Reports
from monitor.sampling.slow_telemetry import motor_gain, slow_messages
from monitor.sampling.supply import BATTERY_MESSAGE, CELLS_MESSAGE
from monitor.vehicles.base import Preview, VehicleKind, likely_kinds, load
from monitor.vehicles.kinds import KINDS

Event = TypeVar("Event", AlarmEvent, dict[str, Any])


def first_raised(events: Iterable[Event]) -> list[Event]:
    """Return the first event of each raised alarm: an alarm is raised again when an operator unshelves it.

    Events of a recording are JSON objects; in a damaged recording they may hold anything.
    """
    raised: dict[str, Event] = {}
    for event in events:
        if isinstance(event, Mapping):
            state, number = event.get("state"), repr(event.get("id"))
        else:
            state, number = event.state, event.id
        if state == "raised":
            raised.setdefault(number, event)
    return list(raised.values())


_SILENCE_NS = 10_000_000_000
"""Longest time between two heartbeats over which a vehicle counts as armed, nanoseconds. Chosen: heartbeats come once a
second, and a poor radio loses half of them."""
_BURST_S = 1.0
"""Messages that all arrive within this time came in bursts, seconds. Chosen: the slowest streams have one message in a
second."""
_INPUTS = {
    MOTOR_MESSAGE: "outputs to motors and servos",
    "ACTUATOR_CONTROL_TARGET": "torques and thrust that the controllers ask for",
    "ESC_STATUS": "speed, voltage and current of motors",
    **dict.fromkeys(ESC_MESSAGES, "speed, voltage and current of motors"),
    **dict.fromkeys((BATTERY_MESSAGE, CELLS_MESSAGE), "voltage and current of the battery"),
    "VIBRATION": "vibration and clipping of the accelerometers",
}
"""Messages about what acts on a vehicle, and their content."""
_FIELD_RECORDS = ("vehicle_magnetometer", "MAG")
"""Records of onboard logs that hold the magnetic field."""
_FIELD_HZ = 10.0
"""Lowest rate at which a compass can be watched. Measured on PX4's logs of brisk flights: headings from a field at 14
Hz are within 10 degrees of the attitude's, from one at 2 Hz within 51."""
_MAX_FIELDS = 400
"""Numbers of a message that are listed. Chosen: only pictures and clouds of points have more."""
_MAX_ELEMENTS = 16
"""Elements of a list that are listed. Chosen: as many as a servo message has outputs."""


@dataclass(slots=True)
class _Sender:
    """Messages of one system of a recording."""

    messages: int = 0
    components: set[int] = field(default_factory=set)
    type: int | None = None
    autopilot: int | None = None
    heartbeats: int = 0
    armed_since_ns: int | None = None
    armed_ns: int = 0
    reports: Reports = field(default_factory=Reports)


class _Tally:
    """Counts messages that pass, by name and by sender."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.records = 0  # those of an onboard log; the other messages are made of them
        self.rates: dict[str, FlightRate] = {}
        self.senders: dict[int, _Sender] = {}
        self.examples: dict[str, Mapping[str, Any]] = {}
        self.first_ns: int | None = None
        self.last_ns = 0
        self.watched: int | None = None
        self.link = LinkMeter(recent=False)

    def count(self, batches: Iterable[Batch]) -> Iterator[Batch]:
        """Yield the batches."""
        for batch in batches:
            self.link.count(batch)
            ends: list[tuple[int, int]] = []
            for columns in batch.columns:
                self._count_message(columns, columns.received_ns)
                ends += ((int(columns.position[end]), int(columns.received_ns[end])) for end in (0, -1))
                if columns.source is ZENOH:
                    self.examples[columns.name] = one_message(columns, -1).fields
            for index, message in sorted(batch.others.items()):
                self._count_message(message, np.array([message.received_ns]))
                ends.append((index, message.received_ns))
                if message.source is ZENOH:
                    self.examples[message.name] = message.fields
            for _, message in phase_reports(batch):
                _note(self.senders.setdefault(message.system, _Sender()), message)
            if ends:
                self.first_ns = min(ends)[1] if self.first_ns is None else self.first_ns
                self.last_ns = max(ends)[1]
            yield batch

    def _count_message(self, messages: Columns | Message, received_ns: NDArray[np.int64]) -> None:
        self.counts[messages.name] += len(received_ns)
        self.records += len(received_ns) * messages.source.is_onboard_log
        self.rates.setdefault(messages.name, FlightRate(repeats=True)).add(received_ns)
        if messages.source is MAVLINK:
            sender = self.senders.setdefault(messages.system, _Sender())
            sender.messages += len(received_ns)
            sender.components.add(messages.component)

    def said(self, system: int) -> Reports:
        """Return a system's reports about itself, joined with those in the records of an onboard log."""
        return self.senders.get(0, _Sender()).reports.joined(self.senders[system].reports)

    def watch(self, batches: Iterable[Batch]) -> Iterator[Batch]:
        """Yield the messages of the vehicle that a fit would choose, and note that vehicle."""
        for batch in of_one_vehicle(batches):
            self.watched = next((entry.system for entry in batch.entries if entry.source is MAVLINK), self.watched)
            yield batch


def _note(sender: _Sender, message: Message) -> None:
    """Process a report: the autopilot's heartbeat tells what the vehicle is, any other heartbeat what its sender is."""
    sender.reports = sender.reports.after(message)
    if message.name != "HEARTBEAT" or message.source is not MAVLINK:
        return
    fields = message.fields
    own = is_autopilot_heartbeat(message)
    if own or sender.autopilot is None:
        said = (fields.get(name) for name in ("type", "autopilot"))
        sender.type, sender.autopilot = (value if type(value) is int else None for value in said)
    mode = fields.get("base_mode")
    if not own or not isinstance(mode, int):
        return
    sender.heartbeats += 1
    if sender.armed_since_ns is not None:
        step_ns = message.received_ns - sender.armed_since_ns
        if -_SILENCE_NS < step_ns <= 0 and mode & ARMED:
            return  # a heartbeat that an onboard log wrote late: no time has passed
        sender.armed_ns += step_ns if 0 < step_ns < _SILENCE_NS else 0
    sender.armed_since_ns = message.received_ns if mode & ARMED else None


def log_info(path: Path) -> dict[str, Any]:
    """Read a recording and return its content as a JSON object.

    Raises
    ------
    TelemetryError
        The file is no recording, or holds no record of its kind.
    """
    kind = recording_kind(path)
    tally, recording = _Tally(), Recording(path)
    batches = track(recording.batches(), f"reading {path.name}", weigh=lambda batch: batch.count)
    surveyed = survey(tally.watch(tally.count(batches)))
    first_ns = tally.first_ns
    return {
        "file": str(path),
        "kind": "recording",
        "format": kind,
        "start_ns": first_ns,
        "start": None if first_ns is None else f"{utc(first_ns)[:19]}Z",
        "duration_s": 0.0 if first_ns is None else (tally.last_ns - first_ns) / 1e9,
        "count": tally.counts.total(),
        "records": tally.records,
        "messages": {name: _message(name, tally, surveyed) for name in sorted(tally.counts)},
        "link": tally.link.figures().rounded(),
        "systems": [_system(number, tally) for number, sender in sorted(tally.senders.items()) if sender.messages],
        "vehicle": _fits(surveyed, tally, recording.topics),
        "fields": {name: _paths(fields) for name, fields in sorted(tally.examples.items())},
        "recorded": recorded_metadata(path) or None,
        "alarms": first_raised(recorded_alarms(path)),
        "damage": [damage.to_json() for damage in recording.damage()],
    }


def _message(name: str, tally: _Tally, surveyed: Survey) -> dict[str, Any]:
    """Return count and rate: on the vehicle's clock if the message has a time, else by arrival.

    A few bursts, such as parameters at the begin of a log, have no rate.
    """
    count = tally.counts[name]
    rate = surveyed.rate_hz.get(name) if surveyed.counts.get(name) == count else None
    rate = tally.rates[name].hz if rate is None else rate
    lasts_s = 1e-9 * (tally.last_ns - (tally.first_ns or 0))
    if rate is not None and count / rate < min(_BURST_S, 0.5 * lasts_s):
        rate = None
    return {"count": count, "rate_hz": rate}


def _system(number: int, tally: _Tally) -> dict[str, Any]:
    sender = tally.senders[number]
    # ArduPilot's logs hold no HEARTBEAT with the type: the ones made from them have the type "generic" (0)
    known = "" if sender.type else tally.said(number).identity.vehicle_type.replace(" ", "_")
    return {
        "system": number,
        "components": sorted(sender.components),
        "type": known or (None if sender.type is None else enumerated("MAV_TYPE", sender.type)),
        "autopilot": None if sender.autopilot is None else enumerated("MAV_AUTOPILOT", sender.autopilot),
        "messages": sender.messages,
        "heartbeats": sender.heartbeats,
        "armed_s": sender.armed_ns / 1e9,
    }


def _fits(surveyed: Survey, tally: _Tally, topics: Mapping[str, str]) -> dict[str, Any] | None:
    """Return which observers could be fitted to the vehicle's messages, None if there is no vehicle."""
    if tally.watched is None:
        fits = {kind.name: _fit(kind, surveyed) for kind in KINDS if kind.types}
        if not any(fit["possible"] for fit in fits.values()):
            return None
        return {"system": None, "likely": None, "never_armed": False, "inputs": {}, "fits": fits}
    fits = {kind.name: _fit(kind, surveyed) for kind in KINDS if kind.preview}
    for name in _FIELD_RECORDS:
        rate_hz = tally.rates[name].hz if name in tally.rates else None
        for fit in fits.values():
            if "compass" in fit["watches"] and rate_hz is not None and round(rate_hz) < _FIELD_HZ:
                fit["missing"].append(
                    f"{name} at {_FIELD_HZ:g} Hz: it comes at {rate_hz:.3g} Hz, so that a compass shows faults of tens "
                    "of degrees only" + " (SDLOG_PROFILE 2065 logs it at 14 Hz)" * surveyed.px4
                )
    vehicle_type = tally.said(tally.watched).identity.vehicle_type
    likely = [kind.name for kind in likely_kinds(KINDS, vehicle_type)]
    # a submarine has motors, but no kind of vehicle knows how they act
    likely += ["inertial"] if vehicle_type else []
    return {
        "system": tally.watched,
        "likely": likely[0] if likely else None,
        "never_armed": surveyed.never_armed,
        "inputs": {
            name: {"holds": holds, "rate_hz": rate_hz, "from": topics.get(name)}
            for name, holds in _INPUTS.items()
            if name in tally.counts and (rate_hz := _message(name, tally, surveyed)["rate_hz"]) is not None
        },
        "fits": fits,
    }


def _fit(kind: VehicleKind, surveyed: Survey) -> dict[str, Any]:
    try:
        preview: Preview = load(kind.preview)(surveyed)
    except TelemetryError as error:
        nothing: dict[str, Any] = {"watches": [], "channels": {}, "rate_hz": None, "facts": [], "hides": None}
        return {"possible": False, "missing": [str(error)], **nothing}
    slow = slow_messages([surveyed.rate_hz], preview.channels, kind.wanted_hz)
    seldom = [
        f"{name} at {kind.wanted_hz:g} Hz: it comes at {rate:.3g} Hz"
        + (f"; {motor_gain(rate)}" if kind.name == "multirotor" and name == MOTOR_MESSAGE else "")
        for name, rate in slow.items()
    ]
    json = preview.to_json()
    hides = hidden([surveyed], preview.channels)
    return {"possible": True, **json, "missing": json["missing"] + seldom, "hides": hides}


def _paths(fields: Mapping[str, Any]) -> list[str]:
    """Return the paths of the numbers in a message, as a profile's channels name them."""
    paths: list[str] = []

    def go(value: Any, path: str, names: Any) -> None:
        if len(paths) >= _MAX_FIELDS:
            return
        if isinstance(value, Mapping):
            for key, inner in value.items():
                go(inner, f"{path}.{key}" if path else key, value.get("name"))
        elif isinstance(value, list):
            named = isinstance(names, list) and len(names) == len(value)
            for at, inner in enumerate(value[:_MAX_ELEMENTS]):
                go(inner, f"{path}[{names[at] if named else at}]", None)
        elif isinstance(value, int | float) and not isinstance(value, bool):
            paths.append(path)

    go(fields, "", None)
    return paths
