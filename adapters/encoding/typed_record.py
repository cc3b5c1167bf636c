"""Telemetry messages as protobuf records and back, without loss.

The types of MAVLink messages are made from pymavlink's tables, those of an onboard log's records from the records
themselves.
"""

import functools
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from google.protobuf.descriptor_pb2 import FieldDescriptorProto
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from adapters.batch import Columns
from adapters.encoding.foreign_record import ProtobufFields
from adapters.encoding.protobuf_types import Field, ProtobufScalar, identifiers, message_class, protobuf_schema
from adapters.encoding.record import Schema
from adapters.mavlink.mavlink_message import message_tables
from adapters.message import Message
from adapters.source import MAVLINK, Source

PACKAGE = "mavlink"

_MAVLINK_KINDS: Final[Mapping[str, ProtobufScalar]] = {
    **{"float": "float", "double": "double", "char": "string"},
    **{"int8_t": "int32", "int16_t": "int32", "int32_t": "int32", "int64_t": "int64"},
    **{"uint8_t": "uint32", "uint16_t": "uint32", "uint32_t": "uint32", "uint64_t": "uint64"},
}
_DTYPE_KINDS: Final[Mapping[str, ProtobufScalar]] = {"b": "bool", "i": "int64", "u": "int64", "f": "double"}
_DTYPES: Final[Mapping[int, Any]] = {
    FieldDescriptorProto.TYPE_BOOL: np.bool_,
    FieldDescriptorProto.TYPE_DOUBLE: np.float64,
    FieldDescriptorProto.TYPE_FLOAT: np.float32,
    FieldDescriptorProto.TYPE_INT32: np.int32,
    FieldDescriptorProto.TYPE_UINT32: np.uint32,
    FieldDescriptorProto.TYPE_INT64: np.int64,
    FieldDescriptorProto.TYPE_UINT64: np.uint64,
}
"""NumPy types of the kinds of fields that columns can hold."""
_SCALARS: Final[Mapping[type, ProtobufScalar]] = {bool: "bool", int: "int64", float: "double", str: "string"}


def to_protobuf(message: Message) -> tuple[Schema, bytes]:
    """Return the schema of a MAVLink message or a record of an onboard log, and the record in it.

    In a record of an onboard log, whole numbers become int64, others double (which holds a float exactly), arrays
    repeated fields, nested types messages.

    Raises
    ------
    ValueError
        The dialect has no such message, or the type cannot hold a value or a name.
    """
    ids: dict[str, int] = {}
    if message.source is MAVLINK:
        pb_class = mavlink_class(message.name, isinstance(message.fields.get("time_boot_ms"), float))
        senders, names = _layout(pb_class)
        if message.fields.keys() != names:
            raise ValueError(f"{message.name} has other fields than its definition")
        ids = dict(zip(senders, (message.system, message.component), strict=True))
    else:
        pb_class = _log_class(message.source, message.name, _fields(message.fields))
    try:
        return protobuf_schema(pb_class), bytes(pb_class(**ids, **message.fields).SerializeToString())
    except (TypeError, OverflowError) as error:
        raise ValueError(f"{message.name} does not fit its type: {error}") from error


@functools.cache
def mavlink_class(name: str, of_log: bool = False) -> Any:
    """Return the protobuf class of a MAVLink message: fields 1 and 2 are the sender's ids, then come its own.

    Stamps may be as large as those of messages from records of an onboard log, and with ``of_log`` as fine. Text is a
    string, an array of numbers a repeated field. If a message has its own field ``system_id``, the sender's is called
    ``sender_system_id``; readers recognise it by its number.

    Raises
    ------
    ValueError
        The dialect has no message of this name.
    """
    table = message_tables().get(name)
    if table is None:
        raise ValueError(f"no MAVLink message is called {name}")
    own = set(table.fieldnames)
    fields = [Field(f"sender_{name}" if name in own else name, "uint32") for name in ("system_id", "component_id")]
    lengths = dict(zip(table.ordered_fieldnames, table.array_lengths, strict=True))
    stamps: dict[str, ProtobufScalar] = {"time_usec": "uint64", **({"time_boot_ms": "double"} if of_log else {})}
    for field, kind in zip(table.fieldnames, table.fieldtypes, strict=True):
        scalar = stamps.get(field, _MAVLINK_KINDS[kind])
        fields.append(Field(field, scalar, repeated=kind != "char" and lengths[field] > 1))
    return message_class(PACKAGE, name, fields)


@functools.cache
def _layout(pb_class: Any) -> tuple[tuple[str, str], frozenset[str]]:
    """Return the names of the sender's ids in the class of a MAVLink message, and those of its own fields.

    ValueError is raised if the ids are missing: the schema of a damaged file may have anything instead.
    """
    fields = pb_class.DESCRIPTOR.fields
    ids = {field.number: field.name for field in fields if field.type == field.TYPE_UINT32 and not field.is_repeated}
    if not {1, 2} <= ids.keys():
        raise ValueError(f"{pb_class.DESCRIPTOR.full_name} lacks the sender's ids")
    return (ids[1], ids[2]), frozenset(field.name for field in fields if field.number > 2)


def columns_class(columns: Columns) -> Any:
    """Return the protobuf class that :func:`to_protobuf` chooses for each message of columns.

    Raises
    ------
    ValueError
        They are neither from MAVLink nor from an onboard log, or a typed record cannot hold them.
    """
    if columns.source is MAVLINK:
        stamps = columns.fields.get("time_boot_ms")
        return mavlink_class(columns.name, stamps is not None and stamps.dtype.kind == "f")
    if not columns.source.is_onboard_log or identifiers(tuple(columns.fields)) != tuple(columns.fields):
        raise ValueError(f"{columns.name} has no typed records")
    fields = []
    for name, values in columns.fields.items():
        kind = _DTYPE_KINDS.get(values.dtype.kind)
        if kind is None or (values.ndim == 2 and not values.shape[1]):
            raise ValueError(f"no values of a record: {name}")
        fields.append(Field(name, kind, repeated=values.ndim == 2))
    return _log_class(columns.source, columns.name, tuple(fields))


@functools.lru_cache(maxsize=4096)
def _log_class(source: Source, name: str, fields: tuple[Field, ...]) -> Any:
    """Return the class of an onboard log's records, the same for all instances."""
    topic = name.partition("/")[0]
    return message_class(source.name, "".join(c if c.isalnum() else "_" for c in topic), fields)


def _fields(values: Mapping[str, Any]) -> tuple[Field, ...]:
    """Return names and kinds of a record's values; raise ValueError if a typed record cannot hold one."""
    if identifiers(tuple(values)) != tuple(values):
        raise ValueError("names that are no protobuf identifiers")
    return tuple(_field(name, value) for name, value in values.items())


def _field(name: str, value: Any) -> Field:
    if isinstance(value, list):
        kinds = {_field(name, element) for element in value}
        if len(kinds) != 1 or (element := kinds.pop()).repeated:
            raise ValueError("a list of nothing, of lists or of unlike things")
        return Field(name, element.kind, repeated=True)
    if isinstance(value, dict):
        return Field(name, _fields(value))
    kind = _SCALARS.get(type(value))
    if kind is None:
        raise ValueError(f"no value of a record: {value!r}")
    return Field(name, kind)


class TypedRecords:
    """Decodes the records of one topic that :func:`to_protobuf` made, one per call or many at once.

    ValueError is raised if the class is not one of such messages.
    """

    def __init__(self, source: Source, name: str, pb_class: Any) -> None:
        self._source = source
        self._name = name
        self._ids = _layout(pb_class)[0] if source is MAVLINK else ()
        self._fields = ProtobufFields(pb_class)
        self._class = pb_class
        fields = pb_class.DESCRIPTOR.fields
        self._dtypes = {field.name: _DTYPES[field.type] for field in fields if field.type in _DTYPES}
        self._numbers_only = len(self._dtypes) == len(fields) and not any(field.has_presence for field in fields)

    def __call__(self, data: bytes, time_ns: int) -> Message:
        """Return a record as a message; raise ValueError if it is invalid."""
        fields = self._fields.decode(data)
        ids = [fields.pop(name) for name in self._ids]
        return Message(self._source, self._name, time_ns, fields, *ids)

    def columns(
        self, data: Sequence[bytes], time_ns: NDArray[np.int64], position: NDArray[np.int64]
    ) -> list[Columns] | None:
        """Return n records as columns by sender, or None if each has to be decoded by itself.

        ``time_ns`` and ``position`` (n,) are their times and their indices in the batch.
        """
        if not self._numbers_only:
            return None
        try:
            messages = [self._class.FromString(one) for one in data]
            fields = {
                name: np.array([getattr(message, name) for message in messages], dtype)
                for name, dtype in self._dtypes.items()
            }
        except (DecodeError, ValueError):
            # numpy makes no array from lists of different lengths
            return None
        ids = [fields.pop(name).astype(np.int64) for name in self._ids]
        if not ids:
            return [Columns(self._source, self._name, 0, 0, position, time_ns, fields)]
        sender = ids[0] << 32 | ids[1]
        columns = []
        for number in np.unique(sender).tolist():
            rows = sender == number
            own = {field: values[rows] for field, values in fields.items()}
            ids_of = number >> 32, number & 0xFFFFFFFF
            columns.append(Columns(self._source, self._name, *ids_of, position[rows], time_ns[rows], own))
        return columns
