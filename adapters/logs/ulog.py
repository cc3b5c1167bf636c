"""Onboard logs of PX4 (.ulg, plain or .xz / .gz): topics in the order they were logged, also across damage.

https://docs.px4.io/main/en/dev_log/ulog_file_format. The format has no checksums: damage shows only where a record is
invalid. The text of a format gives the positions of the fields in its records, including nested types and arrays.
"""

import re
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from adapters.errors import TelemetryError
from adapters.logs.compressed import Window
from adapters.logs.onboard_log import (
    FieldValues,
    LayoutField,
    OnboardLogReader,
    RecordKind,
    RecordLayout,
    Records,
    layout,
    record_text,
    texts,
    truth,
)
from adapters.message import LATEST_NS
from adapters.source import ULOG

_CODES = {
    "int8_t": "b",
    "uint8_t": "B",
    "int16_t": "h",
    "uint16_t": "H",
    "int32_t": "i",
    "uint32_t": "I",
    "int64_t": "q",
    "uint64_t": "Q",
    "float": "f",
    "double": "d",
    "bool": "?",
}
_TYPE = re.compile(r"(?P<type>\w+)(?:\[(?P<count>\d+)\])?", re.ASCII)
_FIELD = re.compile(rf"{_TYPE.pattern} (?P<name>\w+)", re.ASCII)
# Keys of information may contain anything but a blank: PX4 writes "perf_counter_preflight-00".
_KEYED = re.compile(rf"{_TYPE.pattern} (?P<name>\S+)", re.ASCII)
_FORMAT = re.compile(r"(?P<name>[\w/\-]+):(?P<fields>.*)", re.ASCII)
_LARGEST = 1 << 16
"""Most bytes of a record: its header has two for their number."""
_DEEPEST = 16
"""Most levels of nested types. Chosen: PX4 nests twice; a type that contains itself has to be rejected."""
_PADDING = "_padding"


@dataclass(frozen=True, slots=True)
class UlogField:
    """One field of a format: an array where ``count`` is a number."""

    name: str
    kind: str
    count: int | None


@dataclass(frozen=True, slots=True)
class UlogType:
    """Positions of the fields of one topic."""

    layout: RecordLayout  # bytes of a record without the padding at its end, which the logger may leave out
    size: int  # bytes of a record with it


def parse_format(definition: bytes) -> tuple[str, tuple[UlogField, ...]]:
    """Return name and fields of a format definition, ``name:type field;type[count] field;``.

    ValueError is raised if it is invalid.
    """
    match = _FORMAT.fullmatch(definition.decode("ascii"))
    if match is None:
        raise ValueError("no format definition")
    fields = []
    for field in filter(None, match["fields"].split(";")):
        parts = _FIELD.fullmatch(field)
        if parts is None:
            raise ValueError(f"no field: {field}")
        fields.append(UlogField(parts["name"], parts["type"], int(parts["count"]) if parts["count"] else None))
    return match["name"], tuple(fields)


def compile_type(name: str, formats: Mapping[str, tuple[UlogField, ...]]) -> UlogType:
    """Return the positions of a format's fields.

    Raises
    ------
    ValueError
        The format, or one that it is made of, is unknown, nested without end or larger than a record can be.
    """
    fields, size = _fields(name, formats, 0)
    padding = 0
    for field in reversed(formats[name]):
        if not field.name.startswith(_PADDING):
            break
        padding += _field(field, formats, 0)[1].itemsize
    return UlogType(layout(fields, size - padding), size)


def _fields(
    name: str, formats: Mapping[str, tuple[UlogField, ...]], depth: int
) -> tuple[list[tuple[LayoutField, np.dtype[Any], int]], int]:
    """Return the fields of a format, the type and position of each, and the bytes of all with their padding."""
    if name not in formats or depth > _DEEPEST:
        raise ValueError(f"no format {name}")
    fields, at = [], 0
    for field in formats[name]:
        made, dtype = _field(field, formats, depth)
        if not field.name.startswith(_PADDING):
            fields.append((made, dtype, at))
        at += dtype.itemsize
        if at > _LARGEST:
            raise ValueError(f"{name} is larger than a record can be")
    return fields, at


def _field(
    field: UlogField, formats: Mapping[str, tuple[UlogField, ...]], depth: int
) -> tuple[LayoutField, np.dtype[Any]]:
    """Return a field and the type of its values."""
    count = 1 if field.count is None else field.count
    if count > _LARGEST:
        raise ValueError(f"{field.name} is larger than a record can be")
    if field.kind == "char":
        return LayoutField(field.name, texts, numbers=False), np.dtype(f"S{count}")
    shape = () if field.count is None else (count,)
    code = _CODES.get(field.kind)
    if code is not None:
        # any byte but zero is true, which numpy's own type does not support
        kind = "u1" if code == "?" else f"<{code}"
        return LayoutField(field.name, truth if code == "?" else None), np.dtype((kind, shape))
    fields, size = _fields(field.kind, formats, depth + 1)
    if not size:
        raise ValueError(f"{field.kind} has no fields")
    if size * count > _LARGEST:
        raise ValueError(f"{field.name} is larger than a record can be")
    inner = layout(fields, size)
    return LayoutField(field.name, lambda values: _nested(inner, values), numbers=False), np.dtype((inner.dtype, shape))


def _nested(inner: RecordLayout, values: np.ndarray[Any, Any]) -> FieldValues:
    """Return values of a nested type as mappings, or lists of mappings if a record has several."""
    rows = inner.rows(values.reshape(-1))
    if values.ndim == 1:
        return rows
    width = values.shape[1]
    return [rows[at : at + width] for at in range(0, len(values) * width, width)] if width else [[] for _ in values]


def decode_keyed(data: bytes) -> tuple[str, str, Any]:
    """Return name, type and value of an information or a parameter: length of ``type name``, that text, the value.

    ValueError is raised if the bytes are invalid.
    """
    length = data[0] if data else 0
    match = _KEYED.fullmatch(data[1 : 1 + length].decode("ascii"))
    if match is None:
        raise ValueError("no name and type")
    name, kind = match["name"], match["type"]
    value = data[1 + length :]
    count = int(match["count"]) if match["count"] else None
    if kind == "char":
        return name, f"char[{len(value)}]", record_text(value)
    code = _CODES.get(kind)
    if code is None:
        raise ValueError(f"no basic type: {kind}")
    if (count or 1) * struct.calcsize("<" + code) != len(value):
        raise ValueError("value of another size than its type")
    values = struct.unpack(f"<{count or 1}{code}", value)
    return name, match.group(0).rsplit(" ", 1)[0], values[0] if count is None else list(values)


# Names of records that are no topics; no topic has such a name.
INFORMATION, PARAMETER, PARAMETER_DEFAULT = "log/information", "log/parameter", "log/parameter_default"
TEXT, DROPOUT = "log/text", "log/dropout"
GPS_TOPICS: Final = ("vehicle_gps_position", "sensor_gps")

_MAGIC = b"\x55\x4c\x6f\x67\x01\x12\x35"
_FILE_HEAD = struct.Struct("<7sBQ")
_HEAD = struct.Struct("<HB")
_ID = struct.Struct("<H")
_DATA_HEAD = struct.Struct("<HBH")
_SYNC = b"\x2f\x73\x13\x20\x25\x0c\xbb\x12"
_FLAGS = struct.Struct("<8s8s3Q")
_APPENDED = 1
"""Incompatibility flag for data appended after a crash dump, the only one that is defined."""
_DATA = ord("D")
_KINDS = frozenset(b"ABCDFILMOPQRS")
_DEFINES = frozenset(b"ABFR")
"""Records that define how others are read: if one is lost, nothing after it is certain."""
_LARGEST_UNKNOWN = 10_000
"""Largest record of an unknown kind, bytes. Chosen: of the known kinds only data and formats are larger; a longer
record is more likely damage than a new kind."""
_CHAINED = 3
"""Records of known kinds that must follow one of an unknown kind. 13 of 256 bytes are kinds: one follows garbage by
chance once in 20 times, three in a row once in 7,600."""
_LEVELS = range(ord("0"), ord("8"))
# Kinds of records at which reading may resume after damage: a topic's record, or a mark made for this purpose.
_RESUMES = re.compile(rb"[DS]")
_FIX_3D = 3
_YEAR_2001_US = 1_000_000_000_000_000
"""Least valid time of a receiver: one that does not know the time reports 1970 or 1980."""


@dataclass(frozen=True, slots=True)
class _Topic:
    """The meaning of a topic's number: the topic's records, and the bytes of one with its header and the number."""

    kind: RecordKind
    least: int
    most: int


class UlogReader(OnboardLogReader):
    """Reads an onboard log of PX4.

    Topics have the names of the log, ``sensor_baro/1`` being the second instance of one; information, parameters, text
    and dropouts are under ``log/...``. Time since boot is ``timestamp``, fixes are those of :data:`GPS_TOPICS`. See
    :class:`OnboardLogReader`, whose parameters it takes.
    """

    source = ULOG
    begins = _MAGIC
    head_bytes = _HEAD.size
    fields_at = _DATA_HEAD.size
    largest_bytes = 2 * _HEAD.size + _ID.size + (1 << 16)
    fixes = GPS_TOPICS
    fix_fields = ("time_utc_usec", "fix_type", "timestamp_time_relative")

    def _begin(self) -> None:
        self._formats: dict[str, tuple[UlogField, ...]] = {}
        self._kinds: dict[str, tuple[UlogType, RecordKind]] = {}
        self._topics: dict[int, _Topic] = {}
        self._appended: list[int] = []
        self._take: Mapping[int, Callable[[bytes], tuple[str, dict[str, Any]] | None]] = {
            ord("A"): self._subscribe,
            ord("B"): self._flag,
            ord("C"): _tagged_text,
            ord("F"): self._define,
            ord("I"): lambda body: _long_information(bytes(1) + body),
            ord("L"): _text,
            ord("M"): _long_information,
            ord("O"): lambda body: (DROPOUT, {"duration_ms": _ID.unpack(body)[0]}),
            ord("P"): _parameter,
            ord("Q"): _parameter_default,
            ord("R"): self._unsubscribe,
            ord("S"): _sync,
        }

    def _chain_end(self, window: Window) -> int:
        end = len(window.data)
        return min(end, window.index(self._appended[0])) if self._appended else end

    def _known(self, head: bytes) -> tuple[int, RecordKind | None] | None:
        if len(head) < _DATA_HEAD.size:
            return None
        size, kind, number = _DATA_HEAD.unpack(head)
        topic = self._topics.get(number)
        if kind != _DATA or topic is None or not topic.least <= size <= topic.most:
            return None
        return _HEAD.size + size, topic.kind if topic.kind.wanted else None

    def _single(self, window: Window, records: Records) -> bool:
        size, kind = _HEAD.unpack_from(window.data, window.at)
        length = _HEAD.size + size
        if self._appended and window.offset >= self._appended[0]:
            self._appended.pop(0)
        if self._appended and window.offset + length > self._appended[0]:
            # the logger was stopped within a record; the appended data begins at its given offset
            self._skip(window, self._appended[0] - window.offset)
            return True
        if not window.fill(length):
            return self._resume(window, end=True)
        if kind == _DATA:
            # the chain ended because more bytes had to be read, or because appended data begins
            return self._stands(window, 0) or self._resume(window)
        if kind not in self._take:
            if size == 0 or size > _LARGEST_UNKNOWN or not self._stands(window, length, _CHAINED):
                return self._resume(window)
            self._unknown += 1
            window.at += length
            return True
        start = window.at + _HEAD.size
        try:
            decoded = self._take[kind](window.data[start : start + size])
        except TelemetryError:
            raise
        except (ValueError, struct.error):
            if kind in _DEFINES or not self._stands(window, length, _CHAINED):
                return self._resume(window)
            # the record's content cannot be read, but its length is right: the log continues after it
            self._damaged += 1
            self._skip(window, length)
            return True
        self._records += 1
        window.at += length
        if decoded is not None and (self._only is None or decoded[0] in self._only):
            records.add_decoded(*decoded)
        return True

    def _open(self, window: Window) -> None:
        if not window.fill(_FILE_HEAD.size) or not window.data.startswith(_MAGIC):
            raise TelemetryError(f"{self._path}: not a ULog file although its name says so; check where it came from")
        window.at = _FILE_HEAD.size
        self._head_ns = min(_FILE_HEAD.unpack_from(window.data)[2] * 1_000, LATEST_NS)

    def _stands(self, window: Window, ahead: int, behind: int = 0) -> bool:
        """Return whether a topic's record, or the end, is ``ahead`` bytes ahead.

        A record of another known kind is accepted if ``behind`` records of known kinds follow it: only little more than
        one byte tells those from garbage.
        """
        if not window.fill(ahead + _HEAD.size):
            return window.left == ahead
        size, kind = _HEAD.unpack_from(window.data, window.at + ahead)
        if kind != _DATA:
            known = kind in _KINDS and size > 0
            return known and (behind == 0 or self._stands(window, ahead + _HEAD.size + size, behind - 1))
        if not window.fill(ahead + _HEAD.size + _ID.size):
            return False
        topic = self._topics.get(_ID.unpack_from(window.data, window.at + ahead + _HEAD.size)[0])
        return topic is not None and topic.least <= size <= topic.most

    def _standing(self, window: Window, searched: int) -> int | None:
        # a topic's record that is followed by another, or a mark
        start = window.at
        for match in _RESUMES.finditer(window.data, start + _HEAD.size, start + searched):
            ahead = match.start() - (_HEAD.size - 1) - start
            size, kind = _HEAD.unpack_from(window.data, start + ahead)
            if kind == _DATA:
                if self._stands(window, ahead) and self._stands(window, ahead + _HEAD.size + size):
                    return ahead
            elif window.data.startswith(_SYNC, start + ahead + _HEAD.size) and size == len(_SYNC):
                return ahead
        return None

    @staticmethod
    def relation(boot_ns: int, *fields: int) -> int | None:
        """Return UTC minus time since boot from a record of a receiver that had a fix."""
        utc_us, fix, relative_us = fields
        good = fix >= _FIX_3D and utc_us > _YEAR_2001_US
        return (utc_us - boot_ns // 1_000 - relative_us) * 1_000 if good else None

    def _subscribe(self, body: bytes) -> None:
        instance, number = struct.unpack_from("<BH", body)
        topic = body[3:].decode("ascii")
        name = f"{topic}/{instance}" if instance else topic
        if name not in self._kinds:
            compiled = compile_type(topic, self._formats)
            wanted = self._only is None or name in self._only
            self._kinds[name] = compiled, RecordKind(name, compiled.layout, wanted)
        compiled, kind = self._kinds[name]
        # a record without any field is invalid
        least = max(1, compiled.layout.dtype.itemsize)
        self._topics[number] = _Topic(kind, _ID.size + least, _ID.size + compiled.size)
        self._heads.clear()

    def _unsubscribe(self, body: bytes) -> None:
        self._topics.pop(_ID.unpack(body)[0], None)
        self._heads.clear()

    def _define(self, body: bytes) -> None:
        name, fields = parse_format(body)
        if self._formats.get(name) != fields:
            self._formats[name] = fields
            self._kinds.clear()

    def _flag(self, body: bytes) -> None:
        _, needed, *places = _FLAGS.unpack_from(body)
        if self._records:
            raise ValueError("flags come first")
        if any(needed[1:]) or needed[0] & ~_APPENDED:
            raise TelemetryError(f"{self._path}: is a ULog file of a newer kind than this program reads; update it")
        if needed[0]:
            self._appended = sorted(place for place in places if place)


def _text(body: bytes) -> tuple[str, dict[str, Any]]:
    return _tagged_text(body[:1] + bytes(2) + body[1:])


def _tagged_text(body: bytes) -> tuple[str, dict[str, Any]]:
    level, tag, stamp_us = struct.unpack_from("<BHQ", body)
    if level not in _LEVELS:
        raise ValueError("no level of a text")
    return TEXT, {"timestamp": stamp_us, "level": level - _LEVELS.start, "tag": tag, "text": record_text(body[11:])}


def _long_information(body: bytes) -> tuple[str, dict[str, Any]]:
    name, kind, value = decode_keyed(body[1:])
    return INFORMATION, {"key": name, "type": kind, "value": str(value), "continued": bool(body[0])}


def _parameter(body: bytes) -> tuple[str, dict[str, Any]]:
    name, kind, value = decode_keyed(body)
    if kind not in ("int32_t", "float"):
        raise ValueError("parameters are int32_t or float")
    return PARAMETER, {"key": name, "type": kind, "value": float(value)}


def _parameter_default(body: bytes) -> tuple[str, dict[str, Any]]:
    _, fields = _parameter(body[1:])
    return PARAMETER_DEFAULT, {**fields, "sets": body[0]}


def _sync(body: bytes) -> None:
    if body != _SYNC:
        raise ValueError("no mark")
