"""Fuzz targets of onboard logs: PX4's and ArduPilot's."""

from __future__ import annotations

import struct
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from dataflash_writer import DataflashWriter
from fuzz_input import Draw, random_inputs
from fuzz_logs import as_recorded, recorded_flight
from fuzz_target import Run, Target, only
from onboard_flights import dataflash_of, messages_of, ulog_of
from ulog_writer import SYNC, UlogWriter

from adapters.batch import Batch
from adapters.errors import TelemetryError
from adapters.logs.dataflash import CODES, DataflashReader
from adapters.logs.log_mapping import LogMapping, builtin_mapping
from adapters.logs.log_telemetry import telemetry
from adapters.logs.ulog import UlogReader


def _onboard(reader: Callable[[Path], Iterable[Batch]], mapping: LogMapping, content: bytes, path: Path) -> None:
    """Read an onboard log, all of it as records and as telemetry, and in part."""
    path.write_bytes(content)
    batches: list[Batch] = []
    with only(TelemetryError):
        batches = list(reader(path))
    as_recorded(messages_of(batches))
    names = {"ATTITUDE", "GPS_RAW_INT", "HEARTBEAT", "SERVO_OUTPUT_RAW", "HIGHRES_IMU"}
    as_recorded(messages_of(telemetry(batches, mapping, names, lambda _: batches)))


def _ulog(folder: Path) -> Run:
    flight, small = ulog_of(recorded_flight(200), folder / "base").read_bytes(), _small_ulog()
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
            assert {message.name for message in messages_of(some)} <= set(wanted)
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
    flight, small = dataflash_of(recorded_flight(200), folder / "base").read_bytes(), _small_dataflash()
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


TARGETS = (
    Target("ulog", "onboard logs of PX4, to records and telemetry", _ulog, _ulog_seeds, 1 << 13, slow_s=2.0),
    Target("dataflash", "onboard logs of ArduPilot, the same", _dataflash, _dataflash_seeds, 1 << 13, slow_s=2.0),
)
