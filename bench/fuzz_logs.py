"""Fuzz targets of recordings that others made: mappings of onboard logs, MCAP of others, what `info` says."""

from __future__ import annotations

import itertools
import json
import sys
import tomllib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from google.protobuf import descriptor_pb2

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from foreign_logs import ARM_DEFINITION, ARM_TYPE, arm_protobuf
from fuzz_adapters import DATA, START_NS
from fuzz_input import ODD_VALUES, Draw, random_inputs
from fuzz_target import Run, Target, only
from onboard_flights import dataflash_of, messages_of, ulog_of

from adapters.encoding.foreign_record import foreign_decoder
from adapters.encoding.message_record import decoder, encode
from adapters.encoding.record import Record, Schema
from adapters.errors import TelemetryError
from adapters.logs.dataflash import DataflashReader
from adapters.logs.log_mapping import ONBOARD_SOURCES, builtin_mapping, parse_mapping, read_mapping
from adapters.logs.log_telemetry import telemetry
from adapters.logs.mcap_log import MessageLogWriter
from adapters.logs.mcap_reader import MessageLogReader
from adapters.logs.recordings import read_recording
from adapters.logs.tlog import TlogReader
from adapters.logs.ulog import UlogReader
from adapters.message import Message
from adapters.source import CLOCK, MAVLINK, ULOG, ZENOH
from adapters.toml_tables import TomlFile
from replay.inspection.info import info_lines
from replay.inspection.log_info import log_info

# How protobuf's own classes name what every message has: a field may bear any of these names too.
_TAKEN_NAMES = ("DESCRIPTOR", "HasField", "FromString", "SerializeToString", "None", "self", "Clear", "ListFields")
_FIELD_NAMES = ("a", "b", "stamp", "seconds", "nanos", "value", "key", *_TAKEN_NAMES)


def recorded_flight(count: int) -> list[Message]:
    return list(itertools.islice(read_recording(DATA / "copter_5s.tlog.xz"), count))


def as_recorded(messages: Iterable[Message]) -> None:
    """Write each message of an onboard log and read it back: a converted log holds what the log held."""
    for message in messages:
        record = encode(message)
        assert (record.encoding == "protobuf") >= (message.source == MAVLINK), message
        decode = decoder(record.topic, record.encoding, record.schema)
        assert repr(decode(record.data, record.time_ns)) == repr(message)


def _mapping(folder: Path) -> Run:
    path = folder / "mapping.toml"
    logs = {
        "ulog": list(UlogReader(ulog_of(recorded_flight(300), folder / "base.ulg"))),
        "dataflash": list(DataflashReader(dataflash_of(recorded_flight(300), folder / "base.bin"))),
    }

    def run(data: bytes) -> None:
        draw = Draw(data)
        source = draw.choice(ONBOARD_SOURCES)
        with only(TelemetryError):
            if draw.number() % 3:
                tables = _tables(draw, source, messages_of(logs[source]))
                found = parse_mapping(TomlFile("mapping.toml", tables, TelemetryError))
            else:
                path.write_bytes(draw.rest())
                found = read_mapping(path, source)
            messages = messages_of(telemetry(logs[source], found, frozenset(found.rules), lambda _: logs[source]))
            as_recorded(messages)
            assert all(one.source == MAVLINK for one in messages)

    return run


def _tables(draw: Draw, source: str, log: Sequence[Message]) -> dict[str, Any]:
    """Return tables that name what the log holds, with odd values in places."""
    topics = sorted({message.name for message in log})
    fields = sorted({name for message in log[-60:] for name in message.fields})
    tables: dict[str, Any] = {}
    while draw.more:
        message, rules = draw.choice([*builtin_mapping(source).rules.items()])
        table: dict[str, Any] = {"topic": draw.choice(topics)}
        for _ in range(draw.number() % 5):
            name = draw.choice(rules[0].fields).name
            one: dict[str, Any] = {"field": draw.choice((*fields, "q", "xyz[0]", "output[3]", "[", "a.b"))}
            for _ in range(draw.number() % 5):
                key = draw.choice(
                    ("topic", "scale", "offset", "period", "interpolation", "angle", "value", "values", "unknown")
                )
                right = {"topic": topics, "interpolation": ("linear", "previous"), "angle": ("roll", "pitch", "yaw")}
                right |= {"values": ({"0": 1, "2": 300}, {"x": 1}, {}), "value": (3, 1.5), "unknown": (0, 1.5, 2**40)}
                right |= {"scale": (1e-3, 1e300, -1e10, 10**400), "period": (1e-320, 360, 1e308, 10**400)}
                odd = draw.number() % 4 == 0
                one[key] = draw.choice(ODD_VALUES) if odd else draw.choice(right.get(key, (1e9, -1e300)))
            table[name] = one if draw.number() % 16 else draw.value()
        if draw.number() % 4 == 0:
            table["repeat_s"] = draw.choice((1, 1e-12, 0.5, *ODD_VALUES))
        if draw.number() % 32 == 0:
            table[draw.text()] = draw.value()
        tables.setdefault(message if draw.number() % 32 else draw.text(), []).append(table)
    return tables


def _mapping_seeds() -> list[bytes]:
    path = Path(__file__).parents[1] / "adapters" / "definitions" / "logs"
    whole = [(path / f"{source}.toml").read_bytes() for source in ONBOARD_SOURCES]
    tables = [
        bytes([k, 0]) + b"[[" + one
        for k, text in enumerate(whole)
        for one in text.split(b"[[")[1:]
        if tomllib.loads("[[" + one.decode())
    ]
    odd = [b'[[ATTITUDE]]\ntopic="vehicle_attitude"\nroll={field="q",scale=' + b"9" * 400 + b"}", b"a=" + b"[" * 4000]
    return [
        *tables,
        *(b"\0\0" + one for one in odd),
        *(bytes([k % 2, 1]) + one for k, one in enumerate(random_inputs())),
    ]


def _foreign(folder: Path) -> Run:
    descriptors = arm_protobuf()[1]
    path = folder / "one.mcap"

    def run(data: bytes) -> None:
        draw = Draw(data)
        encoding, schema = _foreign_schema(draw, descriptors)
        if draw.number() % 2:
            with only(ValueError):
                decode = foreign_decoder("/a/b", encoding, schema)
                while draw.more:
                    payload = draw.block()
                    with only(ValueError):
                        message = decode(payload, START_NS)
                        encode(message)
            return
        with MessageLogWriter(path) as log:
            while draw.more:
                log.write_record(
                    Record(draw.choice(("/a/b", "/", "", "/zenoh/x")), encoding, schema, draw.block(), START_NS)
                )
        reader = MessageLogReader(path)
        with only(TelemetryError):
            for message in reader:
                with only(ValueError):
                    encode(message)
        reader.damage()

    return run


def _foreign_schema(draw: Draw, descriptors: bytes) -> tuple[str, Schema | None]:
    """Return an encoding and a schema as others write them, or as nobody should."""
    how = draw.number() % 8
    if how == 0:
        return "json", draw.choice((None, Schema("x", "jsonschema", b"{")))
    if how == 1:
        text = draw.edited(ARM_DEFINITION.encode())
        return "cdr", Schema(ARM_TYPE, draw.choice(("ros2msg", "ros2idl", "")), text)
    if how == 2:
        return draw.choice(("cdr", "protobuf", "", "ros1", "cbor")), draw.choice((None, Schema("", "", b"")))
    if how == 3:
        return "protobuf", Schema("arm.Sample", "protobuf", draw.edited(descriptors))
    return "protobuf", Schema(draw.choice(("p.M0", "p.M1", "M0", "p.M0.E", "")), "protobuf", _descriptors(draw))


def _descriptors(draw: Draw) -> bytes:
    """Return a FileDescriptorSet that can be parsed and says anything."""
    found = descriptor_pb2.FileDescriptorSet()
    for _ in range(1 + draw.number() % 2):
        file = found.file.add(name=draw.choice(("a", "b")), syntax=draw.choice(("proto3", "proto2", "x", "editions")))
        file.package = draw.choice(("p", "p", "p", ""))
        if draw.number() % 8 == 0:
            file.dependency.append(draw.choice(("a", "b", "google/protobuf/timestamp.proto")))
        for number in range(1 + draw.number() % 3):
            kind = file.message_type.add(name=f"M{number}")
            _describe(draw, kind)
            if draw.number() % 3 == 0:
                inner = kind.nested_type.add(name="E")
                inner.options.map_entry = bool(draw.number() % 4)
                _describe(draw, inner)
        if draw.number() % 4 == 0:
            listed = file.enum_type.add(name="K")
            listed.value.add(name="Z", number=draw.number() % 3)
    return found.SerializeToString()


def _describe(draw: Draw, kind: Any) -> None:
    kind.options.message_set_wire_format = draw.number() % 64 == 1
    for number in range(1, 1 + draw.number() % 5):
        names = ("key", "value") if draw.number() % 4 else _FIELD_NAMES
        field = kind.field.add(name=names[(number - 1) % len(names)] if len(names) == 2 else draw.choice(names))
        field.number = number if draw.number() % 16 else draw.number(4) >> 2
        field.type, field.label = 1 + draw.number() % 18, 1 + draw.number() % 3 % (3 if draw.number() % 8 else 2)
        if field.type in (10, 11, 14):
            field.type_name = draw.choice((".p.M0", ".p.M1", ".p.M0.E", ".p.K", "M1", "E"))
        if draw.number() % 16 == 0:
            field.default_value = draw.choice(("1", "nan", "x", "-1"))
        field.proto3_optional = draw.number() % 16 == 1


def _foreign_seeds() -> list[bytes]:
    arm, _ = arm_protobuf()
    sample = arm(u=[1.0], y=[1.0, 2.0, 3.0], gains={"k": 1.0})
    sample.header.stamp.seconds = 5
    data = sample.SerializeToString()
    block = len(data).to_bytes(2, "little") + data
    deep = b"\2\x10" + b'{"a":' * 700 + b"1" + b"}" * 700
    nested = b"\5\0\x01"
    return [
        *(bytes([3, 0, k]) + block for k in range(2)),
        *(bytes([0, 0, 1]) + len(one).to_bytes(2, "little") + one for one in (b"{}", b"[]", deep[2:], b"9" * 3000)),
        *(bytes([1, 0, 0, k]) + (60).to_bytes(2, "little") + b"\0\1\0\0" + bytes(56) for k in range(2)),
        *(bytes([4 + k % 4, k % 2]) + one for k, one in enumerate(random_inputs(80, seed=5))),
        nested + block,
    ]


def _info(folder: Path) -> Run:
    flight = recorded_flight(150)
    tlog = b"".join(
        (time_ns // 1000).to_bytes(8) + packet
        for time_ns, packet in itertools.islice(TlogReader(DATA / "copter_5s.tlog.xz").packets(), 100)
    )
    bases = [
        (".tlog", tlog),
        (".ulg", ulog_of(flight, folder / "base").read_bytes()),
        (".bin", dataflash_of(flight, folder / "base").read_bytes()),
    ]

    def run(data: bytes) -> None:
        draw = Draw(data)
        how = draw.number() % 8
        if how < 3:
            suffix, base = bases[how]
            path = folder / f"one{suffix}"
            path.write_bytes(draw.edited(base, 20))
        else:
            path = folder / "one.mcap"
            _odd_log(draw, path, flight)
        with only(TelemetryError):
            found = log_info(path)
            json.loads(json.dumps(found))
            "".join(info_lines(found)).encode()

    return run


def _odd_log(draw: Draw, path: Path, flight: Sequence[Message]) -> None:
    """Write a log of ours in which fields are odd, gone or new, with alarms and metadata of any content."""
    with MessageLogWriter(path) as log:
        if draw.number() % 2:
            log.add_metadata("fauio", {draw.choice(("vehicle", "onboard_log", "x")): draw.choice(("ulog", "x", ""))})
        time_ns = START_NS
        while draw.more:
            one = draw.choice(flight)
            how = draw.number() % 8
            time_ns += draw.choice((0, 10**6, 10**8, -(10**9), 1 << 62)) % (1 << 64)
            fields = dict(one.fields)
            if how < 4:
                fields[draw.choice([*fields])] = draw.value()
            elif how == 4:
                fields = draw.fields()
            elif how == 5:
                alarm = json.dumps({"state": "raised", **draw.fields()} if draw.number() % 4 else draw.value()).encode()
                log.write_record(Record("/fauio/alarm_json", "json", None, alarm, time_ns % (1 << 64)))
            source = draw.choice((MAVLINK, MAVLINK, MAVLINK, ZENOH, ULOG, CLOCK))
            log.write(Message(source, one.name, time_ns % (1 << 64), fields, draw.number() % 3, draw.number() % 2))


def _info_seeds() -> list[bytes]:
    return [bytes([k % 8]) + one for k, one in enumerate(random_inputs(80, 200, seed=7))]


TARGETS = (
    Target("mapping", "a user's mapping of onboard logs, and telemetry by it", _mapping, _mapping_seeds, slow_s=2.0),
    Target("foreign", "MCAP of others: ROS 2, JSON, protobuf by any schema", _foreign, _foreign_seeds, 1 << 13),
    Target("info", "what is in a recording of any kind", _info, _info_seeds, slow_s=2.0),
)
