"""Alarm events: the JSON object that subscribers, journals and files carry, one per change of state."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields
from typing import Any, Literal, TypeGuard

Kind = Literal["actuator", "sensor", "residual", "stale", "security", "system"]
State = Literal["raised", "updated", "acknowledged", "shelved", "cleared"]
Severity = Literal["warning", "critical"]

UNNUMBERED = 0
"""Sequence number of an event that the vehicle's alarm desk has not seen yet."""

_TEXTS = ("id", "vehicle", "observer", "channel", "kind", "state", "severity", "unit", "message")
_COUNTS = ("time_ns", "vehicle_time_ms", "since_ns")
_NUMBERS = ("estimate", "relative", "threshold", "peak")
_FLAGS = ("acknowledged", "latched", "creeping", "recurring")
# Beyond any time or size, and within what floats can express; numbers of events leave room to count on in 64 bits.
_LARGEST = 1 << 100
_LARGEST_SEQ = 1 << 62
_CROCKFORD = "0123456789ABCDEFGHJKMNPQRSTVWXYZ"


@dataclass(frozen=True, slots=True)
class AlarmEvent:
    """One change of state of one alarm.

    Parameters
    ----------
    id : str
        ULID, the same from raised to cleared.
    vehicle, observer, channel : str
        What the alarm is about.
    kind : {"actuator", "sensor", "residual", "stale", "security", "system"}
        What sort of trouble; ``system``: the monitor's own.
    state : {"raised", "updated", "acknowledged", "shelved", "cleared"}
        The state entered by this event.
    severity : {"warning", "critical"}
        How bad.
    estimate : float | None
        Size of the fault now, in ``unit``; None for a stale alarm.
    relative : float | None
        Estimate over command where that makes sense (loss of effectiveness), else None.
    unit : str
        Unit of ``estimate``, ``threshold`` and ``peak``.
    threshold : float
        What the estimate has to exceed to raise the alarm.
    time_ns : int
        Unix time of the sample that caused the event, nanoseconds.
    vehicle_time_ms : int
        The same on the vehicle's own clock, milliseconds.
    since_ns : int
        Unix time of the sample that raised the alarm.
    peak : float | None
        Largest estimate (by size) since it was raised.
    message : str
        One sentence for a person.
    seq : int
        Counts the vehicle's events from 1.
    acknowledged : bool
        Whether an operator has acknowledged it.
    latched : bool
        Whether the alarm stays active although its cause is gone, until an operator resets it.
    shelved_until_ns : int | None
        Unix time at which shelving ends; None where the alarm is not shelved.
    creeping : bool
        Whether only the mean over seconds shows it: ``estimate`` is that mean.
    recurring : bool
        Whether it comes and goes, and clears only after a long quiet.
    """

    id: str
    vehicle: str
    observer: str
    channel: str
    kind: Kind
    state: State
    severity: Severity
    estimate: float | None
    relative: float | None
    unit: str
    threshold: float
    time_ns: int
    vehicle_time_ms: int
    since_ns: int
    peak: float | None
    message: str
    seq: int
    acknowledged: bool = False
    latched: bool = False
    shelved_until_ns: int | None = None
    creeping: bool = False
    recurring: bool = False

    def to_json(self) -> dict[str, Any]:
        """Return the event as the JSON object of the contract."""
        return {field.name: getattr(self, field.name) for field in fields(self)}


def event_from_json(data: Mapping[str, Any]) -> AlarmEvent:
    """Return the event a JSON object describes.

    Raises
    ------
    ValueError
        A field is missing.
    """
    missing = [field.name for field in fields(AlarmEvent) if field.name not in data and field.default is MISSING]
    if missing:
        raise ValueError(f"alarm event lacks '{missing[0]}'")
    return AlarmEvent(**{field.name: data[field.name] for field in fields(AlarmEvent) if field.name in data})


def valid_event(payload: Any) -> AlarmEvent | None:
    """Return the event a decoded payload holds, None where names, types or sizes are not those of an event."""
    if not isinstance(payload, dict):
        return None
    try:
        event = event_from_json(payload)
    except ValueError:
        return None
    right = (
        all(isinstance(getattr(event, name), str) for name in _TEXTS)
        and all(_is_count(getattr(event, name)) for name in _COUNTS)
        and all(_is_number(getattr(event, name)) for name in _NUMBERS)
        and all(type(getattr(event, name)) is bool for name in _FLAGS)
        and (event.shelved_until_ns is None or _is_count(event.shelved_until_ns))
        and is_seq(event.seq)
    )
    return event if right else None


def is_seq(value: object) -> TypeGuard[int]:
    """Return whether a value can be the number of an event."""
    return type(value) is int and 0 <= value <= _LARGEST_SEQ


def _is_count(value: object) -> bool:
    return type(value) is int and -_LARGEST <= value <= _LARGEST


def _is_number(value: object) -> bool:
    return value is None or type(value) is float or _is_count(value)


def alarm_id(vehicle: str, observer: str, channel: str, since_ns: int) -> str:
    """Return the ULID of an alarm: its time in milliseconds and 80 bits that depend on nothing but the alarm.

    A replay of the same samples therefore gives the same ids.
    """
    digest = hashlib.blake2b(f"{vehicle}/{observer}/{channel}@{since_ns}".encode(), digest_size=10).digest()
    number = (since_ns // 1_000_000 & (1 << 48) - 1) << 80 | int.from_bytes(digest)
    return "".join(_CROCKFORD[number >> shift & 31] for shift in range(125, -1, -5))
