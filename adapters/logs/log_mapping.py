"""Which MAVLink message a record of an onboard log stands for: the tables, built in or a user's own, and the guess.

A profile names MAVLink messages. An onboard log holds the same quantities under names and units of its own; a table
per message says from which, so that one profile serves both. Where it names several ways, the log decides.
"""

from __future__ import annotations

import os
import struct
import tomllib
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from math import nan
from pathlib import Path
from typing import Any, Final, Literal

from adapters.channels import Channel, follow, parse_channel
from adapters.errors import TelemetryError
from adapters.toml_tables import is_number

Angle = Literal["roll", "pitch", "yaw"]
ONBOARD_SOURCES: Final = ("ulog", "dataflash")

_ANGLES = ("roll", "pitch", "yaw")
_KEYS = {"topic", "field", "scale", "offset", "period", "interpolation", "angle", "values"}
_KEYS |= {"otherwise", "value", "unknown"}
_OF_CHANNELS = ("field", "scale", "offset", "period", "interpolation")
_OF_RULES = ("topic", "repeat_s")
# Of two ways to fill a message, the later one only where it comes this much more often.
_CLEARLY = 1.5


@dataclass(frozen=True, slots=True)
class FieldRule:
    """One field of a MAVLink message.

    Parameters
    ----------
    name : str
        The field.
    topic : str
        Name of the log's record it is taken from.
    channel : Channel | None
        Where in that record, scale and offset; None for a constant.
    joined : bool
        Taken from another record than the one that makes the message: interpolated linearly to that one's time, or
        its last value, as the channel says.
    angle : {"roll", "pitch", "yaw"} | None
        The channel's place holds a quaternion (w, x, y, z), body to earth; this is its angle.
    values : Mapping[str, int] | None
        The values that whole numbers of the log stand for; a number that is not listed makes no message unless
        ``otherwise`` has one.
    constant : int | None
        The value.
    unknown : int | float
        The value where the log has none.
    required : bool
        The log has to have this place to fill the message.
    otherwise : FieldRule | None
        Where else in the same record to look for a number that is not listed.
    """

    name: str
    topic: str
    channel: Channel | None
    joined: bool
    angle: Angle | None
    values: Mapping[str, int] | None
    constant: int | None
    unknown: int | float
    required: bool
    otherwise: FieldRule | None = None

    def places(self) -> Iterator[FieldRule]:
        """Yield the rule and those that it falls back on."""
        yield self
        if self.otherwise is not None:
            yield from self.otherwise.places()


@dataclass(frozen=True, slots=True)
class MessageRule:
    """One way to fill a MAVLink message.

    Parameters
    ----------
    message : str
        Its name.
    topic : str
        Name of the log's record that makes one.
    fields : tuple[FieldRule, ...]
        All fields in the order of the definition.
    codes : str
        How they are packed: struct codes.
    repeat_ns : int | None
        A state is repeated after that long.
    """

    message: str
    topic: str
    fields: tuple[FieldRule, ...]
    codes: str
    repeat_ns: int | None

    @property
    def linear(self) -> frozenset[str]:
        """Names of the records between which values are interpolated."""
        return frozenset(
            field.topic
            for field in self.fields
            if field.joined and field.channel is not None and field.channel.interpolation == "linear"
        )

    @property
    def topics(self) -> frozenset[str]:
        """Names of all records that fill the message."""
        return frozenset({self.topic, *(field.topic for field in self.fields if field.channel is not None)})

    def text(self) -> str:
        """Return the rule in a line: message, record, and what is joined to it."""
        joined = sorted(self.topics - {self.topic})
        return f"{self.message} from {self.topic}" + (f" with {', '.join(joined)}" if joined else "")

    def fillable(self, examples: Mapping[str, Mapping[str, Any]]) -> bool:
        """Return whether a log with such records has all that is needed."""
        needed = {self.topic, *self.linear}
        return needed <= examples.keys() and all(
            follow(examples[field.topic], field.channel.path) is not None
            for one in self.fields
            for field in one.places()
            if field.channel is not None and field.required and field.topic in needed
        )


@dataclass(frozen=True, slots=True)
class LogMapping:
    """Ways to fill MAVLink messages, in order of preference.

    Parameters
    ----------
    rules : Mapping[str, tuple[MessageRule, ...]]
        By message name.
    """

    rules: Mapping[str, tuple[MessageRule, ...]]

    def topics(self, only: Collection[str]) -> frozenset[str]:
        """Return the names of the records that could fill some of these messages."""
        return frozenset().union(*(rule.topics for name, rules in self.rules.items() if name in only for rule in rules))

    def guess(self, counts: Mapping[str, int], examples: Mapping[str, Mapping[str, Any]]) -> dict[str, MessageRule]:
        """Return how the messages are filled from a log.

        Of the ways that the log can fill, the first; a later one where its record comes half as often again.

        Parameters
        ----------
        counts : Mapping[str, int]
            Records by name.
        examples : Mapping[str, Mapping[str, Any]]
            Fields of any record of each name.
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
    """Return the tables for logs of a source, one of :data:`SOURCES`."""
    path = files("adapters") / "definitions" / "logs" / f"{source}.toml"
    return parse_mapping(tomllib.loads(path.read_text(encoding="utf-8")), path.name)


def read_mapping(path: str | os.PathLike[str], source: str) -> LogMapping:
    """Return the built-in tables with those of a user's TOML file in place of the ones of the same message.

    Raises
    ------
    TelemetryError
        The file cannot be read or a table makes no sense.
    """
    try:
        content = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise TelemetryError(f"{path}: cannot be read: {error.strerror}") from error
    except RecursionError as error:
        raise TelemetryError(f"{path}: is nested too deeply") from error
    except ValueError as error:
        # also UnicodeDecodeError, and numbers of more digits than Python reads
        raise TelemetryError(f"{path}: is no TOML: {error}") from error
    return LogMapping({**builtin_mapping(source).rules, **parse_mapping(content, str(path)).rules})


def parse_mapping(content: Mapping[str, Any], where: str) -> LogMapping:
    """Return the tables of a TOML document: ``[[MESSAGE]]`` with ``topic``, ``repeat_s`` and a table per field.

    Raises
    ------
    TelemetryError
        A table makes no sense; the text names it.
    """
    rules = {}
    for message, tables in content.items():
        kinds = _kinds(message)
        if kinds is None:
            raise TelemetryError(f"{where}: {message!r} is no MAVLink message")
        if not isinstance(tables, list) or not all(isinstance(table, dict) for table in tables):
            raise TelemetryError(f"{where}: write [[{message}]], once for each way to fill it")
        rules[message] = tuple(_rule(message, kinds, table, f"{where}: {message}") for table in tables)
    return LogMapping(rules)


@cache
def _kinds(message: str) -> dict[str, str] | None:
    """Return the struct code of each field of a message by pymavlink's table; None where there is no such message."""
    from pymavlink.dialects.v20 import ardupilotmega

    codes = {"float": "f", "double": "d", "char": "", "int8_t": "b", "uint8_t": "B", "int16_t": "h", "uint16_t": "H"}
    codes |= {"int32_t": "i", "uint32_t": "I", "int64_t": "q", "uint64_t": "Q"}
    for table in ardupilotmega.mavlink_map.values():
        if table.msgname == message:
            lengths = dict(zip(table.ordered_fieldnames, table.array_lengths, strict=True))
            kinds = zip(table.fieldnames, table.fieldtypes, strict=True)
            return {name: "" if lengths[name] else codes[kind] for name, kind in kinds}
    return None


def _rule(message: str, kinds: Mapping[str, str], table: Mapping[str, Any], where: str) -> MessageRule:
    topic, repeat_s = table.get("topic"), table.get("repeat_s")
    if not isinstance(topic, str) or not topic:
        raise TelemetryError(f"{where}: 'topic' is missing or not text")
    if repeat_s is not None and (type(repeat_s) not in (int, float) or not 0.0 < repeat_s < 1e6):
        raise TelemetryError(f"{where}: 'repeat_s' is no number of seconds above zero")
    unknown = sorted(set(table) - kinds.keys() - set(_OF_RULES))
    if unknown:
        raise TelemetryError(f"{where}: has no field {unknown[0]!r}")
    if any(code == "" for name, code in kinds.items() if name in table):
        raise TelemetryError(f"{where}: fields that are arrays or text cannot be filled")
    fields = tuple(
        _field(name, code, topic, table.get(name), f"{where}.{name}") for name, code in kinds.items() if code
    )
    repeat_ns = None if repeat_s is None else round(repeat_s * 1e9)
    return MessageRule(message, topic, fields, "<" + "".join(kinds.values()), repeat_ns)


def _field(name: str, code: str, topic: str, table: Any, where: str) -> FieldRule:
    nothing: int | float = nan if code in "fd" else 0
    if table is None:
        return FieldRule(name, topic, None, False, None, None, None, nothing, False)
    if not isinstance(table, Mapping):
        raise TelemetryError(f'{where}: is no table, like {{ field = "xyz[0]", scale = 0.001 }}')
    wrong = sorted(set(table) - _KEYS)
    if wrong:
        raise TelemetryError(f"{where}: unknown key {wrong[0]!r}; known are {', '.join(sorted(_KEYS))}")
    constant, angle, values = table.get("value"), table.get("angle"), table.get("values")
    for key in ("value", "unknown"):
        if key in table and not is_number(table[key]):
            raise TelemetryError(f"{where}: '{key}' is no number")
    if angle is not None and angle not in _ANGLES:
        raise TelemetryError(f"{where}: 'angle' is none of {', '.join(_ANGLES)}")
    if values is not None and (not isinstance(values, Mapping) or not all(type(v) is int for v in values.values())):
        raise TelemetryError(f"{where}: 'values' is no table of whole numbers, like {{ 1 = 0, 2 = 128 }}")
    source = table.get("topic", topic)
    if not isinstance(source, str):
        raise TelemetryError(f"{where}: 'topic' is no text")
    joined = source != topic
    otherwise = None
    if "otherwise" in table:
        otherwise = _field(name, code, topic, table["otherwise"], f"{where}.otherwise")
        if values is None or joined or otherwise.joined:
            raise TelemetryError(f"{where}: 'otherwise' goes with 'values', and with places in the record '{topic}'")
    channel = None
    if constant is None:
        if joined and "interpolation" not in table:
            raise TelemetryError(f'{where}: comes from another topic; say interpolation = "linear" or "previous"')
        channel = parse_channel(name, {"message": source, **{k: table[k] for k in _OF_CHANNELS if k in table}}, where)
    nothing = table.get("unknown", nothing)
    for number in (nothing, 0 if constant is None else constant):
        try:
            struct.pack("<" + code, number)
        except (struct.error, OverflowError) as error:
            raise TelemetryError(f"{where}: {number} is no value of this field") from error
    required = "unknown" not in table
    return FieldRule(name, source, channel, joined, angle, values, constant, nothing, required, otherwise)
