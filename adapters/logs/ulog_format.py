"""Formats of ULog records: their text to where the fields lie in the bytes, nested types and arrays included.

https://docs.px4.io/main/en/dev_log/ulog_file_format
"""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from adapters.logs.onboard_log import FieldValues, LayoutField, RecordLayout, layout, record_text, texts, truth

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
# Keys of information may hold anything but a blank: PX4 writes "perf_counter_preflight-00".
_KEYED = re.compile(rf"{_TYPE.pattern} (?P<name>\S+)", re.ASCII)
_FORMAT = re.compile(r"(?P<name>[\w/\-]+):(?P<fields>.*)", re.ASCII)
_LARGEST = 1 << 16
"""Bytes of a record: its head has two for their number."""
_DEEPEST = 16
"""Types within types. Chosen: PX4 nests twice; a type that holds itself must come to an end somewhere."""
_PADDING = "_padding"


@dataclass(frozen=True, slots=True)
class UlogField:
    """One field of a format: an array where ``count`` is a number."""

    name: str
    kind: str
    count: int | None


@dataclass(frozen=True, slots=True)
class UlogType:
    """Where the fields of one topic lie."""

    layout: RecordLayout  # of a record without the padding at its end, which the logger may leave out
    size: int  # bytes of a record with it


def parse_format(definition: bytes) -> tuple[str, tuple[UlogField, ...]]:
    """Return name and fields of a format definition, ``name:type field;type[count] field;``.

    ValueError is raised where it is none.
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
    """Return where the fields of a format lie.

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
    """Return the fields of a format, the type of each and where it begins, and the bytes of all with their padding."""
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
        # any byte but zero is true, which numpy's own type is not made for
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
    """Return values of a nested type as mappings, or lists of mappings where there are several in a record."""
    rows = inner.rows(values.reshape(-1))
    if values.ndim == 1:
        return rows
    width = values.shape[1]
    return [rows[at : at + width] for at in range(0, len(values) * width, width)] if width else [[] for _ in values]


def decode_keyed(data: bytes) -> tuple[str, str, Any]:
    """Return name, type and value of an information or a parameter: length of ``type name``, that, the value.

    ValueError is raised where the bytes are none.
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
