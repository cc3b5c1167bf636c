"""Onboard logs of PX4: the same values as pyulog reads, in the order of the file, and all that damage leaves."""

from __future__ import annotations

import re
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from onboard_flights import messages_of, since_boot
from pyulog import ULog
from ulog_writer import UlogWriter

from adapters.errors import TelemetryError
from adapters.logs.damage import ScanStatistics
from adapters.logs.ulog import DROPOUT, INFORMATION, PARAMETER, PARAMETER_DEFAULT, TEXT, UlogReader
from adapters.message import Message
from adapters.source import ULOG

UTC_US = 1_700_000_000_000_000
GPS = "uint64_t timestamp;uint64_t time_utc_usec;int32_t timestamp_time_relative;uint8_t fix_type"


def flight(count: int = 40, gps: bool = True) -> UlogWriter:
    """Return a log with all kinds of fields and records, times out of order across topics."""
    log = UlogWriter(start_us=1_000)
    log.information("sys_name", "PX4")
    log.keyed("M", "char[3] boot", b"one", b"\0")
    log.parameter("MC_ROLL_P", 6.5)
    log.parameter("SYS_ID", -3)
    log.keyed("Q", "int32_t SYS_ID", struct.pack("<i", 1), b"\1")
    log.define("esc", "float rpm;uint8_t[3] flags;uint8_t _padding0")
    log.define("esc_status", "uint64_t timestamp;uint8_t count;uint8_t[7] _padding0;esc[2] esc;esc main;char[8] name")
    log.define("sensor_baro", "uint64_t timestamp;float pressure;bool ok;uint8_t[3] _padding0")
    log.define("wide", "uint64_t timestamp;int8_t a;uint16_t b;int16_t c;uint32_t d;int32_t e;int64_t f;double[2] g")
    log.define("vehicle_gps_position", GPS)
    baro, second, esc, wide, fix = (
        log.subscribe(name, instance)
        for name, instance in (
            ("sensor_baro", 0),
            ("sensor_baro", 1),
            ("esc_status", 0),
            ("wide", 0),
            ("vehicle_gps_position", 0),
        )
    )
    for step in range(count):
        time_us = 2_000_000 + 4_000 * step
        log.add(baro, "sensor_baro", {"timestamp": time_us, "pressure": 101_325.0 + step, "ok": step % 2 == 0})
        log.add(second, "sensor_baro", {"timestamp": time_us - 900, "pressure": 99.5})
        esc_values = {"rpm": float(step), "flags": [step % 256, 2, 3]}
        log.add(esc, "esc_status", {"timestamp": time_us, "esc": [esc_values] * 2, "main": esc_values, "name": "left"})
        log.add(
            wide, "wide", {"timestamp": time_us, "a": -1, "b": 2, "c": -3, "d": 4, "e": -5, "f": -6, "g": [0.5, 1e99]}
        )
        if gps and step % 10 == 5:
            known = {"timestamp": time_us, "time_utc_usec": UTC_US + time_us - 40, "timestamp_time_relative": -40}
            log.add(fix, "vehicle_gps_position", {**known, "fix_type": 3 if step > 10 else 2})
        if step % 7 == 3:
            log.sync()
            log.dropout(12)
            log.text(time_us, f"step {step}")
    return log


LOG = flight()
FLIGHT = bytes(LOG.data)


def read(tmp_path: Path, data: bytes) -> tuple[list[Message], ScanStatistics]:
    path = tmp_path / "a.ulg"
    path.write_bytes(data)
    reader = UlogReader(path)
    return since_boot(reader), reader.statistics()


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> list[Message]:
    return read(tmp_path_factory.mktemp("ulog"), FLIGHT)[0]


def flat(name: str, value: Any) -> dict[str, Any]:
    """Return fields under the names that pyulog gives them."""
    if isinstance(value, dict):
        return {k: v for key, inner in value.items() for k, v in flat(f"{name}.{key}" if name else key, inner).items()}
    if isinstance(value, list):
        return {k: v for place, inner in enumerate(value) for k, v in flat(f"{name}[{place}]", inner).items()}
    return {name: value}


def test_values_are_those_that_pyulog_reads(tmp_path: Path, whole: list[Message]) -> None:
    theirs = ULog(str(LOG.write(tmp_path / "a.ulg")))
    assert not theirs.file_corruption
    topics = {f"{d.name}/{d.multi_id}" if d.multi_id else d.name: d for d in theirs.data_list}
    ours: dict[str, list[dict[str, Any]]] = {}
    for message in whole:
        if not message.name.startswith("log/"):
            ours.setdefault(message.name, []).append(flat("", dict(message.fields)))
    assert topics.keys() == ours.keys()
    for name, rows in ours.items():
        columns = {key: column for key, column in topics[name].data.items() if not re.search(r"_padding|^name", key)}
        assert columns.keys() == rows[0].keys() - {"name"}
        for key, column in columns.items():
            assert np.array_equal(column, [row[key] for row in rows]), (name, key)
    texts = [(m.fields["timestamp"], m.fields["text"]) for m in whole if m.name == TEXT]
    assert texts == [(one.timestamp, one.message) for one in theirs.logged_messages]
    parameters = {m.fields["key"]: m.fields["value"] for m in whole if m.name == PARAMETER}
    assert parameters == theirs.initial_parameters
    assert sum(m.name == DROPOUT for m in whole) == len(theirs.dropouts)
    assert {m.fields["key"]: m.fields["value"] for m in whole if m.name == INFORMATION} == {
        "sys_name": "PX4",
        "boot": "one",
    }
    assert [m.fields for m in whole if m.name == PARAMETER_DEFAULT] == [
        {"key": "SYS_ID", "type": "int32_t", "value": 1.0, "sets": 1}
    ]


def test_records_keep_the_order_of_the_file_and_their_own_times(whole: list[Message]) -> None:
    data = [message for message in whole if not message.name.startswith("log/")]
    assert [message.name for message in data[:5]] == [
        "sensor_baro",
        "sensor_baro/1",
        "esc_status",
        "wide",
        "sensor_baro",
    ]
    assert [message.received_ns for message in data[:2]] == [2_000_000_000, 1_999_100_000]
    assert all(message.source == ULOG for message in whole)


def test_nested_types_are_fields_within_fields_and_text_is_text(whole: list[Message]) -> None:
    fields = next(message.fields for message in whole if message.name == "esc_status")
    assert fields["esc"] == [{"rpm": 0.0, "flags": [0, 2, 3]}] * 2
    assert fields["name"] == "left"
    assert "_padding0" not in fields


def test_times_are_unix_times_by_the_first_position_fix(tmp_path: Path) -> None:
    data = [m for m in messages_of(UlogReader(LOG.write(tmp_path / "a.ulg"))) if m.name == "sensor_baro"]
    assert data[0].received_ns == (UTC_US + 2_000_000) * 1_000
    boot = [m for m in messages_of(UlogReader(flight(gps=False).write(tmp_path / "b.ulg"))) if m.name == "sensor_baro"]
    assert boot[0].received_ns == 2_000_000_000


def test_a_log_that_needs_a_newer_reader_is_refused(tmp_path: Path) -> None:
    with pytest.raises(TelemetryError, match="newer kind"):
        list(UlogReader(UlogWriter(incompatible=2).write(tmp_path / "a.ulg")))


def test_data_appended_after_a_crash_is_read_from_where_the_log_says(tmp_path: Path) -> None:
    whole = flight(10)
    cut = len(whole.data) - 5
    log = UlogWriter(start_us=1_000, appended=[cut])
    assert len(log.data) == whole.ends[0]
    log.data += whole.data[whole.ends[0] : cut]
    log.keyed("M", "char[5] hardfault", b"stack", b"\0")
    found, statistics = read(tmp_path, bytes(log.data))
    assert found[-1].fields["value"] == "stack"
    assert statistics.damaged == 0
    assert ULog(str(tmp_path / "a.ulg")).msg_info_multiple_dict["hardfault"] == [["stack"]]


def test_a_record_of_a_kind_yet_unknown_is_stepped_over(tmp_path: Path, whole: list[Message]) -> None:
    place = LOG.ends[30]
    found, statistics = read(tmp_path, FLIGHT[:place] + struct.pack("<HB", 4, ord("Z")) + b"news" + FLIGHT[place:])
    assert found == whole
    assert (statistics.unknown, statistics.damaged) == (1, 0)


@pytest.mark.parametrize(("boot_us", "utc_us"), [((1 << 64) - 1, UTC_US), (0, (1 << 64) - 1)])
def test_a_position_fix_of_a_damaged_time_sets_no_clock(tmp_path: Path, boot_us: int, utc_us: int) -> None:
    log = UlogWriter()
    log.define("vehicle_gps_position", GPS)
    number = log.subscribe("vehicle_gps_position")
    for time_us, told_us in ((boot_us, utc_us), (1_000, UTC_US + 1_000)):
        values = {"timestamp": time_us, "time_utc_usec": told_us, "fix_type": 3}
        log.add(number, "vehicle_gps_position", values)
    assert messages_of(UlogReader(log.write(tmp_path / "log.ulg")))[-1].received_ns == (UTC_US + 1_000) * 1_000


@pytest.mark.parametrize("key", ["perf_counter_preflight-00", "a.b/c"])
def test_a_key_may_hold_any_letters(tmp_path: Path, whole: list[Message], key: str) -> None:
    place = LOG.ends[3]
    entry = UlogWriter()
    start = len(entry.data)
    entry.keyed("M", f"char[5] {key}", b"value", b"\0")
    found, statistics = read(tmp_path, FLIGHT[:place] + bytes(entry.data[start:]) + FLIGHT[place:])
    assert statistics.damaged == 0
    assert [m for m in found if m.fields.get("key") == key] == [found[3]]
    assert found[:3] + found[4:] == whole


def test_an_information_that_says_nothing_costs_itself_alone(tmp_path: Path, whole: list[Message]) -> None:
    place = LOG.ends[3]
    found, statistics = read(tmp_path, FLIGHT[:place] + struct.pack("<HB", 6, ord("I")) + b"\x05abcde" + FLIGHT[place:])
    assert (statistics.damaged, statistics.skipped_bytes) == (1, 9)
    assert found == whole
