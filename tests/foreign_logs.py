"""Recordings as other tools write them: ROS 2 bags, JSON and protobuf in MCAP."""

from __future__ import annotations

import functools
import json
import tomllib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import tomli_w
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2
from google.protobuf.descriptor_pb2 import FieldDescriptorProto as Kind
from mcap.writer import CompressionType, Writer
from mcap_ros2.writer import Writer as Ros2Writer

from adapters.encoding.message_definition import find_definition
from adapters.simulation.arm import SCENARIOS, ArmRun, simulate_arm
from monitor.profile import Profile

START_NS = 1_795_251_917_000_000_000
ARM_TOPIC = "/arm/sample"
ARM_TYPE = "arm_msgs/msg/ArmSample"
ARM_FIELDS = {"torque": "u[0]", "encoder_angle": "y[0]", "encoder_rate": "y[1]", "link_sum": "y[2]"}
ARM_DEFINITION = f"""std_msgs/Header header
float64[] u
float64[3] y
{"=" * 80}
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
{"=" * 80}
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
COMPRESSIONS = {kind.name.lower(): kind for kind in CompressionType}

Rows = Iterable[tuple[int, dict[str, Any]]]


def stamp(time_ns: int) -> dict[str, int]:
    return {"sec": time_ns // 1_000_000_000, "nanosec": time_ns % 1_000_000_000}


@functools.cache
def tracked() -> ArmRun:
    """Return 12 s of the arm's second case as it tracks; nobody may change it."""
    return simulate_arm(SCENARIOS["case2"], 12.0, 100.0, "tracking")


def arm_rows(run: ArmRun) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield time and fields of each sample of a run, on the clock of a robot that keeps Unix time."""
    for k, time_s in enumerate(run.t.tolist()):
        time_ns = START_NS + round(time_s * 1e9)
        header = {"stamp": stamp(time_ns), "frame_id": "arm"}
        yield time_ns, {"header": header, "u": run.u[k].tolist(), "y": run.y[k].tolist()}


def ros2_bag(
    path: Path,
    topics: dict[str, tuple[str, str | None, Rows]],
    compression: str = "zstd",
    chunk_bytes: int = 1 << 20,
) -> Path:
    """Write topics of a type, by its definition (None: the one shipped), one topic after the other."""
    with path.open("wb") as stream:
        writer = Ros2Writer(stream, chunk_size=chunk_bytes, compression=COMPRESSIONS[compression])
        for topic, (kind, text, rows) in topics.items():
            schema = writer.register_msgdef(kind, text or find_definition(kind, ()))
            for time_ns, fields in rows:
                writer.write_message(topic, schema, fields, log_time=time_ns)
        writer.finish()
    return path


def json_log(path: Path, topic: str, rows: Rows, compression: str = "zstd", chunk_bytes: int = 1 << 20) -> Path:
    """Write JSON with a schema, as Foxglove's tools do."""
    encoded = ((time_ns, json.dumps(fields).encode()) for time_ns, fields in rows)
    schema = json.dumps({"type": "object", "properties": {}}).encode()
    return mcap_log(path, topic, ("arm.Sample", "jsonschema", schema), "json", encoded, compression, chunk_bytes)


def protobuf_log(path: Path, rows: Rows, compression: str = "zstd", chunk_bytes: int = 1 << 20) -> Path:
    """Write the arm's samples as protobuf with its FileDescriptorSet."""
    sample, descriptors = arm_protobuf()

    def encoded() -> Iterator[tuple[int, bytes]]:
        for time_ns, fields in rows:
            message = sample(u=fields["u"], y=fields["y"])
            message.header.stamp.FromNanoseconds(time_ns)
            yield time_ns, message.SerializeToString()

    schema = ("arm.Sample", "protobuf", descriptors)
    return mcap_log(path, ARM_TOPIC, schema, "protobuf", encoded(), compression, chunk_bytes)


def write_foreign_profile(profile: Profile, folder: Path) -> Path:
    """Write the arm's profile with its channels from the topic of these recordings."""
    folder.mkdir(parents=True)
    for name, content in profile.files.items():
        (folder / name).write_bytes(content)
    table: dict[str, Any] = tomllib.loads((folder / "profile.toml").read_text())
    for side in ("inputs", "outputs"):
        channels = table["observers"]["arm"][side]
        for name in channels:
            channels[name] = {"message": ARM_TOPIC, "field": ARM_FIELDS[name]}
    (folder / "profile.toml").write_text(tomli_w.dumps(table))
    return folder


def arm_protobuf() -> tuple[Any, bytes]:
    """Return the class of a sample in protobuf, and its FileDescriptorSet."""
    file = descriptor_pb2.FileDescriptorProto(name="arm.proto", package="arm", syntax="proto3")
    file.dependency.append("google/protobuf/timestamp.proto")
    header = file.message_type.add(name="Header")
    header.field.add(
        name="stamp",
        number=1,
        label=Kind.LABEL_OPTIONAL,
        type=Kind.TYPE_MESSAGE,
        type_name=".google.protobuf.Timestamp",
    )
    sample = file.message_type.add(name="Sample")
    sample.field.add(
        name="header", number=1, label=Kind.LABEL_OPTIONAL, type=Kind.TYPE_MESSAGE, type_name=".arm.Header"
    )
    for number, name in enumerate(("u", "y"), 2):
        sample.field.add(name=name, number=number, label=Kind.LABEL_REPEATED, type=Kind.TYPE_DOUBLE)
    sample.field.add(name="raw", number=4, label=Kind.LABEL_OPTIONAL, type=Kind.TYPE_BYTES)
    sample.field.add(name="past", number=5, label=Kind.LABEL_REPEATED, type=Kind.TYPE_MESSAGE, type_name=".arm.Header")
    entry = sample.nested_type.add(name="GainsEntry")
    entry.options.map_entry = True
    entry.field.add(name="key", number=1, label=Kind.LABEL_OPTIONAL, type=Kind.TYPE_STRING)
    entry.field.add(name="value", number=2, label=Kind.LABEL_OPTIONAL, type=Kind.TYPE_DOUBLE)
    sample.field.add(
        name="gains", number=6, label=Kind.LABEL_REPEATED, type=Kind.TYPE_MESSAGE, type_name=".arm.Sample.GainsEntry"
    )
    pool = descriptor_pool.DescriptorPool()
    pool.AddSerializedFile(timestamp_pb2.DESCRIPTOR.serialized_pb)
    pool.Add(file)
    stamps = descriptor_pb2.FileDescriptorProto.FromString(timestamp_pb2.DESCRIPTOR.serialized_pb)
    descriptors = descriptor_pb2.FileDescriptorSet(file=[stamps, file]).SerializeToString()
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("arm.Sample")), descriptors


def mcap_log(
    path: Path,
    topic: str,
    schema: tuple[str, str, bytes],
    encoding: str,
    rows: Iterable[tuple[int, bytes]],
    compression: str = "zstd",
    chunk_bytes: int = 1 << 20,
    **options: Any,
) -> Path:
    """Write one topic with the mcap package's own writer."""
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=chunk_bytes, compression=COMPRESSIONS[compression], **options)
        writer.start()
        channel = writer.register_channel(topic, encoding, writer.register_schema(*schema))
        for time_ns, data in rows:
            writer.add_message(channel, time_ns, data, time_ns)
        writer.finish()
    return path
