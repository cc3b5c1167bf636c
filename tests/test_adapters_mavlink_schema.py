"""MAVLink messages as protobuf: every message of the dialect survives the way there and back."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from adapters.encoding.mavlink_schema import MavlinkProtobuf, mavlink_protobuf
from adapters.encoding.protobuf_types import class_from_descriptor_set, descriptor_set, identifiers
from adapters.message import Message
from adapters.source import MAVLINK

TABLES = tuple(dialect.mavlink_map.values())
LARGEST = max(table.unpacker.size for table in TABLES)


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


@settings(max_examples=25, deadline=None)
@given(payload=st.binary(min_size=LARGEST, max_size=LARGEST))
@example(payload=b"\xff" * LARGEST)
@example(payload=b"\x00" * LARGEST)
@example(payload=b"\x00\x00\x00\x80" * LARGEST)
@example(payload=b"\x00\x00\x80\x7f" * LARGEST)
def test_every_message_of_the_dialect_goes_there_and_back_without_loss(payload: bytes) -> None:
    for table in TABLES:
        message = decoded(table, payload)
        kind = mavlink_protobuf(message.name)
        assert kind is not None
        back = kind.from_bytes(kind.to_bytes(message), message.name, message.received_ns)
        assert (back.system, back.component) == (3, 191)
        assert list(back.fields) == list(message.fields)
        for name, value in message.fields.items():
            assert same(value, back.fields[name]), (message.name, name, value, back.fields[name])


def test_a_message_is_read_with_nothing_but_the_schema_in_the_file() -> None:
    message = decoded(dialect.mavlink_map[dialect.MAVLINK_MSG_ID_GPS_RAW_INT], bytes(range(1, 60)))
    kind = mavlink_protobuf("GPS_RAW_INT")
    assert kind is not None
    read = MavlinkProtobuf(class_from_descriptor_set(descriptor_set(kind.pb_class), "mavlink.GPS_RAW_INT"))
    assert read.from_bytes(kind.to_bytes(message), "GPS_RAW_INT", 1) == message


def test_fields_are_typed_for_viewers() -> None:
    kind = mavlink_protobuf("STATUSTEXT")
    attitude = mavlink_protobuf("ATTITUDE")
    assert kind is not None
    assert attitude is not None
    assert kind.pb_class.DESCRIPTOR.full_name == "mavlink.STATUSTEXT"
    text = kind.pb_class.DESCRIPTOR.fields_by_name["text"]
    assert text.type == text.TYPE_STRING
    roll = attitude.pb_class.DESCRIPTOR.fields_by_name["roll"]
    assert roll.type == roll.TYPE_FLOAT


def test_a_message_of_another_dialect_is_refused_and_not_bent() -> None:
    kind = mavlink_protobuf("ATTITUDE")
    assert kind is not None
    with pytest.raises(ValueError, match="other fields"):
        kind.to_bytes(Message(MAVLINK, "ATTITUDE", 1, {"roll": 1.0}))
    assert mavlink_protobuf("UNKNOWN_4711") is None


@pytest.mark.parametrize("value", [-1, 2**32, 10**400, "text", 1.5])
def test_a_value_that_does_not_fit_is_refused(value: object) -> None:
    kind = mavlink_protobuf("SYSTEM_TIME")
    assert kind is not None
    with pytest.raises(ValueError):
        kind.to_bytes(Message(MAVLINK, "SYSTEM_TIME", 1, {"time_unix_usec": 1, "time_boot_ms": value}))


def test_a_message_with_a_field_system_id_keeps_both() -> None:
    from adapters.encoding.mavlink_schema import _fields
    from adapters.encoding.protobuf_types import message_class

    class Table:
        fieldnames = ordered_fieldnames = ("system_id", "value")
        fieldtypes = ("uint8_t", "float")
        array_lengths = (0, 0)

    kind = MavlinkProtobuf(message_class("mavlink", "CLASH", _fields(Table)))
    message = Message(MAVLINK, "CLASH", 5, {"system_id": 9, "value": 0.5}, system=1, component=2)
    assert kind.from_bytes(kind.to_bytes(message), "CLASH", 5) == message


def test_identifiers_are_distinct_and_valid() -> None:
    assert identifiers(("motor1", "gyro_x")) == ("motor1", "gyro_x")
    found = identifiers(("f a", "f_a", "f-a", "1st", "", "aB", "a_b"))
    assert len(set(found)) == 7
    assert all(name.isidentifier() for name in found)


def test_a_schema_whose_ids_are_no_numbers_is_refused() -> None:
    from adapters.encoding.protobuf_types import Field, message_class

    for second in (Field("component_id", "string"), Field("component_id", "uint32", repeated=True)):
        with pytest.raises(ValueError, match="lacks the sender's ids"):
            MavlinkProtobuf(message_class("mavlink", "ODD", (Field("system_id", "uint32"), second)))
