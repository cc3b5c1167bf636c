"""MAVLink messages and records of onboard logs become typed records, and come back without loss."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from hypothesis import example, given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from adapters.batch import Batch, Columns, one_message
from adapters.encoding.message_record import encode
from adapters.encoding.protobuf_types import Field, class_from_schema, identifiers, message_class
from adapters.encoding.record import Schema
from adapters.encoding.typed_record import TypedRecords, mavlink_class, to_protobuf
from adapters.logs.mcap_log import MessageLogWriter
from adapters.logs.mcap_reader import MessageLogReader
from adapters.message import Message
from adapters.source import DATAFLASH, MAVLINK, ULOG, Source
from monitor.recording.record_encoder import RecordEncoder

TABLES = tuple(dialect.mavlink_map.values())
LARGEST = max(table.unpacker.size for table in TABLES)
SCALARS = st.one_of(
    st.integers(-(2**63), 2**63 - 1), st.floats(allow_nan=False), st.booleans(), st.text(st.characters(codec="utf-8"))
)
LISTS = st.one_of(*(st.lists(kind, min_size=1, max_size=4) for kind in (st.integers(-9, 9), st.booleans())))
NAMES = st.from_regex(r"[a-z][a-z0-9]{0,5}", fullmatch=True)
FIELDS = st.recursive(
    st.dictionaries(NAMES, SCALARS | LISTS, max_size=4),
    lambda inner: st.dictionaries(NAMES, SCALARS | inner | inner.map(lambda one: [one, one]), max_size=3),
    max_leaves=6,
)


def read_back(source: Source, name: str, schema: Schema) -> TypedRecords:
    """Return what reads a topic with nothing but the schema in the file."""
    return TypedRecords(source, name, class_from_schema(schema))


@given(fields=FIELDS)
def test_any_record_comes_back_as_it_was(fields: dict[str, Any]) -> None:
    schema, data = to_protobuf(Message(ULOG, "topic/1", 5, fields))
    found = read_back(ULOG, "topic/1", schema)(data, 5).fields
    assert found == fields
    assert repr(found) == repr(fields)


def columns(name: str, fields: dict[str, Any]) -> Columns:
    index = np.arange(2)
    return Columns(ULOG, name, 0, 0, index, 5 + index, fields)


@pytest.mark.parametrize(
    "fields",
    [
        {"t": np.array([1, 2], np.uint64), "x": np.array([0.1, 0.0], np.float32), "ok": np.array([True, False])},
        {"q": np.array([[1.0, 0.5], [0.0, -0.0]]), "n": np.array([[1], [200]], np.uint8)},
        # each of these is kept as JSON
        {"a b": np.array([1, 2])},
        {"n": np.array([1, 2**63], np.uint64)},
        {"nothing": np.empty((2, 0))},
    ],
)
def test_columns_are_encoded_as_their_messages_are(fields: dict[str, Any]) -> None:
    encoder = RecordEncoder(())
    given = columns("topic/1", fields)
    rows = dict(enumerate(one_message(given, row) for row in range(2)))
    together, singly = encoder.batch(Batch(2, (given,), {})), encoder.batch(Batch(2, (), rows))
    assert together == singly
    assert together.times_ns == [5, 6]


def test_the_schema_names_source_topic_and_types() -> None:
    schema, _ = to_protobuf(Message(DATAFLASH, "IMU/1", 5, {"TimeUS": 1, "GyrX": 0.5, "name": "x", "a": [1, 2]}))
    assert (schema.name, schema.encoding) == ("dataflash.IMU", "protobuf")
    fields = FileDescriptorSet.FromString(schema.data).file[0].message_type[0].field
    assert [(one.name, one.type, one.label) for one in fields] == [
        ("TimeUS", 3, 1),
        ("GyrX", 1, 1),
        ("name", 9, 1),
        ("a", 3, 3),
    ]


@pytest.mark.parametrize(
    "fields",
    [{"a": 2**63}, {"a b": 1}, {"a": []}, {"a": [1, "x"]}, {"a": [[1]]}, {"a": None}, {"a_b": 1, "aB": 2}],
    ids=["too large", "no name", "empty", "unlike", "lists", "nothing", "names alike"],
)
def test_what_no_type_can_hold_is_kept_as_json(tmp_path: Path, fields: dict[str, Any]) -> None:
    message = Message(ULOG, "odd", 5, fields)
    with pytest.raises(ValueError):
        to_protobuf(message)
    assert encode(message).encoding == "json"
    with MessageLogWriter(tmp_path / "a.mcap") as log:
        log.write(message)
    assert list(MessageLogReader(tmp_path / "a.mcap")) == [message]


def decoded(table: Any, payload: bytes) -> Message:
    """Return what pymavlink makes of a payload that came in a valid MAVLink 2 frame."""
    payload = payload[: table.unpacker.size]
    frame = bytearray(bytes([0xFD, len(payload), 0, 0, 7, 3, 191]) + table.id.to_bytes(3, "little") + payload)
    checksum = dialect.x25crc(frame[1:])
    checksum.accumulate(bytes([table.crc_extra]))
    found = dialect.MAVLink(None).decode(frame + checksum.crc.to_bytes(2, "little"))
    fields = {name: getattr(found, name) for name in found.get_fieldnames()}
    return Message(MAVLINK, table.msgname, 1, fields, found.get_srcSystem(), found.get_srcComponent())


def same(left: Any, right: Any) -> bool:
    """Compare field by field, types and signs of zero included, NaN equal to NaN."""
    if isinstance(left, list):
        return isinstance(right, list) and len(left) == len(right) and all(map(same, left, right))
    if isinstance(left, float):
        if math.isnan(left):
            return math.isnan(right)
        return isinstance(right, float) and left == right and math.copysign(1, left) == math.copysign(1, right)
    return type(left) is type(right) and left == right


@given(payload=st.binary(min_size=LARGEST, max_size=LARGEST))
@example(payload=b"\xff" * LARGEST)
@example(payload=b"\x00" * LARGEST)
@example(payload=b"\x00\x00\x00\x80" * LARGEST)
@example(payload=b"\x00\x00\x80\x7f" * LARGEST)
def test_every_message_of_the_dialect_goes_there_and_back_without_loss(payload: bytes) -> None:
    for table in TABLES:
        message = decoded(table, payload)
        _, data = to_protobuf(message)
        records = TypedRecords(MAVLINK, message.name, mavlink_class(message.name))
        back = records(data, message.received_ns)
        assert (back.system, back.component) == (3, 191)
        assert list(back.fields) == list(message.fields)
        for name, value in message.fields.items():
            assert same(value, back.fields[name]), (message.name, name, value, back.fields[name])
        for group in records.columns([data, data], np.array([5, 6]), np.array([0, 1])) or ():
            assert all(same(value, one_message(group, 1).fields[name]) for name, value in message.fields.items())


def test_records_of_which_one_is_damaged_or_whose_lists_differ_are_read_one_by_one() -> None:
    pb_class = message_class("ulog", "many", (Field("n", "int64", repeated=True),))
    records, ends = TypedRecords(ULOG, "many", pb_class), (np.array([5, 6]), np.array([0, 1]))
    one, two = (pb_class(n=numbers).SerializeToString() for numbers in ([1], [1, 2]))
    assert records.columns([one, one], *ends) is not None
    assert records.columns([one, two], *ends) is None
    assert records.columns([one, b"\xff"], *ends) is None


def test_a_message_is_read_with_nothing_but_the_schema_in_the_file() -> None:
    message = decoded(dialect.mavlink_map[dialect.MAVLINK_MSG_ID_GPS_RAW_INT], bytes(range(1, 60)))
    schema, data = to_protobuf(message)
    assert schema.name == "mavlink.GPS_RAW_INT"
    assert read_back(MAVLINK, "GPS_RAW_INT", schema)(data, 1) == message


def test_fields_are_typed_for_viewers() -> None:
    text = mavlink_class("STATUSTEXT").DESCRIPTOR.fields_by_name["text"]
    assert text.type == text.TYPE_STRING
    roll = mavlink_class("ATTITUDE").DESCRIPTOR.fields_by_name["roll"]
    assert roll.type == roll.TYPE_FLOAT


def test_a_message_of_another_dialect_is_refused_and_not_bent() -> None:
    with pytest.raises(ValueError, match="other fields"):
        to_protobuf(Message(MAVLINK, "ATTITUDE", 1, {"roll": 1.0}))
    with pytest.raises(ValueError, match="no MAVLink message is called UNKNOWN_4711"):
        to_protobuf(Message(MAVLINK, "UNKNOWN_4711", 1, {}))


@pytest.mark.parametrize("value", [-1, 2**32, 10**400, "text"])
def test_a_value_that_does_not_fit_is_refused(value: object) -> None:
    with pytest.raises(ValueError):
        to_protobuf(Message(MAVLINK, "SYSTEM_TIME", 1, {"time_unix_usec": 1, "time_boot_ms": value}))


def test_a_message_with_a_field_system_id_keeps_both(monkeypatch: pytest.MonkeyPatch) -> None:
    class Table:
        fieldnames = ordered_fieldnames = ("system_id", "value")
        fieldtypes = ("uint8_t", "float")
        array_lengths = (0, 0)

    monkeypatch.setattr("adapters.encoding.typed_record.message_tables", lambda: {"CLASH": Table})
    message = Message(MAVLINK, "CLASH", 5, {"system_id": 9, "value": 0.5}, system=1, component=2)
    schema, data = to_protobuf(message)
    assert read_back(MAVLINK, "CLASH", schema)(data, 5) == message


def test_identifiers_are_distinct_and_valid() -> None:
    assert identifiers(("motor1", "gyro_x")) == ("motor1", "gyro_x")
    found = identifiers(("f a", "f_a", "f-a", "1st", "", "aB", "a_b"))
    assert len(set(found)) == 7
    assert all(name.isidentifier() for name in found)


def test_a_schema_whose_ids_are_no_numbers_is_refused() -> None:
    for second in (Field("component_id", "string"), Field("component_id", "uint32", repeated=True)):
        with pytest.raises(ValueError, match="lacks the sender's ids"):
            TypedRecords(MAVLINK, "ODD", message_class("mavlink", "ODD", (Field("system_id", "uint32"), second)))
