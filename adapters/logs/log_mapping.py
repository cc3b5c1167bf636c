"""MAVLink messages from records of an onboard log: the tables, built in or a user's own, and the choice among them.

A profile names MAVLink messages. An onboard log holds the same quantities with names and units of its own. A table per
message names their records and fields, so that one profile serves both. If a table has several ways, the log's contents
decide.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
from math import isnan, nan
from pathlib import Path
from typing import Any, Final

from adapters.channels import CLOCK_UNITS_NS, Angle, Channel, follow, not_empty, read_channel
from adapters.errors import TelemetryError
from adapters.mavlink.mavlink_message import message_tables
from adapters.toml_tables import Table, TomlFile, parse_toml, read_toml

ONBOARD_SOURCES: Final = ("ulog", "dataflash")

_ANGLES: Final[tuple[Angle, ...]] = ("roll", "pitch", "yaw")
_OF_CHANNELS = ("field", "scale", "offset", "period", "interpolation")
_LONGEST_REPEAT_S = 1e6
"""Longest time between repeats of a state, seconds. Chosen: twelve days, longer than any log; in nanoseconds it fits 64
bits."""
_INSTANCES = 4
"""Most instances of a topic in PX4 (ORB_MULTI_MAX_INSTANCES) until 1.12, and of outputs since."""
# Of two ways to fill a message, the later one is taken only if its record comes this much more often. Chosen: rates of
# records that are logged together differ by less; the next slower setting of a logger is a half.
_CLEARLY = 1.5
# Stamps are as fine and as large as the log's own: whole milliseconds of 32 bits hold neither microseconds nor UTC.
_CLOCK_CODES = {"time_boot_ms": "d", "time_usec": "Q"}
PARAMETERS: Final = "PARM"
"""Records that show whether ArduPilot logged before it was armed."""


@dataclass(frozen=True, slots=True)
class FieldRule:
    """One field of a MAVLink message."""

    name: str  # the field
    topic: str  # name of the log's record that holds it
    channel: Channel | None  # field in that record, scale and offset; None for a constant
    # taken from another record than the one that makes the message: interpolated linearly to the time of that record,
    # or its last value, depending on the channel
    joined: bool
    angle: Angle | None  # angle to take from the channel's field, a quaternion (w, x, y, z), body to earth
    # the field's values by whole numbers of the log; a number that is not listed makes no message, unless ``otherwise``
    # has a value for it
    values: Mapping[str, int] | None
    constant: int | None  # the value
    unknown: int | float  # the value if the log has none
    required: bool  # the log must have this field to fill the message
    code: str  # struct code of the value in the message
    otherwise: FieldRule | None = None  # other field of the same record for a number that is not listed
    # The two values of a state: before the first record, it has the value that the first record does not have. Without
    # any record it has the first value in a log of ArduPilot that was begun at arming, the second in one that was begun
    # before.
    before: tuple[int, int] | None = None

    @property
    def array(self) -> str | None:
        """Name of the array that contains the field as an element, None if it is a field of its own."""
        name, bracket, _ = self.name.partition("[")
        return name if bracket else None

    def places(self) -> Iterator[FieldRule]:
        """Yield the rule and its alternatives (``otherwise``)."""
        yield self
        if self.otherwise is not None:
            yield from self.otherwise.places()


@dataclass(frozen=True, slots=True)
class MessageRule:
    """One way to fill a MAVLink message: the name of the log's record that makes one, and the sources of its fields.

    The fields are complete, in the order of the definition, elements of an array one by one. A state is repeated after
    ``repeat_ns``. Of a topic with several instances, the one is used in which most elements of the list ``moves``
    change in the log: a mixer's outputs are logged even if nothing is connected to them.
    """

    message: str
    topic: str
    fields: tuple[FieldRule, ...]
    repeat_ns: int | None
    moves: str | None = None
    # further messages of the same name from the same records, with fields that do not fit the first
    further: tuple[MessageRule, ...] = ()

    @property
    def instances(self) -> tuple[str, ...]:
        """Names of the topic's records, for each instance that may fill the message."""
        return (self.topic, *(f"{self.topic}/{k}" for k in range(1, _INSTANCES) if self.moves))

    def of_instance(self, topic: str) -> MessageRule:
        """Return the rule for one instance of its topic."""
        own = tuple(replace(field, topic=topic) if field.topic == self.topic else field for field in self.fields)
        return replace(self, topic=topic, fields=own, moves=None)

    @property
    def linear(self) -> Mapping[str, bool]:
        """Records between which values are interpolated, and whether the message needs each of them."""
        required: dict[str, bool] = {}
        for field in self.fields:
            if field.joined and field.channel is not None and field.channel.interpolation == "linear":
                required[field.topic] = required.get(field.topic, False) or field.required
        return required

    @property
    def before(self) -> tuple[int, int] | None:
        """The two values of a state in the message."""
        return next((field.before for field in self.fields if field.before), None)

    @property
    def topics(self) -> frozenset[str]:
        """Names of all records that fill the message."""
        topics = {*self.instances, *(field.topic for field in self.fields if field.channel is not None)}
        topics = topics.union(*(rule.topics for rule in self.further))
        return frozenset(topics if self.before is None else topics | {PARAMETERS})

    def fillable(self, examples: Mapping[str, Mapping[str, Any]]) -> bool:
        """Return whether a log with such records has all that is needed."""
        needed = {self.topic, *(topic for topic, required in self.linear.items() if required)}
        return needed <= examples.keys() and all(
            follow(examples[place.topic], place.channel.path) is not None
            for field in self.fields
            for place in field.places()
            if place.channel is not None and place.required and place.topic in needed
        )


@dataclass(frozen=True, slots=True)
class LogMapping:
    """Ways to fill MAVLink messages by the message's name, in order of preference."""

    rules: Mapping[str, tuple[MessageRule, ...]]

    def topics(self, only: Collection[str]) -> frozenset[str]:
        """Return the names of the records that could fill the given messages."""
        return frozenset().union(*(rule.topics for name, rules in self.rules.items() if name in only for rule in rules))

    def guess(self, counts: Mapping[str, int], examples: Mapping[str, Mapping[str, Any]]) -> dict[str, MessageRule]:
        """Return the rules that fill the messages from a log: the first way that the log can fill.

        A later way is taken if its record comes half as often again. ``counts`` are records by name, ``examples`` the
        fields of any record of each name.
        """
        chosen = {}
        for name, rules in self.rules.items():
            able = [rule for rule in rules if rule.fillable(examples)]
            if able:
                most = max(counts[rule.topic] for rule in able)
                chosen[name] = next(rule for rule in able if _CLEARLY * counts[rule.topic] >= most)
        return chosen


@cache
def builtin_mapping(source: str) -> LogMapping:
    """Return the tables for logs of a source, one of :data:`ONBOARD_SOURCES`."""
    path = files("adapters") / "definitions" / "logs" / f"{source}.toml"
    return parse_mapping(parse_toml(path.name, path.read_bytes(), TelemetryError))


def read_mapping(path: str | os.PathLike[str], source: str) -> LogMapping:
    """Return the built-in tables, with those of a user's TOML file instead of the ones of the same message."""
    own = parse_mapping(read_toml(Path(path), TelemetryError))
    return LogMapping({**builtin_mapping(source).rules, **own.rules})


def parse_mapping(file: TomlFile) -> LogMapping:
    """Return the tables of a TOML document: ``[[MESSAGE]]`` with ``topic``, ``repeat_s`` and a table per field.

    Raises
    ------
    TelemetryError
        A table is invalid; one line per mistake.
    """
    rules = {}
    for message in file.root:
        kinds = _kinds(message)
        if kinds is None:
            file.root.mistake(message, "is no MAVLink message")
        else:
            rules[message] = tuple(_rule(message, kinds, table) for table in file.root.tables(message))
    file.check()
    return LogMapping(rules)


@cache
def _kinds(message: str) -> dict[str, tuple[str, int]] | None:
    """Return struct code and length of each field of a message by pymavlink's table, or None if it has no such message.

    Text has no code, and the length of a field that is no array is 0.
    """
    codes = {"float": "f", "double": "d", "char": "", "int8_t": "b", "uint8_t": "B", "int16_t": "h", "uint16_t": "H"}
    codes |= {"int32_t": "i", "uint32_t": "I", "int64_t": "q", "uint64_t": "Q"}
    table = message_tables().get(message)
    if table is None:
        return None
    lengths = dict(zip(table.ordered_fieldnames, table.array_lengths, strict=True))
    kinds = zip(table.fieldnames, table.fieldtypes, strict=True)
    return {name: (_CLOCK_CODES.get(name, codes[kind]), lengths[name]) for name, kind in kinds}


def _rule(message: str, kinds: Mapping[str, tuple[str, int]], table: Table) -> MessageRule:
    topic = table.text("topic", check=not_empty)
    repeat_s = table.number("repeat_s", above=0.0, at_most=_LONGEST_REPEAT_S) if table.has("repeat_s") else nan
    moves = table.text("moves", check=not_empty) if table.has("moves") else None
    fields: list[FieldRule] = []
    for name, (code, length) in kinds.items():
        if code and not length:
            own = table.table(name) if table.has(name) else None
            fields.append(_field(name, code, topic, own if table.good(name) else None))
        elif table.has(name):
            elements = table.tables(name) if code else []
            if len(elements) > length or not code:
                table.mistake(name, f"is text, which cannot be filled, or a list of more than {length}")
            elements = elements[:length]
            rest = [None] * (length - len(elements))
            fields += (_field(f"{name}[{k}]", code, topic, element) for k, element in enumerate([*elements, *rest]))
    further = tuple(_rule(message, kinds, entry) for entry in table.tables("further")) if table.has("further") else ()
    table.done()
    repeat_ns = None if isnan(repeat_s) else round(repeat_s * 1e9)
    return MessageRule(message, topic, tuple(fields), repeat_ns, moves, further)


def _field(name: str, code: str, topic: str, table: Table | None) -> FieldRule:
    clock = name in CLOCK_UNITS_NS
    nothing: int | float = nan if code in "fd" and not clock else 0
    if table is None:
        return FieldRule(name, topic, None, False, None, None, None, nothing, False, code)
    constant = _number(table, "value", code, None)
    source = table.text("topic", topic)
    joined = source != topic
    angle = table.choice("angle", _ANGLES) if table.has("angle") else None
    values, before = table.raw("values"), table.raw("before")
    if values is not None and (not isinstance(values, Mapping) or not all(type(v) is int for v in values.values())):
        table.mistake("values", "is no table of whole numbers, like { 1 = 0, 2 = 128 }")
    if before is not None and not (
        isinstance(before, list) and len(before) == 2 and all(type(v) is int for v in before)
    ):
        table.mistake("before", "is no pair of whole numbers, like [129, 1]")
        before = None
    otherwise = None
    if table.has("otherwise"):
        otherwise = _field(name, code, topic, table.table("otherwise"))
        if values is None or joined or otherwise.joined:
            table.mistake("otherwise", f"goes with 'values', and with places in the record '{topic}'")
    channel = None
    place = {key: table.raw(key) for key in _OF_CHANNELS if table.has(key)}
    if constant is None and topic:
        if joined and "interpolation" not in place:
            table.mistake("interpolation", 'is missing: the topic is another one; write "linear" or "previous"')
        channel = read_channel(name, Table(table.file, table.path, {"message": source, **place}))
    # a record without a time has the time of the previous one
    required = not table.has("unknown") and not clock
    nothing = _number(table, "unknown", code, nothing)
    table.done()
    pair = None if before is None else (before[0], before[1])
    return FieldRule(name, source, channel, joined, angle, values, constant, nothing, required, code, otherwise, pair)


def _number(table: Table, key: str, code: str, default: Any) -> Any:
    """Return a number, whole or not as in the file, that the field of a message can hold."""
    value = table.raw(key)
    if value is None:
        return default
    # NaN is the unknown value of floats
    if not (key == "unknown" and isinstance(value, float) and isnan(value)):
        table.finite((key,), value)
    if table.good(key):
        try:
            struct.pack("<" + code, value)
        except (struct.error, OverflowError, ValueError):
            table.mistake(key, f"is {value}, which is no value of this field")
    return value
