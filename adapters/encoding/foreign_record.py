"""Topics that others record in MCAP -> messages: ROS 2 (CDR by the definition in the file), JSON, protobuf.

A message is named after its topic without the leading slash, as over Zenoh (:mod:`adapters.zenoh.zenoh_payload`), and
has the same source, :data:`adapters.source.ZENOH`: one profile serves a robot both live and in its recordings.
"""

import json
from base64 import b64encode
from collections.abc import Callable, Mapping
from typing import Any

from adapters.encoding.cdr import CdrDecoder
from adapters.encoding.message_definition import canonical_type, find_definition
from adapters.encoding.protobuf_types import class_from_schema
from adapters.encoding.record import Schema
from adapters.errors import TelemetryError
from adapters.message import Message
from adapters.source import ZENOH

FieldDecoder = Callable[[bytes], dict[str, Any]]

_MOMENTS = {"google.protobuf.Timestamp", "google.protobuf.Duration"}


def foreign_name(topic: str) -> str:
    """Return the name of a topic's messages."""
    return topic.removeprefix("/") or topic


def foreign_decoder(topic: str, encoding: str, schema: Schema | None) -> Callable[[bytes, int], Message]:
    """Return a function from the records of a log's channel to messages; it raises ValueError for an invalid record.

    Raises
    ------
    ValueError
        Records of this encoding or schema cannot be read; the text says why.
    """
    name = foreign_name(topic)
    fields = _fields(encoding, schema)
    return lambda data, time_ns: Message(ZENOH, name, time_ns, fields(data))


def _fields(encoding: str, schema: Schema | None) -> FieldDecoder:
    if encoding == "json":
        return json_object
    if encoding == "cdr" and schema is not None:
        return CdrDecoder(schema.name, _definition(schema)).decode
    if encoding == "protobuf" and schema is not None:
        return ProtobufFields(class_from_schema(schema)).decode
    if encoding in ("cdr", "protobuf"):
        raise ValueError(f"{encoding} without a schema")
    raise ValueError(f"encoding '{encoding}' is not known; cdr, json and protobuf are")


def _definition(schema: Schema) -> str:
    """Return the .msg definition of a type: the file's own, otherwise the built-in one."""
    if schema.encoding == "ros2msg" and schema.data.strip():
        return schema.data.decode(errors="replace")
    try:
        return find_definition(schema.name, ())
    except TelemetryError as error:
        what = f"schema in '{schema.encoding}'" if schema.data else "no definition in the file"
        raise ValueError(f"{canonical_type(schema.name)}: {what}, and none of its name is shipped") from error


def json_object(data: bytes) -> dict[str, Any]:
    """Return the fields of a JSON record; raise ValueError if it is not a JSON object."""
    try:
        fields = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise ValueError("not JSON") from error
    if not isinstance(fields, dict):
        raise ValueError("not a JSON object")
    return fields


class ProtobufFields:
    """Reads protobuf messages of one class as plain fields.

    Nested messages are fields within fields; an absent one is left out. Times and durations of protobuf become seconds
    and nanoseconds with the names of ROS 2 (``sec``, ``nanosec``), enumerations become their numbers, bytes base64.
    """

    def __init__(self, pb_class: Any) -> None:
        self._class = pb_class
        self._known: dict[str, list[tuple[str, Callable[[Any], Any], bool]]] = {}

    def decode(self, data: bytes) -> dict[str, Any]:
        """Return a message's fields; raise ValueError if the bytes are not such a message."""
        from google.protobuf.message import DecodeError

        try:
            return self._read(self._class.FromString(data))
        except (DecodeError, AttributeError, KeyError, TypeError) as error:
            # also schemas that define protobuf's own types, or the entries of a map, as something else
            raise ValueError(f"{self._class.DESCRIPTOR.full_name}: {error}") from error

    def _read(self, message: Any) -> dict[str, Any]:
        # of the class, since a field may have one of these names
        kind, has = type(message).DESCRIPTOR, type(message).HasField
        if kind.full_name in _MOMENTS:
            return {"sec": message.seconds, "nanosec": message.nanos}
        readers = self._known.get(kind.full_name)
        if readers is None:
            readers = self._known[kind.full_name] = [
                (field.name, self._reader(field), field.has_presence) for field in kind.fields
            ]
        return {
            name: read(getattr(message, name)) for name, read, optional in readers if not optional or has(message, name)
        }

    def _reader(self, field: Any) -> Callable[[Any], Any]:
        entry = field.message_type
        if entry is not None and entry.GetOptions().map_entry:
            one = self._single(entry.fields_by_name["value"])
            return lambda value: {str(key): one(value[key]) for key in value}
        one = self._single(field)
        if not field.is_repeated:
            return one
        return list if one is _same else lambda value: [one(element) for element in value]

    def _single(self, field: Any) -> Callable[[Any], Any]:
        if field.message_type is not None:
            return self._read
        if field.type == field.TYPE_BYTES:
            return lambda value: b64encode(value).decode()
        return _same


def _same(value: Any) -> Any:
    return value


def described(reasons: Mapping[str, str]) -> tuple[str, ...]:
    """Return which topics could not be read and why: each reason once with its first topics."""
    topics: dict[str, list[str]] = {}
    for topic, reason in reasons.items():
        topics.setdefault(reason, []).append(topic)
    return tuple(
        f"cannot read {', '.join(names[:3])}{f' and {len(names) - 3} more' if len(names) > 3 else ''}: {reason}"
        for reason, names in topics.items()
    )
