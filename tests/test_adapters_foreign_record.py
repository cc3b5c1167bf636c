"""Topics that others record become messages: ROS 2 by the definition in the file, JSON, protobuf."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from foreign_logs import ARM_DEFINITION, ARM_TYPE, START_NS, arm_protobuf, mcap_log, ros2_bag, stamp
from google.protobuf import descriptor_pb2

from adapters.channels import parse_channel
from adapters.encoding.foreign_record import foreign_decoder
from adapters.encoding.record import Schema
from adapters.logs.mcap_reader import MessageLogReader
from adapters.source import ZENOH

HEADER = {"stamp": stamp(START_NS + 5), "frame_id": "base"}
VECTOR = {"x": 1.0, "y": -2.0, "z": 0.5}
ROS = {
    "/imu": ("sensor_msgs/msg/Imu", {"header": HEADER, "angular_velocity": VECTOR}, "angular_velocity.y", -2.0),
    "/gps/fix": ("sensor_msgs/msg/NavSatFix", {"header": HEADER, "latitude": 47.5}, "latitude", 47.5),
    "/odom": (
        "nav_msgs/msg/Odometry",
        {"header": HEADER, "child_frame_id": "b", "twist": {"twist": {"linear": VECTOR}}},
        "twist.twist.linear.z",
        0.5,
    ),
    "/cmd": (
        "geometry_msgs/msg/TwistStamped",
        {"header": HEADER, "twist": {"angular": VECTOR}},
        "twist.angular.x",
        1.0,
    ),
    "/joints": (
        "sensor_msgs/msg/JointState",
        {"header": HEADER, "name": ["wrist", "elbow"], "position": [0.25, 1.5], "velocity": [], "effort": []},
        "position[elbow]",
        1.5,
    ),
    "/raw": ("std_msgs/msg/Float64MultiArray", {"data": [1.0, 2.0, 4.0]}, "data[2]", 4.0),
}


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
def test_a_ros_2_bag_gives_the_fields_that_channels_name(tmp_path: Path, compression: str) -> None:
    topics: dict[str, Any] = {
        topic: (kind, None, [(START_NS + k, fields) for k in range(3)]) for topic, (kind, fields, *_) in ROS.items()
    }
    reader = MessageLogReader(ros2_bag(tmp_path / "bag.mcap", topics, compression))
    messages = list(reader)
    assert len(messages) == 3 * len(ROS)
    assert reader.damage() is None
    for message in messages:
        *_, field, value = ROS["/" + message.name]
        channel = parse_channel("c", {"message": message.name, "field": field}, "here")
        assert message.source == ZENOH
        assert channel.value(message.fields) == value
        assert channel.stamp_ns(message.fields) == (None if message.name == "raw" else START_NS + 5)
        assert START_NS <= message.received_ns < START_NS + 3


def test_a_type_is_read_by_the_definition_in_the_file(tmp_path: Path) -> None:
    fields = {"header": HEADER, "u": [1.0, 2.0], "y": [3.0, 4.0, 5.0]}
    [message] = MessageLogReader(
        ros2_bag(tmp_path / "bag.mcap", {"/arm": (ARM_TYPE, ARM_DEFINITION, [(START_NS, fields)])})
    )
    assert message.fields == fields


@pytest.mark.parametrize(("encoding", "text"), [("ros2msg", b""), ("ros2idl", b"module x {};"), ("", b"")])
def test_a_type_that_the_file_does_not_define_is_read_by_what_is_shipped(encoding: str, text: bytes) -> None:
    decode = foreign_decoder("/raw", "cdr", Schema("std_msgs/msg/Float64MultiArray", encoding, text))
    data = b"\0\1\0\0" + bytes(8) + (1).to_bytes(8, "little") + bytes(6) + b"\xf0\x3f"
    assert decode(data, 7).fields["data"] == [1.0]


@pytest.mark.parametrize(
    ("encoding", "schema", "reason"),
    [
        ("cdr", Schema("x_msgs/msg/Odd", "ros2idl", b"module"), "x_msgs/Odd: schema in 'ros2idl', and none"),
        ("cdr", Schema("x_msgs/msg/Odd", "ros2msg", b""), "x_msgs/Odd: no definition in the file"),
        ("cdr", Schema("x_msgs/msg/Odd", "ros2msg", b"what?"), "definition of x_msgs/Odd"),
        ("cdr", None, "cdr without a schema"),
        ("protobuf", Schema("a.B", "protobuf", b"\xff"), "schema of a.B cannot be used"),
        ("ros1", Schema("std_msgs/Header", "ros1msg", b""), "encoding 'ros1' is not known"),
    ],
)
def test_what_cannot_be_read_says_why(encoding: str, schema: Schema | None, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        foreign_decoder("/topic", encoding, schema)


def test_protobuf_becomes_plain_fields_with_times_as_ros_names_them() -> None:
    kind, descriptors = arm_protobuf()
    message = kind(u=[1.0], raw=b"\0\xff", past=[{}, {}], gains={"a": 2.0})
    message.header.stamp.FromNanoseconds(START_NS + 5)
    decode = foreign_decoder("/arm/sample", "protobuf", Schema("arm.Sample", "protobuf", descriptors))
    found = decode(message.SerializeToString(), START_NS)
    assert (found.source, found.name, found.received_ns) == (ZENOH, "arm/sample", START_NS)
    assert found.fields == {
        "header": {"stamp": stamp(START_NS + 5)},
        "u": [1.0],
        "y": [],
        "raw": "AP8=",
        "past": [{}, {}],
        "gains": {"a": 2.0},
    }
    assert "header" not in decode(kind(u=[1.0]).SerializeToString(), 0).fields
    with pytest.raises(ValueError, match=r"arm\.Sample"):
        decode(b"\xff\xff", 0)


@pytest.mark.parametrize(
    "fields",
    [{"timestamp": {"sec": 3, "nsec": 4}}, {"header": {"stamp": {"sec": 3, "nanosec": 4}}}, {"time_ns": 3_000_000_004}],
)
def test_the_time_of_a_json_message_is_found_under_the_usual_names(tmp_path: Path, fields: dict[str, Any]) -> None:
    path = mcap_log(
        tmp_path / "log.mcap", "/k", ("K", "jsonschema", b"{}"), "json", [(START_NS, json.dumps(fields).encode())]
    )
    [message] = MessageLogReader(path)
    assert message.name == "k"
    channel = parse_channel("c", {"message": "/k", "field": "x"}, "here")
    assert channel.message == "k"
    assert channel.stamp_ns(message.fields) == 3_000_000_004


def test_topics_of_others_are_not_taken_for_ours(tmp_path: Path) -> None:
    kind, descriptors = arm_protobuf()
    path = mcap_log(
        tmp_path / "log.mcap",
        "/mavlink/from",
        ("arm.Sample", "protobuf", descriptors),
        "protobuf",
        [(START_NS, kind(u=[1.0]).SerializeToString())],
    )
    [message] = MessageLogReader(path)
    assert (message.source, message.name) == (ZENOH, "mavlink/from")
    for topic in ("/operator/reset", "/link/state", "/journal/x", "/clock/silence", "/mavlink/ATTITUDE"):
        path = mcap_log(tmp_path / "log.mcap", topic, ("other.Type", "jsonschema", b"{}"), "json", [(START_NS, b"{}")])
        [message] = MessageLogReader(path)
        assert (message.source, message.name) == (ZENOH, topic[1:])


def hostile(*fields: tuple[str, int, int, str], name: str = "p.M") -> Schema:
    """Return a schema of one message: name, type, label and type name of its fields."""
    package, _, short = name.rpartition(".")
    file = descriptor_pb2.FileDescriptorProto(name="a", package=package, syntax="proto2")
    kind = file.message_type.add(name=short)
    for number, (field, of, label, type_name) in enumerate(fields, 1):
        kind.field.add(name=field, number=number, type=of, label=label, type_name=type_name or None)
    return Schema(name, "protobuf", descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString())


@pytest.mark.parametrize("name", ["HasField", "DESCRIPTOR", "FromString", "None", "self"])
def test_a_protobuf_field_may_bear_any_name(name: str) -> None:
    decode = foreign_decoder("/a", "protobuf", hostile((name, 5, 1, ""), ("other", 5, 1, "")))
    assert decode(b"\x08\x07", 1).fields == {name: 7}


def test_a_time_that_is_none_is_an_error_of_the_record() -> None:
    schema = hostile(("a", 5, 1, ""), name="google.protobuf.Timestamp")
    with pytest.raises(ValueError, match="Timestamp"):
        foreign_decoder("/a", "protobuf", schema)(b"\x08\x07", 1)
