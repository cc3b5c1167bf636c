"""Protobuf types of onboard logs' records, derived from the records themselves; encoding and decoding them."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from adapters.batch import Columns
from adapters.encoding.protobuf_rows import RowDecoder
from adapters.encoding.protobuf_types import (
    Field,
    ProtobufScalar,
    class_from_descriptor_set,
    descriptor_set,
    identifiers,
    message_class,
)
from adapters.encoding.record import Schema
from adapters.message import Message

# Of each field the name, the kind (of a nested type its fields), and whether it is a list.
Shape = tuple[tuple[str, str | tuple[Any, ...], bool], ...]

_DTYPE_KINDS: Final[Mapping[str, ProtobufScalar]] = {"b": "bool", "i": "int64", "u": "int64", "f": "double"}
_SCALARS: Final[Mapping[type, ProtobufScalar]] = {bool: "bool", int: "int64", float: "double", str: "string"}


def shape(fields: Mapping[str, Any]) -> Shape:
    """Return the names and kinds of fields; records of one topic share them.

    Raises
    ------
    ValueError
        A value, or a name, is none that a typed record can hold.
    """
    if identifiers(tuple(fields)) != tuple(fields):
        raise ValueError("names that are no protobuf identifiers")
    return tuple((name, *_kind(value)) for name, value in fields.items())


def _kind(value: Any) -> tuple[str | tuple[Any, ...], bool]:
    if isinstance(value, list):
        kinds = {_kind(element) for element in value}
        if len(kinds) != 1 or (element := kinds.pop())[1]:
            raise ValueError("a list of nothing, of lists or of unlike things")
        return element[0], True
    if isinstance(value, dict):
        return shape(value), False
    kind = _SCALARS.get(type(value))
    if kind is None:
        raise ValueError(f"no value of a record: {value!r}")
    return kind, False


@functools.lru_cache(maxsize=4096)
def _class(source: str, name: str, form: Shape) -> tuple[Any, Schema]:
    kind = message_class(source, "".join(c if c.isalnum() else "_" for c in name), _fields(form))
    return kind, Schema(str(kind.DESCRIPTOR.full_name), "protobuf", descriptor_set(kind))


def _fields(form: Shape) -> list[Field]:
    return [
        Field(name, kind if isinstance(kind, str) else tuple(_fields(kind)), repeated)  # type: ignore[arg-type]
        for name, kind, repeated in form
    ]


def to_protobuf(message: Message) -> tuple[Schema, bytes]:
    """Return the schema of a record of an onboard log, and the record in it.

    Whole numbers become int64, others double (which holds a float exactly), arrays repeated, nested types messages.

    Raises
    ------
    ValueError
        A value or a name is none that a typed record can hold.
    """
    kind, schema = _class(message.source.name, message.name.partition("/")[0], shape(message.fields))
    try:
        return schema, bytes(kind(**message.fields).SerializeToString())
    except (TypeError, OverflowError) as error:
        raise ValueError(f"{message.name} does not fit its type: {error}") from error


def columns_class(columns: Columns) -> Any:
    """Return the protobuf class of records of an onboard log that are columns, that of :func:`to_protobuf` for each.

    Raises
    ------
    ValueError
        They are not those of an onboard log, or a typed record cannot hold them.
    """
    if not columns.source.is_onboard_log or identifiers(tuple(columns.fields)) != tuple(columns.fields):
        raise ValueError(f"{columns.name} has no typed records")
    form = []
    for name, values in columns.fields.items():
        kind = _DTYPE_KINDS.get(values.dtype.kind)
        if kind is None or (values.ndim == 2 and not values.shape[1]):
            raise ValueError(f"no values of a record: {name}")
        form.append((name, kind, values.ndim == 2))
    return _class(columns.source.name, columns.name.partition("/")[0], tuple(form))[0]


class LogProtobuf:
    """Reads the records of one topic back.

    Parameters
    ----------
    name, data : str, bytes
        Name and data of the schema.
    """

    def __init__(self, name: str, data: bytes) -> None:
        self._class = class_from_descriptor_set(data, name)
        self._rows: RowDecoder | None = None
        with contextlib.suppress(ValueError):
            self._rows = RowDecoder(self._class)

    def columns(self, data: Sequence[bytes]) -> dict[str, NDArray[np.generic]] | None:
        """Return the fields of n records as arrays (n,), lists as (n, length); None where there are others in them."""
        return None if self._rows is None else self._rows.decode(data)

    def fields(self, data: bytes) -> dict[str, Any]:
        """Return the fields that :func:`to_protobuf` wrote.

        Raises
        ------
        ValueError
            The bytes are no such record.
        """
        try:
            return _read(self._class.FromString(data))
        except DecodeError as error:
            raise ValueError(f"{self._class.DESCRIPTOR.full_name}: {error}") from error


def _read(message: Any) -> dict[str, Any]:
    fields: dict[str, Any] = {}
    # of the class: a field of the message may be called DESCRIPTOR
    for field in type(message).DESCRIPTOR.fields:
        value = getattr(message, field.name)
        if field.message_type is not None:
            fields[field.name] = [_read(part) for part in value] if field.is_repeated else _read(value)
        else:
            fields[field.name] = list(value) if field.is_repeated else value
    return fields
