"""One telemetry message as a record of a log: encoding, and decoding by topic."""

from __future__ import annotations

import contextlib
import functools
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adapters.batch import Columns
from adapters.encoding.foreign_record import json_object
from adapters.encoding.log_schema import LogProtobuf, to_protobuf
from adapters.encoding.mavlink_schema import PACKAGE, MavlinkProtobuf, mavlink_protobuf
from adapters.encoding.protobuf_types import class_from_descriptor_set, descriptor_set
from adapters.encoding.record import Record, Schema
from adapters.message import LATEST_NS, Message
from adapters.source import LINK, MAVLINK, SOURCES, ZENOH, Source

# Viewers ask for a schema; a JSON topic may carry any object.
_JSON_SCHEMA = Schema("fauio.Telemetry", "jsonschema", b'{"type": "object"}')

# MAVLink's ids of systems and components have one byte.
_LARGEST_ID = 255
"""A byte: MAVLink's system and component."""

Decode = Callable[[bytes, int], Message]


def encode(message: Message) -> Record:
    """Return a message as a record.

    MAVLink messages are protobuf, as JSON only where the fields are not those of pymavlink's definition.
    NaN and infinity stay literals in JSON, which JSON proper lacks: a replay has to see the monitor's own input.

    Raises
    ------
    ValueError
        No record can hold the message's name, time or fields.
    """
    topic = f"/{message.source}/{message.name}"
    topic.encode()
    ids = {"system_id": message.system, "component_id": message.component}
    if not 0 <= message.received_ns < LATEST_NS:
        raise ValueError(f"{message.name} arrived at a time that no record can hold")
    if message.source is LINK:
        return Record(topic, "json", _JSON_SCHEMA, _to_json({**message.fields, **ids}), message.received_ns)
    if message.source.is_onboard_log:
        with contextlib.suppress(ValueError):
            return Record(topic, "protobuf", *to_protobuf(message), message.received_ns)
    if message.source is not MAVLINK:
        return Record(topic, "json", _JSON_SCHEMA, _to_json(message.fields), message.received_ns)
    kind = mavlink_protobuf(message.name)
    if kind is not None:
        try:
            data = kind.to_bytes(message)
        except ValueError:
            pass
        else:
            return Record(topic, "protobuf", _mavlink_schema(kind), data, message.received_ns, message.component)
    data = _to_json({**ids, "fields": message.fields})
    return Record(topic, "json", _JSON_SCHEMA, data, message.received_ns, message.component)


def recorded_name(topic: str, encoding: str, schema: str | None) -> str | None:
    """Return the name of the messages on a topic of ours, None where another program made the topic.

    Parameters
    ----------
    topic, encoding : str
        Topic and message encoding of the log's channel.
    schema : str | None
        Name of the channel's schema.
    """
    source_name, _, name = topic.removeprefix("/").partition("/")
    source = SOURCES.get(source_name)
    if not name or source is None:
        return None
    if source is MAVLINK and encoding == "protobuf":
        return name if schema is not None and schema.startswith(f"{PACKAGE}.") else None
    if source.is_onboard_log and encoding == "protobuf":
        return name
    ours = source is ZENOH or schema is None or schema == _JSON_SCHEMA.name
    return name if encoding == "json" and ours else None


def decoder(topic: str, encoding: str, schema: tuple[str, bytes] | None) -> Decode | None:
    """Return the function that decodes a topic's records, None where another program made the topic.

    Parameters
    ----------
    topic, encoding : str
        Topic and message encoding of the log's channel.
    schema : tuple[str, bytes] | None
        Name and data of the channel's schema.

    Raises
    ------
    ValueError
        The schema cannot be used.
    """
    name = recorded_name(topic, encoding, None if schema is None else schema[0])
    if name is None:
        return None
    source = SOURCES[topic.removeprefix("/").partition("/")[0]]
    if source is MAVLINK:
        if encoding == "protobuf" and schema is not None:
            kind = MavlinkProtobuf(class_from_descriptor_set(schema[1], schema[0]))
            return MavlinkRecords(kind, name)
        return lambda data, time_ns: _mavlink_from_json(data, name, time_ns)
    if source is LINK:
        return lambda data, time_ns: _link_from_json(data, name, time_ns)
    if source.is_onboard_log and encoding == "protobuf" and schema is not None:
        return LogRecords(LogProtobuf(*schema), source, name)
    return lambda data, time_ns: Message(source, name, time_ns, json_object(data))


@dataclass(frozen=True, slots=True)
class MavlinkRecords:
    """Decodes the records of one MAVLink message, one by one when called, or many at once.

    Parameters
    ----------
    kind : MavlinkProtobuf
        Their type.
    name : str
        The message's name.
    """

    kind: MavlinkProtobuf
    name: str

    def __call__(self, data: bytes, time_ns: int) -> Message:
        """Return one of them as a message; see :meth:`MavlinkProtobuf.from_bytes`."""
        return self.kind.from_bytes(data, self.name, time_ns)

    def columns(
        self, data: Sequence[bytes], time_ns: NDArray[np.int64], position: NDArray[np.int64]
    ) -> list[Columns] | None:
        """Return them all as columns; see :meth:`MavlinkProtobuf.rows_from_bytes`."""
        return self.kind.rows_from_bytes(data, self.name, time_ns, position)


@dataclass(frozen=True, slots=True)
class LogRecords:
    """Decodes the records of one name of an onboard log, one by one when called, or many at once.

    Parameters
    ----------
    kind : LogProtobuf
        Their type.
    source : Source
        Which onboard log.
    name : str
        Name of the messages.
    """

    kind: LogProtobuf
    source: Source
    name: str

    def __call__(self, data: bytes, time_ns: int) -> Message:
        """Return one of them as a message; see :meth:`LogProtobuf.fields`."""
        return Message(self.source, self.name, time_ns, self.kind.fields(data))

    def columns(
        self, data: Sequence[bytes], time_ns: NDArray[np.int64], position: NDArray[np.int64]
    ) -> list[Columns] | None:
        """Return them all as columns, None where they have to be taken one by one."""
        fields = self.kind.columns(data)
        return None if fields is None else [Columns(self.source, self.name, 0, 0, position, time_ns, fields)]


@functools.cache
def _mavlink_schema(kind: MavlinkProtobuf) -> Schema:
    return Schema(str(kind.pb_class.DESCRIPTOR.full_name), "protobuf", descriptor_set(kind.pb_class))


def _mavlink_from_json(data: bytes, name: str, time_ns: int) -> Message:
    record = json_object(data)
    try:
        fields, ids = record["fields"], (record["system_id"], record["component_id"])
    except KeyError as error:
        raise ValueError(f"record of {name} lacks {error}") from error
    if not isinstance(fields, dict):
        raise ValueError(f"record of {name} has fields that are no JSON object")
    return Message(MAVLINK, name, time_ns, fields, *_checked_ids(name, ids))


def _link_from_json(data: bytes, name: str, time_ns: int) -> Message:
    fields = json_object(data)
    ids = fields.pop("system_id", 0), fields.pop("component_id", 0)
    return Message(LINK, name, time_ns, fields, *_checked_ids(name, ids))


def _checked_ids(name: str, ids: tuple[Any, Any]) -> tuple[int, int]:
    if not all(type(number) is int and 0 <= number <= _LARGEST_ID for number in ids):
        raise ValueError(f"record of {name} has ids that are no MAVLink ids")
    return ids


def _to_json(fields: Any) -> bytes:
    try:
        return json.dumps(dict(fields), separators=(",", ":")).encode()
    except (TypeError, RecursionError) as error:
        raise ValueError(f"no JSON can hold this: {error}") from error
