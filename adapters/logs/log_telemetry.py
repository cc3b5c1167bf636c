"""Records of an onboard log -> the MAVLink messages they stand for, each with the time of the record that makes it."""

from __future__ import annotations

import struct
from collections import Counter, deque
from collections.abc import Collection, Iterable, Iterator, Mapping
from itertools import chain, pairwise
from math import asin, atan2, isfinite
from typing import Any

from adapters.channels import follow
from adapters.logs.log_mapping import FieldRule, LogMapping, MessageRule
from adapters.message import Message
from adapters.source import MAVLINK

# Ids of the vehicle: logs do not say, and autopilots are 1, 1 unless told otherwise.
_SYSTEM = _COMPONENT = 1
# How much of a log is looked at before it is decided from which records messages are filled.
_LOOKED_AT_NS = 5_000_000_000
_LOOKED_AT = 20_000
_PATIENCE_NS = 1_000_000_000
_MOST_WAITING = 2_000
_TURN = 6.283185307179586
# A rotation is of length one; NaN is no number at all and not below this either.
_LARGEST_QUATERNION = 2.0


def telemetry(messages: Iterable[Message], mapping: LogMapping, only: Collection[str] | None) -> Iterator[Message]:
    """Return a log's records and, behind each, the MAVLink messages that it makes or completes.

    Which record fills a message is decided on the first 5 s of the log, or with the first record that can.

    Parameters
    ----------
    messages : Iterable[Message]
        The log; messages of other sources pass.
    mapping : LogMapping
        What the records stand for.
    only : Collection[str] | None
        Names of records and MAVLink messages wanted; None wants all.
    """
    found = _Telemetry(mapping, only)
    ahead: list[Message] = []
    first_ns: int | None = None
    remaining = iter(messages)
    for message in remaining:
        ahead.append(message)
        if found.note(message) and first_ns is None:
            first_ns = message.received_ns
        far = first_ns is not None and message.received_ns - first_ns >= _LOOKED_AT_NS
        if far or len(ahead) >= _LOOKED_AT:
            break
    found.choose()
    for message in chain(ahead, remaining):
        yield from found.feed(message)
    yield from found.finish()


class _Telemetry:
    """Which rules are in use, and the records that messages wait for."""

    def __init__(self, mapping: LogMapping, only: Collection[str] | None) -> None:
        rules = {name: found for name, found in mapping.rules.items() if only is None or name in only}
        self._only = only
        self._open = LogMapping(rules)
        self._counts: Counter[str] = Counter()
        self._examples: dict[str, Mapping[str, Any]] = {}
        self._made: dict[str, list[_Filler]] = {}
        self._joined: dict[str, list[_Filler]] = {}
        self._states: list[_Filler] = []
        self._fillers: list[_Filler] = []
        self._relevant = self._open.topics(rules.keys())

    def note(self, message: Message) -> bool:
        """Count a record, to decide by; return whether there is anything to decide."""
        if message.name not in self._relevant:
            return False
        self._counts[message.name] += 1
        self._examples[message.name] = message.fields
        return True

    def choose(self) -> None:
        """Decide for the messages that what was counted can fill."""
        for name, rule in self._open.guess(self._counts, self._examples).items():
            filler = _Filler(rule)
            self._fillers.append(filler)
            self._made.setdefault(rule.topic, []).append(filler)
            for topic in rule.topics - {rule.topic}:
                self._joined.setdefault(topic, []).append(filler)
            if rule.repeat_ns is not None:
                self._states.append(filler)
            self._open = LogMapping({key: found for key, found in self._open.rules.items() if key != name})
        self._relevant = self._open.topics(self._open.rules.keys())

    def feed(self, message: Message) -> Iterator[Message]:
        """Take a record; return it, where it is wanted, and what it makes."""
        if self._only is None or message.name in self._only:
            yield message
        if self.note(message):
            self.choose()
        for filler in self._states:
            yield from filler.repeat(message.received_ns)
        for filler in self._joined.get(message.name, ()):
            yield from filler.join(message)
        for filler in self._made.get(message.name, ()):
            yield from filler.make(message)

    def finish(self) -> Iterator[Message]:
        """Return what still waits."""
        for filler in self._fillers:
            yield from filler.finish()


class _Filler:
    """Fills one kind of message by a rule; waits where values are interpolated between records yet to come."""

    def __init__(self, rule: MessageRule) -> None:
        self._rule = rule
        self._packed = struct.Struct(rule.codes)
        self._linear = {topic: deque[Message]() for topic in sorted(rule.linear)}
        self._held: dict[str, Message] = {}
        self._waiting: deque[tuple[Message, dict[str, Message]]] = deque()
        self._last: Message | None = None

    def join(self, message: Message) -> Iterator[Message]:
        """Take a record that adds to messages; return those that it completes."""
        row = self._linear.get(message.name)
        if row is None:
            self._held[message.name] = message
            return
        if row and not 0 < message.received_ns - row[-1].received_ns < _PATIENCE_NS:
            if message.received_ns == row[-1].received_ns:
                return
            row.clear()
        row.append(message)
        yield from self._release(message.received_ns)

    def make(self, message: Message) -> Iterator[Message]:
        """Take a record that makes a message; return the messages that are complete."""
        self._waiting.append((message, dict(self._held) if self._linear else self._held))
        yield from self._release(message.received_ns)

    def repeat(self, now_ns: int) -> Iterator[Message]:
        """Return a state again, if that is due."""
        last, every_ns = self._last, self._rule.repeat_ns or 0
        if last is not None and not -every_ns < now_ns - last.received_ns < every_ns:
            self._last = Message(MAVLINK, last.name, now_ns, last.fields, _SYSTEM, _COMPONENT)
            yield self._last

    def finish(self) -> Iterator[Message]:
        """Return what waits, with what is not known left unknown."""
        while self._waiting:
            yield from self._filled(*self._waiting.popleft(), {})

    def _release(self, now_ns: int) -> Iterator[Message]:
        while self._waiting:
            message, held = self._waiting[0]
            time_ns = message.received_ns
            pairs: dict[str, tuple[Message, Message] | None] = {}
            early = late = False
            for topic, row in self._linear.items():
                while len(row) > 2 and row[1].received_ns <= time_ns:
                    row.popleft()
                early |= bool(row) and row[0].received_ns > time_ns
                late |= not row or row[-1].received_ns < time_ns
                pairs[topic] = _around(row, time_ns)
            if late and not early and abs(now_ns - time_ns) < _PATIENCE_NS and len(self._waiting) < _MOST_WAITING:
                return
            self._waiting.popleft()
            if not early:
                yield from self._filled(message, held, pairs)

    def _filled(
        self, message: Message, held: Mapping[str, Message], pairs: Mapping[str, tuple[Message, Message] | None]
    ) -> Iterator[Message]:
        """Return the message that a record makes; none where it stands for none, or for what no message can hold."""
        values = []
        for field in self._rule.fields:
            value: float | int | None
            if field.channel is None:
                value = field.constant
            elif not field.joined:
                value = _value(field, message.fields)
                if value is None and field.values is not None:
                    return
            elif field.topic in self._linear:
                pair = pairs.get(field.topic)
                value = None if pair is None else _between(field, *pair, message.received_ns)
            else:
                other = held.get(field.topic)
                value = None if other is None else _value(field, other.fields)
            values.append(field.unknown if value is None else value)
        packed = _packed(self._packed, self._rule, values)
        names = (field.name for field in self._rule.fields)
        fields = dict(zip(names, self._packed.unpack(packed), strict=True))
        made = Message(MAVLINK, self._rule.message, message.received_ns, fields, _SYSTEM, _COMPONENT)
        self._last = made
        yield made


def _packed(packer: struct.Struct, rule: MessageRule, values: list[int | float]) -> bytes:
    """Return the values as the message carries them, whole numbers to the nearest; unknown where one does not fit."""
    fitted: list[int | float] = []
    for field, code, value in zip(rule.fields, rule.codes[1:], values, strict=True):
        if code in "fd" or type(value) is int:
            fitted.append(value)
            continue
        period = None if field.channel is None or code.islower() else field.channel.period
        wrapped = value if period is None else value % period
        fitted.append(round(wrapped) if isfinite(wrapped) else field.unknown)
    try:
        return packer.pack(*fitted)
    except (struct.error, OverflowError):
        return b"".join(map(_fitting, rule.fields, rule.codes[1:], fitted))


def _fitting(field: FieldRule, code: str, value: int | float) -> bytes:
    try:
        return struct.pack("<" + code, value)
    except (struct.error, OverflowError):
        return struct.pack("<" + code, field.unknown)


def _value(field: FieldRule, fields: Mapping[str, Any]) -> float | int | None:
    channel = field.channel
    if channel is None:
        return field.constant
    if field.angle is None and field.values is None:
        return channel.value(fields)
    found = follow(fields, channel.path)
    if field.values is not None:
        value = field.values.get(str(int(found))) if isinstance(found, int) else None
        return _value(field.otherwise, fields) if value is None and field.otherwise is not None else value
    return _angle(found, field.angle or "roll")


def _angle(quaternion: Any, which: str) -> float | None:
    """Return an angle of a rotation from body (x ahead, z down) to earth axes, radians."""
    if not isinstance(quaternion, list) or len(quaternion) != 4:
        return None
    if not all(type(q) is float and abs(q) < _LARGEST_QUATERNION for q in quaternion):
        return None
    w, x, y, z = quaternion
    if which == "roll":
        return atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    if which == "yaw":
        return atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return asin(max(-1.0, min(1.0, 2.0 * (w * y - z * x))))


def _around(row: deque[Message], time_ns: int) -> tuple[Message, Message] | None:
    for left, right in pairwise(row):
        if left.received_ns <= time_ns <= right.received_ns:
            return left, right
    return (row[-1], row[-1]) if row and row[-1].received_ns == time_ns else None


def _between(field: FieldRule, left: Message, right: Message, time_ns: int) -> float | None:
    """Return a value at a time from those on either side, the shorter way round where it wraps."""
    if time_ns in (left.received_ns, right.received_ns):
        return _value(field, (left if time_ns == left.received_ns else right).fields)
    before, after = _value(field, left.fields), _value(field, right.fields)
    if before is None or after is None:
        return None
    step = after - before
    period = _TURN if field.angle else field.channel.period if field.channel is not None else None
    if period is not None:
        step = (step + 0.5 * period) % period - 0.5 * period
    return before + step * (time_ns - left.received_ns) / (right.received_ns - left.received_ns)
