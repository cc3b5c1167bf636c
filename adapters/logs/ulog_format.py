"""Formats of ULog records: their text to what unpacks the bytes, nested types and arrays included.

https://docs.px4.io/main/en/dev_log/ulog_file_format
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from adapters.logs.log_bytes import text

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
_FORMAT = re.compile(r"(?P<name>[\w/\-]+):(?P<fields>.*)", re.ASCII)
_LARGEST = 1 << 16
_DEEPEST = 16

# Takes all values of a record and where the type's begin.
_Build = Callable[[tuple[Any, ...], int], Any]


@dataclass(frozen=True, slots=True)
class UlogField:
    """One field of a format: an array where ``count`` is a number."""

    name: str
    kind: str
    count: int | None


@dataclass(frozen=True, slots=True)
class UlogType:
    """What decodes the records of one topic.

    Parameters
    ----------
    smallest, size : int
        Bytes of a record without and with the padding at its end, which the logger may leave out.
    unpack : Callable[[bytes], tuple]
        Bytes of full size to single values.
    build : Callable
        Single values, and where to begin, to the fields.
    """

    smallest: int
    size: int
    unpack: Callable[[bytes], tuple[Any, ...]]
    build: _Build

    def decode(self, data: bytes) -> dict[str, Any]:
        """Return a record's fields: numbers, text, lists, and mappings for nested types; padding is left out."""
        if len(data) != self.size:
            data = data.ljust(self.size, b"\0")
        fields: dict[str, Any] = self.build(self.unpack(data), 0)
        return fields


def parse_format(definition: bytes) -> tuple[str, tuple[UlogField, ...]]:
    """Return name and fields of a format definition, ``name:type field;type[count] field;``.

    Raises
    ------
    ValueError
        It is none.
    """
    found = _FORMAT.fullmatch(definition.decode("ascii"))
    if found is None:
        raise ValueError("no format definition")
    fields = []
    for field in filter(None, found["fields"].split(";")):
        parts = _FIELD.fullmatch(field)
        if parts is None:
            raise ValueError(f"no field: {field}")
        fields.append(UlogField(parts["name"], parts["type"], int(parts["count"]) if parts["count"] else None))
    return found["name"], tuple(fields)


def compile_type(name: str, formats: Mapping[str, tuple[UlogField, ...]]) -> UlogType:
    """Return what decodes the records of a format.

    Raises
    ------
    ValueError
        The format, or one that it is made of, is unknown, nested without end or larger than a record can be.
    """
    codes, build, _ = _compile(name, formats, 0)
    whole = struct.Struct("<" + codes)
    padding = 0
    for field in reversed(formats[name]):
        if not field.name.startswith("_padding"):
            break
        inner, _, _ = _compile_field(field, formats, 0)
        padding += struct.calcsize("<" + inner)
    if whole.size > _LARGEST:
        raise ValueError(f"{name} is larger than a record can be")
    return UlogType(whole.size - padding, whole.size, whole.unpack, build)


def _compile(name: str, formats: Mapping[str, tuple[UlogField, ...]], depth: int) -> tuple[str, _Build, int]:
    """Return the struct codes of a format, what builds its fields, and how many single values it has."""
    if name not in formats or depth > _DEEPEST:
        raise ValueError(f"no format {name}")
    codes, builders, at = "", [], 0
    for field in formats[name]:
        inner, build, width = _compile_field(field, formats, depth)
        codes += inner
        if len(codes) > _LARGEST:
            raise ValueError(f"{name} is larger than a record can be")
        if not field.name.startswith("_padding"):
            builders.append((field.name, at, build))
        at += width
    if all(build is None for _, _, build in builders):
        plain = [(name, at) for name, at, _ in builders]
        return codes, lambda values, start: {name: values[start + at] for name, at in plain}, at
    whole = [(name, at, build or _single) for name, at, build in builders]
    return codes, lambda values, start: {name: build(values, start + at) for name, at, build in whole}, at


def _compile_field(
    field: UlogField, formats: Mapping[str, tuple[UlogField, ...]], depth: int
) -> tuple[str, _Build | None, int]:
    """Return codes, builder (None for one plain value) and number of values of a field."""
    count = 1 if field.count is None else field.count
    if count > _LARGEST:
        raise ValueError(f"{field.name} is larger than a record can be")
    if field.kind == "char":
        return f"{count}s", _text, 1
    code = _CODES.get(field.kind)
    if code is not None:
        if field.count is None:
            return code, None, 1
        return code * count, lambda values, start: list(values[start : start + count]), count
    inner, build, width = _compile(field.kind, formats, depth + 1)
    if len(inner) * count > _LARGEST:
        raise ValueError(f"{field.name} is larger than a record can be")
    if field.count is None:
        return inner, build, width
    starts = [place * width for place in range(count)]
    return inner * count, lambda values, start: [build(values, start + place) for place in starts], width * count


def _single(values: tuple[Any, ...], start: int) -> Any:
    return values[start]


def _text(values: tuple[Any, ...], start: int) -> str:
    return text(values[start].rstrip(b"\0"))


def decode_keyed(data: bytes) -> tuple[str, str, Any]:
    """Return name, type and value of an information or a parameter: length of ``type name``, that, the value.

    Raises
    ------
    ValueError
        The bytes are no such thing.
    """
    length = data[0] if data else 0
    found = _FIELD.fullmatch(data[1 : 1 + length].decode("ascii"))
    if found is None:
        raise ValueError("no name and type")
    name, kind = found["name"], found["type"]
    value = data[1 + length :]
    count = int(found["count"]) if found["count"] else None
    if kind == "char":
        return name, f"char[{len(value)}]", text(value)
    code = _CODES.get(kind)
    if code is None:
        raise ValueError(f"no basic type: {kind}")
    if (count or 1) * struct.calcsize("<" + code) != len(value):
        raise ValueError("value of another size than its type")
    values = struct.unpack(f"<{count or 1}{code}", value)
    return name, found.group(0).rsplit(" ", 1)[0], values[0] if count is None else list(values)
