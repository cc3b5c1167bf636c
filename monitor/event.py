"""Alarm events: the JSON object that subscribers, journals and files carry, one per change of state."""

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, fields, replace
from types import UnionType
from typing import Annotated, Any, Final, Literal, NamedTuple, TypeGuard, get_args, get_origin, get_type_hints

from monitor.display import fault_text

Kind = Literal["actuator", "sensor", "residual", "stale", "security", "system", "blind"]
State = Literal["raised", "updated", "acknowledged", "shelved", "cleared"]
Severity = Literal["warning", "critical"]

UNNUMBERED = 0
"""Sequence number of an event that the vehicle's alarm desk has not seen yet."""

# Larger than any time or size, and finite as a float; numbers of events leave room to count on in 64 bits.
_LARGEST = 1 << 100
_LARGEST_SEQ = 1 << 62
_CROCKFORD = "0123456789ABCDEFGHJKMNPQRSTVWXYZ"


@dataclass(frozen=True, slots=True)
class AlarmEvent:
    """One change of state of one alarm; its JSON Schema and its protobuf message are made of these fields."""

    id: Annotated[str, "ULID, the same from raised to cleared"]
    vehicle: str
    observer: str
    channel: str
    kind: Kind  # ``system``: trouble of the monitor's own; ``blind``: a vehicle flies and is not watched
    state: State
    severity: Severity
    estimate: Annotated[float | None, "size of the fault now, in unit"]
    relative: Annotated[float | None, "estimate divided by the command, for faults that are a share of it"]
    unit: str
    threshold: Annotated[float, "size of estimate from which the alarm is raised"]
    time_ns: Annotated[int, "Unix time of the sample that caused the event"]
    vehicle_time_ms: Annotated[int, "the same on the vehicle's own clock"]
    since_ns: Annotated[int, "Unix time of the sample that raised the alarm"]
    peak: Annotated[float | None, "largest estimate since it was raised"]
    message: Annotated[str, "one sentence for a person"]
    seq: Annotated[int, "number of the event among the vehicle's: later ones have larger numbers"]
    acknowledged: Annotated[bool, "an operator has acknowledged it"] = False
    latched: Annotated[bool, "it stays active although its cause is gone, until it is reset"] = False
    shelved_until_ns: Annotated[int | None, "Unix time at which shelving ends"] = None
    creeping: Annotated[bool, "only the mean over some seconds shows it; estimate is that mean"] = False
    recurring: Annotated[bool, "it comes and goes, and clears only after a longer quiet than before"] = False
    display: Annotated[str, "the size for people, from estimate, relative and unit; empty without a size"] = ""
    false_per_100h: Annotated[float | None, "expected false alarms of the channel in 100 hours, by its fit"] = None
    part: Annotated[str | None, "channel that locates the cause between command and thrust: escN, propN"] = None
    sd: Annotated[float | None, "standard deviation of estimate, in unit; null where it is not known"] = None
    instead: Annotated[str | None, "channel that may be responsible in place of this one: not told apart yet"] = None

    def __post_init__(self) -> None:
        """Derive the displayed size, so that it always follows from the other fields."""
        object.__setattr__(self, "display", fault_text(self.channel, self.estimate, self.relative, self.unit))

    def to_json(self) -> dict[str, Any]:
        """Return the event as the JSON object of the contract."""
        return {field.name: getattr(self, field.name) for field in fields(self)}


def event_from_json(data: Mapping[str, Any]) -> AlarmEvent:
    """Return the event a JSON object describes; raise ValueError if a field is missing."""
    missing = [field.name for field in fields(AlarmEvent) if field.name not in data and field.default is MISSING]
    if missing:
        raise ValueError(f"alarm event lacks '{missing[0]}'")
    return AlarmEvent(**{field.name: data[field.name] for field in fields(AlarmEvent) if field.name in data})


def valid_event(payload: Any) -> AlarmEvent | None:
    """Return the event in a decoded payload, or None if its names, types or sizes are not those of an event."""
    if not isinstance(payload, dict):
        return None
    try:
        event = event_from_json(payload)
    except ValueError:
        return None
    sound = all(
        (value is None and known.optional) or _IS_SOUND[known.kind](value)
        for name, known in ALARM_FIELDS.items()
        for value in (getattr(event, name),)
    )
    return event if sound and is_seq(event.seq) else None


def is_seq(value: object) -> TypeGuard[int]:
    """Return whether a value can be the number of an event."""
    return type(value) is int and 0 <= value <= _LARGEST_SEQ


def _is_count(value: object) -> bool:
    return type(value) is int and -_LARGEST <= value <= _LARGEST


_IS_SOUND: Mapping[type, Callable[[Any], bool]] = {
    str: lambda value: isinstance(value, str),
    bool: lambda value: type(value) is bool,
    int: _is_count,
    float: lambda value: value is None or type(value) is float or _is_count(value),
}


class AlarmField(NamedTuple):
    """Description of a field of an event."""

    kind: type  # str, int, float or bool; in JSON, null stands for a float that it cannot write
    optional: bool  # whether it may be None
    choices: tuple[str, ...]  # its allowed texts; empty: any
    description: str


def _field(hint: Any) -> AlarmField:
    hint, *words = get_args(hint) if get_origin(hint) is Annotated else (hint,)
    choices = get_args(hint) if get_origin(hint) is Literal else ()
    kind = get_args(hint)[0] if isinstance(hint, UnionType) else hint
    return AlarmField(str if choices else kind, isinstance(hint, UnionType), choices, "".join(words))


ALARM_FIELDS: Final = {name: _field(hint) for name, hint in get_type_hints(AlarmEvent, include_extras=True).items()}


def alarm_id(vehicle: str, observer: str, channel: str, since_ns: int) -> str:
    """Return the ULID of an alarm: its time in milliseconds and 80 bits that depend on the alarm only.

    A replay of the same samples therefore gives the same ids.
    """
    digest = hashlib.blake2b(f"{vehicle}/{observer}/{channel}@{since_ns}".encode(), digest_size=10).digest()
    number = (since_ns // 1_000_000 & (1 << 48) - 1) << 80 | int.from_bytes(digest)
    return "".join(_CROCKFORD[number >> shift & 31] for shift in range(125, -1, -5))


def fixed_rule_event(
    vehicle: str,
    observer: str,
    channel: str,
    *,
    kind: Kind,
    state: State,
    unit: str,
    threshold: float,
    time_ns: int,
    vehicle_time_ms: int,
    message: str,
    since_ns: int | None = None,
    severity: Severity = "warning",
    estimate: float | None = None,
) -> AlarmEvent:
    """Return an event of an alarm that no profile calibrates; ``since_ns`` None: it begins with this event."""
    since_ns = time_ns if since_ns is None else since_ns
    return AlarmEvent(
        id=alarm_id(vehicle, observer, channel, since_ns),
        vehicle=vehicle,
        observer=observer,
        channel=channel,
        kind=kind,
        state=state,
        severity=severity,
        estimate=estimate,
        relative=None,
        unit=unit,
        threshold=threshold,
        time_ns=time_ns,
        vehicle_time_ms=vehicle_time_ms,
        since_ns=since_ns,
        peak=estimate,
        message=message,
        seq=UNNUMBERED,
    )


def next_event(
    before: AlarmEvent, state: State, time_ns: int, vehicle_time_ms: int, message: str, **changes: Any
) -> AlarmEvent:
    """Return the next event of such an alarm, unnumbered; ``changes`` are other fields that change."""
    changes |= {"time_ns": time_ns, "vehicle_time_ms": vehicle_time_ms, "message": message, "seq": UNNUMBERED}
    return replace(before, state=state, **changes)
