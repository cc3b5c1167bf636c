"""One telemetry message as a record of a log: encodes it, and decodes it by topic."""

import contextlib
import json
import re
from collections.abc import Callable, Mapping
from typing import Any

from adapters.encoding.foreign_record import foreign_decoder, json_object
from adapters.encoding.protobuf_types import class_from_schema
from adapters.encoding.record import Record, Schema
from adapters.encoding.typed_record import PACKAGE, TypedRecords, to_protobuf
from adapters.message import LATEST_NS, Message
from adapters.source import LINK, MAVLINK, OPERATOR, SOURCES, ZENOH, Source

# Viewers require a schema; a JSON topic may have any object.
_OWN = "fauio."
_JSON_SCHEMA = Schema(f"{_OWN}Telemetry", "jsonschema", b'{"type": "object"}')


def _own_schema(name: str, **properties: Any) -> Schema:
    return Schema(name, "jsonschema", json.dumps({"type": "object", "properties": properties}).encode())


_TEXT = {"type": "string"}
_TEXTS = {"type": "array", "items": _TEXT}
_COMMAND = _own_schema("fauio.Command", id=_TEXT, channel=_TEXT, by=_TEXT, reason=_TEXT, until_ns={"type": "integer"})
# by source and name; all others have the schema of any object
_OWN_SCHEMAS: Mapping[tuple[Source, str], Schema] = {
    (OPERATOR, "rules"): _own_schema(
        "fauio.Rules",
        latched=_TEXTS,
        out_of_service=_TEXTS,
        flood_raised={"type": "integer"},
        flood_s={"type": "number"},
        system={"type": "integer"},
        # sizes and times of each rule, by observer and channel
        alarms={
            "type": "object",
            "additionalProperties": {
                "type": "object",
                "additionalProperties": {"type": "object", "additionalProperties": {"type": "number"}},
            },
        },
    ),
    **{(OPERATOR, verb): _COMMAND for verb in ("ack", "shelve", "unshelve", "reset")},
}
_INFINITE = re.compile(r'"(?:[^"\\]|\\.)*"|Infinity')

_LARGEST_ID = 255
"""Largest MAVLink id of a system or component: one byte."""

Decode = Callable[[bytes, int], Message]


def encode(message: Message) -> Record:
    """Return a message as a record.

    MAVLink messages are protobuf, and JSON only if the fields are not those of pymavlink's definition. NaN stays a
    literal in JSON, which standard JSON lacks: a replay has to read the same input as the monitor. Infinity is 1e999,
    which every reader reads as infinity.

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
    from_mavlink = message.source is MAVLINK
    component = message.component if from_mavlink else 0
    if from_mavlink or message.source.is_onboard_log:
        with contextlib.suppress(ValueError):
            return Record(topic, "protobuf", *to_protobuf(message), message.received_ns, component)
    fields: Mapping[str, Any] = message.fields
    if from_mavlink:
        fields = {**ids, "fields": fields}
    elif message.source is LINK:
        fields = {**fields, **ids}
    schema = _OWN_SCHEMAS.get((message.source, message.name), _JSON_SCHEMA)
    return Record(topic, "json", schema, _to_json(fields), message.received_ns, component)


def recorded_name(topic: str, encoding: str, schema: Schema | None) -> str | None:
    """Return the name of the messages on a log's channel of ours, or None if another program made it."""
    source_name, _, name = topic.removeprefix("/").partition("/")
    source = SOURCES.get(source_name)
    if not name or source is None:
        return None
    if source is MAVLINK and encoding == "protobuf":
        return name if schema is not None and schema.name.startswith(f"{PACKAGE}.") else None
    if source.is_onboard_log and encoding == "protobuf":
        return name
    ours = source is ZENOH or schema is None or schema.name.startswith(_OWN)
    return name if encoding == "json" and ours else None


def decoder(topic: str, encoding: str, schema: Schema | None) -> Decode:
    """Return a function from the records of a log's channel, ours or others', as :func:`foreign_decoder` does."""
    name = recorded_name(topic, encoding, schema)
    if name is None:
        return foreign_decoder(topic, encoding, schema)
    source = SOURCES[topic.removeprefix("/").partition("/")[0]]
    if encoding == "protobuf" and schema is not None:
        return TypedRecords(source, name, class_from_schema(schema))
    if source is MAVLINK:
        return lambda data, time_ns: _mavlink_from_json(data, name, time_ns)
    if source is LINK:
        return lambda data, time_ns: _link_from_json(data, name, time_ns)
    return lambda data, time_ns: Message(source, name, time_ns, json_object(data))


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
        text = json.dumps(dict(fields), separators=(",", ":"))
    except (TypeError, RecursionError) as error:
        raise ValueError(f"no JSON can hold this: {error}") from error
    if "Infinity" in text:
        text = _INFINITE.sub(lambda found: "1e999" if found[0] == "Infinity" else found[0], text)
    return text.encode()
