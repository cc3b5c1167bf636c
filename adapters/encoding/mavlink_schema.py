"""Protobuf types of MAVLink messages, made from pymavlink's tables; encoding and decoding lose nothing."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from adapters.batch import Columns
from adapters.encoding.protobuf_rows import RowDecoder
from adapters.encoding.protobuf_types import Field, ProtobufScalar, message_class
from adapters.message import Message
from adapters.source import MAVLINK

PACKAGE = "mavlink"

_KINDS: dict[str, ProtobufScalar] = {
    "float": "float",
    "double": "double",
    "char": "string",
    "int8_t": "int32",
    "int16_t": "int32",
    "int32_t": "int32",
    "int64_t": "int64",
    "uint8_t": "uint32",
    "uint16_t": "uint32",
    "uint32_t": "uint32",
    "uint64_t": "uint64",
}


@functools.cache
def _tables() -> dict[str, Any]:
    """Return pymavlink's message classes by name."""
    from pymavlink.dialects.v20 import ardupilotmega

    return {table.msgname: table for table in ardupilotmega.mavlink_map.values()}


def _fields(table: Any) -> list[Field]:
    """Return the sender's ids and then the message's fields in the order of its definition.

    Text is a string, an array of numbers a repeated field. Where a message has a field ``system_id`` of its own, the
    sender's is called ``sender_system_id``; readers know it by its number, 1 or 2.
    """
    own = set(table.fieldnames)
    fields = [Field(f"sender_{name}" if name in own else name, "uint32") for name in ("system_id", "component_id")]
    lengths = dict(zip(table.ordered_fieldnames, table.array_lengths, strict=True))
    for name, kind in zip(table.fieldnames, table.fieldtypes, strict=True):
        fields.append(Field(name, _KINDS[kind], repeated=kind != "char" and lengths[name] > 1))
    return fields


class MavlinkProtobuf:
    """The protobuf type of one MAVLink message: encodes and decodes its messages.

    Parameters
    ----------
    pb_class : Any
        Protobuf class, fields 1 and 2 being the sender's system and component.
    """

    def __init__(self, pb_class: Any) -> None:
        self.pb_class = pb_class
        fields = pb_class.DESCRIPTOR.fields
        by_number = {field.number: field.name for field in fields if field.number > 2 or _is_id(field)}
        if not {1, 2} <= by_number.keys():
            raise ValueError(f"{pb_class.DESCRIPTOR.full_name} lacks the sender's ids")
        self._system, self._component = by_number[1], by_number[2]
        body = [field for field in fields if field.number > 2]
        self._names = {field.name for field in body}
        self._single = tuple(field.name for field in body if not field.is_repeated)
        self._repeated = tuple(field.name for field in body if field.is_repeated)
        self._order = tuple(field.name for field in body)
        try:
            self._rows: RowDecoder | None = RowDecoder(pb_class)
        except ValueError:
            self._rows = None

    def to_bytes(self, message: Message) -> bytes:
        """Return the serialized protobuf message.

        Raises
        ------
        ValueError
            The fields are not those of the type, or a value does not fit.
        """
        if message.fields.keys() != self._names:
            raise ValueError(f"{message.name} has other fields than its definition")
        ids = {self._system: message.system, self._component: message.component}
        try:
            return bytes(self.pb_class(**ids, **message.fields).SerializeToString())
        except (TypeError, OverflowError) as error:
            raise ValueError(f"{message.name} does not fit its definition: {error}") from error

    def from_bytes(self, data: bytes, name: str, received_ns: int) -> Message:
        """Return the message that :meth:`to_bytes` serialized.

        Raises
        ------
        ValueError
            The bytes are no such message.
        """
        try:
            decoded = self.pb_class.FromString(data)
        except DecodeError as error:
            raise ValueError(f"{name} cannot be decoded: {error}") from error
        fields = {field: getattr(decoded, field) for field in self._order}
        for field in self._repeated:
            fields[field] = list(fields[field])
        return Message(
            source=MAVLINK,
            name=name,
            received_ns=received_ns,
            fields=fields,
            system=getattr(decoded, self._system),
            component=getattr(decoded, self._component),
        )

    def rows_from_bytes(
        self, data: Sequence[bytes], name: str, received_ns: NDArray[np.int64], position: NDArray[np.int64]
    ) -> list[Columns] | None:
        """Return the messages of :meth:`from_bytes` as columns by sender, None where each has to be read by itself.

        Parameters
        ----------
        data : Sequence[bytes]
            The n records.
        name : str
            Name of the message.
        received_ns, position : NDArray[np.int64]
            Their times, and their indices in the batch (n,).
        """
        fields = None if self._rows is None else self._rows.decode(data)
        if fields is None:
            return None
        system, component = fields.pop(self._system), fields.pop(self._component)
        sender = system.astype(np.int64) << 32 | component.astype(np.int64)
        columns = []
        for ids in np.unique(sender).tolist():
            rows = sender == ids
            columns.append(
                Columns(
                    source=MAVLINK,
                    name=name,
                    system=ids >> 32,
                    component=ids & 0xFFFFFFFF,
                    position=position[rows],
                    received_ns=received_ns[rows],
                    fields={field: fields[field][rows] for field in self._order},
                )
            )
        return columns


def _is_id(field: Any) -> bool:
    """Return whether a field can hold the id of a sender; the schema of a damaged file may have any type there."""
    return field.type == field.TYPE_UINT32 and not field.is_repeated


def mavlink_protobuf(name: str) -> MavlinkProtobuf | None:
    """Return the protobuf type of a MAVLink message, None where the dialect has none of this name."""
    return _known_type(name) if name in _tables() else None


def mavlink_class(name: str) -> Any:
    """Return the protobuf class of a MAVLink message: fields 1 and 2 are the sender's ids.

    Raises
    ------
    ValueError
        The dialect has no message of this name.
    """
    kind = mavlink_protobuf(name)
    if kind is None:
        raise ValueError(f"no MAVLink message is called {name}")
    return kind.pb_class


@functools.cache
def _known_type(name: str) -> MavlinkProtobuf:
    return MavlinkProtobuf(message_class(PACKAGE, name, _fields(_tables()[name])))
