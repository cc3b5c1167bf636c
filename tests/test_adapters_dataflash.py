"""Onboard logs of ArduPilot: the same values as pymavlink's DFReader reads, and all that damage leaves."""

from __future__ import annotations

import array
import os
import struct
from pathlib import Path

import pytest
from dataflash_writer import DataflashWriter
from onboard_flights import messages_of, since_boot

from adapters.errors import TelemetryError
from adapters.logs.damage import ScanStatistics, scan_damage
from adapters.logs.dataflash import CODES, DataflashReader
from adapters.message import Message
from adapters.source import DATAFLASH

UNIX_S = 1_700_000_000


def flight(count: int = 40, gps: bool = True) -> DataflashWriter:
    """Return a log with every code there is."""
    log = DataflashWriter()
    log.define("IMU", "QBff", "TimeUS,I,GyrX,AccX", "s#--")
    log.define("ALL1", "QabBghHiIfn", "TimeUS,a,b,B,g,h,H,i,I,f,n")
    log.define("ALL2", "QNZcCeELdMq", "TimeUS,N,Z,c,C,e,E,L,d,M,q")
    log.define("GPS", "QBBIH", "TimeUS,I,Status,GMS,GWk", "s#---")
    log.define("FILE", "NZ", "FileName,Data")
    log.define("NONE", "", "")
    for step in range(count):
        time_us = 2_000_000 + 2_500 * step
        for instance in (0, 1, 2):
            log.add("IMU", time_us + instance, instance, 0.25 * step, -9.8)
        log.add("ALL1", time_us, list(range(-16, 16)), -1, 2, 0.5, -3, 4, -5, 6, 0.125, "abcd")
        log.add("ALL2", time_us, "name", "text, ünd mehr", -1.23, 6.5, -7.77, 1e5, -35.1234567, 1e99, 5, -(2**60))
        if gps and step % 4 == 0:
            seconds = UNIX_S + 2 - 315_964_800 + 18
            week, rest = divmod(seconds, 604_800)
            log.add("GPS", time_us, 0, 3 if step > 4 else 1, rest * 1_000 + step * 5 // 2, week)
        if step % 9 == 0:
            log.add("NONE")
    return log


LOG = flight()
FLIGHT = bytes(LOG.data)


def read(tmp_path: Path, data: bytes) -> tuple[list[Message], ScanStatistics]:
    path = tmp_path / "a.bin"
    path.write_bytes(data)
    reader = DataflashReader(path)
    return since_boot(reader), reader.statistics()


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> list[Message]:
    return read(tmp_path_factory.mktemp("dataflash"), FLIGHT)[0]


def key(message: Message) -> tuple[str, int, str]:
    return message.name, message.received_ns, repr(message.fields)


def test_values_times_and_instances_are_those_that_pymavlink_reads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MAVLINK20", "1")
    monkeypatch.setenv("MAVLINK_DIALECT", os.environ.get("MAVLINK_DIALECT", "ardupilotmega"))
    from pymavlink.DFReader import DFReader_binary

    path = LOG.write(tmp_path / "a.bin")
    theirs = DFReader_binary(str(path))
    ours = messages_of(DataflashReader(path))
    for message in ours:
        other = theirs.recv_msg()
        fields = other.to_dict()
        assert fields.pop("mavpackettype") == message.name.partition("/")[0]
        named = {name: list(v) if isinstance(v, array.array) else v for name, v in fields.items()}
        named = {name: list(v) if isinstance(v, bytes) else v for name, v in named.items()}
        assert repr(dict(message.fields)) == repr(named)
        if "TimeUS" in named:
            assert message.received_ns / 1e9 == pytest.approx(other._timestamp, abs=1e-6)
        if theirs.messages.get("IMU") is not None and message.name.startswith("IMU"):
            assert message.name == ("IMU", "IMU/1", "IMU/2")[named["I"]]
    assert theirs.recv_msg() is None
    theirs.data_map.close()
    theirs.filehandle.close()
    assert len(ours) == len(LOG.ends)
    imu = next(message for message in ours if message.name == "IMU")
    assert imu.received_ns == (UNIX_S + 2) * 1_000_000_000
    assert imu.source == DATAFLASH


def test_the_codes_are_those_of_pymavlink() -> None:
    from pymavlink.DFReader import FORMAT_TO_STRUCT

    theirs = {code: (form, times) for code, (form, times, _) in FORMAT_TO_STRUCT.items()}
    assert {code: (form, None if by is None else 1 / by) for code, (form, by) in CODES.items()} == theirs


def test_without_a_fix_boot_is_the_start_of_1970(tmp_path: Path) -> None:
    found = [m for m in messages_of(DataflashReader(flight(gps=False).write(tmp_path / "a.bin"))) if m.name == "IMU"]
    assert found[0].received_ns == 2_000_000_000


def test_pieces_of_files_keep_every_byte(tmp_path: Path) -> None:
    log = DataflashWriter()
    log.define("FILE", "NZ", "FileName,Data")
    log.add("FILE", "@SYS/x", "ab\0c")
    assert read(tmp_path, bytes(log.data))[0][-1].fields == {"FileName": "@SYS/x", "Data": "ab\0c" + "\0" * 60}


@pytest.mark.parametrize("fill", [b"\xff", b"\0"])
def test_what_fills_the_last_block_up_is_no_damage(tmp_path: Path, whole: list[Message], fill: bytes) -> None:
    found, statistics = read(tmp_path, FLIGHT + 200 * fill)
    assert [key(m) for m in found] == [key(m) for m in whole]
    assert scan_damage("a.bin", statistics) is None


@pytest.mark.parametrize(
    ("codes", "columns", "excess", "fields"),
    [
        ("QB", "TimeUS", 0, {"TimeUS": 7}),
        ("QBf", "TimeUS,I,Last", -4, {"TimeUS": 7, "I": 1}),
        ("QB", "TimeUS,I", 4, {"TimeUS": 7, "I": 1}),
        ("QBz", "TimeUS,I,New", 4, {"TimeUS": 7, "I": 1}),
    ],
)
def test_of_a_format_that_contradicts_itself_the_fields_that_fit_are_read(
    tmp_path: Path, whole: list[Message], codes: str, columns: str, excess: int, fields: dict[str, int]
) -> None:
    length = 3 + sum({"Q": 8, "B": 1, "f": 4}.get(code, 0) for code in codes) + excess
    head = FLIGHT[: LOG.ends[0]]
    bad = b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", 250, length, b"BAD", codes.encode(), columns.encode())
    record = b"\xa3\x95\xfa" + struct.pack("<QB", 7, 1) + bytes(8)
    found, statistics = read(tmp_path, head + bad + FLIGHT[LOG.ends[0] :] + record[:length])
    assert scan_damage("a.bin", statistics) is None
    assert [key(m) for m in [found[0], *found[2:-1]]] == [key(m) for m in whole]
    assert (found[-1].name, dict(found[-1].fields)) == ("BAD", fields)


def test_a_log_that_ends_within_a_record_is_not_called_damaged(tmp_path: Path, whole: list[Message]) -> None:
    found, statistics = read(tmp_path, FLIGHT[:-5])
    assert [key(m) for m in found] == [key(m) for m in whole[:-1]]
    assert scan_damage("a.bin", statistics) is None


def test_old_logs_count_milliseconds_and_their_gps_the_time_of_week(tmp_path: Path) -> None:
    log = DataflashWriter()
    log.define("IMU", "Iff", "TimeMS,GyrX,Temp")
    log.define("GPS", "BIHI", "Status,TimeMS,Week,T")
    week, rest = divmod(UNIX_S - 315_964_800 + 18, 604_800)
    for step in range(100):
        log.add("IMU", 50_000 + 20 * step, 0.0, 25.0)
        if step % 10 == 3:
            log.add("GPS", 3, rest * 1_000 + 20 * step, week, 50_000 + 20 * step)
    found = messages_of(DataflashReader(log.write(tmp_path / "a.bin")))
    assert [m.received_ns for m in found if m.name == "IMU"] == [
        (UNIX_S * 1_000 + 20 * n) * 1_000_000 for n in range(100)
    ]
    fixes = [m.received_ns for m in found if m.name == "GPS"]
    assert fixes == [(UNIX_S * 1_000 + 20 * n) * 1_000_000 for n in range(3, 100, 10)]


def test_a_log_of_sdlog2_is_refused_in_one_line(tmp_path: Path) -> None:
    log = DataflashWriter()
    log.define("TIME", "Q", "StartTime")
    log.define("ATT", "ffff", "qw,qx,qy,qz")
    log.add("TIME", 5_000_000)
    log.add("ATT", 1.0, 0.0, 0.0, 0.0)
    with pytest.raises(TelemetryError, match="sdlog2") as refused:
        read(tmp_path, bytes(log.data))
    assert "\n" not in str(refused.value)
