"""Fuzz targets of recordings that others made: onboard logs, mappings of them, MCAP of others, what `info` says."""

from __future__ import annotations

import itertools
import json
import struct
import sys
import tomllib
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from google.protobuf import descriptor_pb2

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from dataflash_writer import DataflashWriter
from foreign_logs import ARM_DEFINITION, ARM_TYPE, arm_protobuf
from fuzz_adapters import DATA, START_NS
from fuzz_input import ODD_VALUES, Draw, random_inputs
from fuzz_target import Run, Target, only
from onboard_flights import dataflash_of, ulog_of
from ulog_writer import SYNC, UlogWriter

from adapters.encoding.foreign_record import foreign_decoder
from adapters.encoding.message_record import decoder, encode
from adapters.encoding.record import Record, Schema
from adapters.errors import TelemetryError
from adapters.logs.dataflash import CODES, DataflashReader
from adapters.logs.log_mapping import SOURCES, LogMapping, builtin_mapping, parse_mapping, read_mapping
from adapters.logs.log_telemetry import telemetry
from adapters.logs.mcap_log import MessageLogWriter
from adapters.logs.mcap_reader import MessageLogReader
from adapters.logs.tlog import TlogReader
from adapters.logs.ulog import UlogReader
from adapters.message import Message
from replay.inspection.info_text import info_text
from replay.inspection.log_info import log_info

# How protobuf's own classes name what every message has: a field may bear any of these names too.
_TAKEN_NAMES = ("DESCRIPTOR", "HasField", "FromString", "SerializeToString", "None", "self", "Clear", "ListFields")
_FIELD_NAMES = ("a", "b", "stamp", "seconds", "nanos", "value", "key", *_TAKEN_NAMES)


def _flight(count: int) -> list[Message]:
    return list(itertools.islice(TlogReader(DATA / "copter_5s.tlog.xz"), count))


def _recorded(messages: Iterable[Message]) -> None:
    """Write each message of an onboard log and read it back: a converted log holds what the log held."""
    for message in messages:
        record = encode(message)
        assert (record.encoding == "protobuf") >= (message.source == "mavlink"), message
        decode = decoder(record.topic, record.encoding, (record.schema.name, record.schema.data))
        assert decode is not None
        assert repr(decode(record.data, record.time_ns)) == repr(message)


def _onboard(reader: Callable[[Path], Iterable[Message]], mapping: LogMapping, content: bytes, path: Path) -> None:
    """Read an onboard log, all of it as records and as telemetry, and in part."""
    path.write_bytes(content)
    messages = []
    with only(TelemetryError):
        messages = list(reader(path))
    _recorded(messages)
    _recorded(telemetry(messages, mapping, {"ATTITUDE", "GPS_RAW_INT", "HEARTBEAT", "SERVO_OUTPUT_RAW", "HIGHRES_IMU"}))


def _ulog(folder: Path) -> Run:
    flight, small = ulog_of(_flight(200), folder / "base").read_bytes(), _small_ulog()
    wanted = ("vehicle_attitude", "log/text")
    return _log_reader(UlogReader, "ulog", (flight, small), _ulog_records, wanted, folder / "one.ulg")


def _log_reader(
    reader: Callable[..., Any],
    source: str,
    logs: tuple[bytes, bytes],
    records: Callable[[Draw], bytes],
    wanted: tuple[str, ...],
    path: Path,
) -> Run:
    """Return what feeds a reader with edited logs, made-up records and bytes, whole and for some messages only."""
    mapping = builtin_mapping(source)

    def run(data: bytes) -> None:
        draw = Draw(data)
        how = draw.number() % 8
        if how < 4:
            content = draw.edited(logs[how % 2], 30)
        elif how < 7:
            content = records(draw)
        else:
            content = draw.rest()
        _onboard(reader, mapping, content, path)
        with only(TelemetryError):
            some = reader(path, wanted)
            assert {message.name for message in some} <= set(wanted)
            some.statistics()

    return run


def _small_ulog(appended: Sequence[int] = ()) -> bytes:
    """Return a log with every kind of record and every kind of field."""
    writer = UlogWriter(5, appended)
    writer.information("sys_name", "PX4")
    writer.keyed("M", "char[2] boot", b"ab", b"\1")
    writer.keyed("Q", "float MPC_X", struct.pack("<f", 1.5), b"\1")
    writer.parameter("SYS_AUTO", 3)
    writer.define("inner", "float a;uint8_t[2] _padding0")
    kinds = ("int8_t", "uint16_t", "int32_t", "uint64_t", "double", "bool", "char[4]", "float[3]")
    writer.define("all", "uint64_t timestamp;" + ";".join(f"{kind} f{k}" for k, kind in enumerate(kinds)))
    writer.define("nested", "uint64_t timestamp;inner one;inner[2] two;uint8_t[3] _padding0")
    numbers = [writer.subscribe("all"), writer.subscribe("all", 1), writer.subscribe("nested")]
    for k in range(6):
        number = numbers[k % 3]
        writer.add(
            number, "nested" if k % 3 == 2 else "all", {"timestamp": 1000 * k, "f6": "x", "one": {}, "two": [{}] * 2}
        )
    writer.text(7000, "text \xff")
    writer.record("C", struct.pack("<BHQ", 54, 1, 8000) + b"tagged")
    writer.dropout(5)
    writer.sync()
    writer.record("R", struct.pack("<H", numbers[0]))
    return bytes(writer.data)


_FORMATS = (
    *("uint64_t timestamp", "float q", "float[4] q", "uint64_t timestamp;float[4] q", "inner one", "inner[3] one"),
    *("inner[0] one", "a one", "a[65536] one", "char[70000] c", "char c", "bool x;bool x", "uint8_t _padding0", ""),
    *(
        "uint8_t[0] z",
        "double timestamp",
        "uint64_t[2] timestamp",
        "inner[99999999999999999999] i",
        "int8_t DESCRIPTOR",
    ),
    *(
        "uint64_t timestamp;uint64_t time_utc_usec;uint8_t fix_type;int32_t timestamp_time_relative",
        "char[2] timestamp",
    ),
)
_TOPICS = ("vehicle_attitude", "a", "inner", "vehicle_gps_position", "sensor_gps", "vehicle_status", "a/b", "\xff", "")
_KEYS = ("char[3] a", "int32_t P", "float P", "bool P", "uint64_t[2] x", "double[999999999999] x", "a b", "\xff")


def _ulog_records(draw: Draw) -> bytes:
    """Return a log whose records are as long as they say and hold anything."""
    writer = UlogWriter(draw.number(4), [draw.number(2) for _ in range(draw.number() % 3)], draw.number() % 3)
    if draw.number() % 2:
        writer.define("vehicle_attitude", "uint64_t timestamp;float[4] q")
        writer.subscribe("vehicle_attitude")
    while draw.more:
        kind = draw.choice("AABCDDDDDFFILMOPQRSX")
        if kind == "A":
            body = struct.pack("<BH", draw.number() % 3, draw.number() % 4) + draw.choice(_TOPICS).encode()
        elif kind == "F":
            body = f"{draw.choice(_TOPICS)}:{draw.choice(_FORMATS)};{draw.choice(_FORMATS)}".encode()
        elif kind == "D":
            body = struct.pack("<H", draw.number() % 4) + draw.take(draw.number())
            body = body.ljust(draw.choice((0, 2, 10, 12, 26, 60)), b"\0")
        elif kind in "IMPQ":
            key = draw.choice(_KEYS).encode()
            body = bytes(kind in "MQ") + bytes([len(key)]) + key + draw.take(draw.choice((0, 3, 4, 4, 16)))
        elif kind == "S":
            body = SYNC
        else:
            body = draw.take(draw.number())
        writer.record(kind, body)
    return bytes(writer.data)


def _log_seeds() -> list[bytes]:
    edits = [bytes([k % 4]) + one for k, one in enumerate(random_inputs(24, 60))]
    return [bytes(2), b"\1\0", *edits, *(bytes([4 + k % 4]) + one for k, one in enumerate(random_inputs(40, seed=3)))]


def _ulog_seeds() -> list[bytes]:
    return [*_log_seeds(), b"\7" + _small_ulog(), b"\7" + _small_ulog([300, 500]), b"\7" + _small_ulog()[:400]]


def _dataflash(folder: Path) -> Run:
    flight, small = dataflash_of(_flight(200), folder / "base").read_bytes(), _small_dataflash()
    wanted = ("ATT", "IMU/1")
    return _log_reader(DataflashReader, "dataflash", (flight, small), _dataflash_records, wanted, folder / "one.bin")


def _small_dataflash() -> bytes:
    """Return a log with every kind of field."""
    writer = DataflashWriter()
    writer.define("ALL", "".join(CODES), ",".join(["TimeUS", *(f"F{k}" for k in range(1, len(CODES)))])[:64])
    writer.define("ATT", "QBf", "TimeUS,I,Roll", "s#-")
    writer.define("OLD", "If", "TimeMS,Roll")
    for k in range(5):
        writer.add("ATT", 1000 * k, k % 3, 0.5)
        writer.add("OLD", 2 * k, -0.5)
    return bytes(writer.data)


_COLUMNS = ("TimeUS", "TimeMS", "I", "Roll", "FmtType", "UnitIds", "a b", "\xff", "", "Status", "GWk", "GMS", "Type")
_KINDS = ("ATT", "IMU", "GPS", "FMTU", "FMT", "FILE", "PARM", "a/b", "\xff", "")


def _dataflash_records(draw: Draw) -> bytes:
    """Return a log whose formats do not contradict themselves and whose records hold anything."""
    found = [DataflashWriter().data[:89]]
    lengths: dict[int, int] = {}
    while draw.more:
        if draw.number() % 3 == 0 or not lengths:
            codes = "".join(draw.choice("".join(CODES) + "x") for _ in range(draw.number() % 6))
            columns = ",".join(draw.choice(_COLUMNS) for _ in codes)
            kind = 126 + draw.number() % 6
            length = 3 + sum(struct.calcsize("<" + CODES.get(code, ("B",))[0]) for code in codes)
            lengths[kind] = length = length if draw.number() % 8 else draw.number()
            name = draw.choice(_KINDS).encode()
            body = struct.pack("<BB4s16s64s", kind, length & 255, name, codes.encode(), columns.encode())
            found.append(b"\xa3\x95\x80" + body)
        else:
            kind = draw.choice(sorted(lengths))
            count = max(0, lengths[kind] - 3)
            found.append(b"\xa3\x95" + bytes([kind]) + draw.take(count).ljust(count, b"\0"))
        found.append(draw.take(draw.number() % 4) if draw.number() % 4 == 0 else b"")
    return b"".join(found)


def _dataflash_seeds() -> list[bytes]:
    return [*_log_seeds(), b"\7" + _small_dataflash(), b"\7" + _small_dataflash()[:-7] + bytes(600)]


def _mapping(folder: Path) -> Run:
    path = folder / "mapping.toml"
    logs = {
        "ulog": list(UlogReader(ulog_of(_flight(300), folder / "base.ulg"))),
        "dataflash": list(DataflashReader(dataflash_of(_flight(300), folder / "base.bin"))),
    }

    def run(data: bytes) -> None:
        draw = Draw(data)
        source = draw.choice(SOURCES)
        with only(TelemetryError):
            if draw.number() % 3:
                found = parse_mapping(_tables(draw, source, logs[source]), "mapping.toml")
            else:
                path.write_bytes(draw.rest())
                found = read_mapping(path, source)
            messages = list(telemetry(logs[source], found, frozenset(found.rules)))
            _recorded(messages)
            assert all(one.source == "mavlink" for one in messages)

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
    whole = [(path / f"{source}.toml").read_bytes() for source in SOURCES]
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
    flight = _flight(150)
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
            info_text(found).encode()

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
            source = draw.choice(("mavlink", "mavlink", "mavlink", "zenoh", "ulog", "clock"))
            log.write(Message(source, one.name, time_ns % (1 << 64), fields, draw.number() % 3, draw.number() % 2))


def _info_seeds() -> list[bytes]:
    return [bytes([k % 8]) + one for k, one in enumerate(random_inputs(80, 200, seed=7))]


TARGETS = (
    Target("ulog", "onboard logs of PX4, to records and telemetry", _ulog, _ulog_seeds, 1 << 13, slow_s=2.0),
    Target("dataflash", "onboard logs of ArduPilot, the same", _dataflash, _dataflash_seeds, 1 << 13, slow_s=2.0),
    Target("mapping", "a user's mapping of onboard logs, and telemetry by it", _mapping, _mapping_seeds, slow_s=2.0),
    Target("foreign", "MCAP of others: ROS 2, JSON, protobuf by any schema", _foreign, _foreign_seeds, 1 << 13),
    Target("info", "what is in a recording of any kind", _info, _info_seeds, slow_s=2.0),
)
