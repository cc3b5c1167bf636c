"""What holds of every onboard log, of PX4 and of ArduPilot: order, times, and all that damage leaves."""

from __future__ import annotations

import contextlib
import gzip
import lzma
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
import test_adapters_dataflash
import test_adapters_ulog
from dataflash_writer import DataflashWriter
from hypothesis import given
from hypothesis import strategies as st
from onboard_flights import since_boot
from ulog_writer import UlogWriter

from adapters.errors import TelemetryError
from adapters.logs import compressed
from adapters.logs.damage import ScanStatistics, scan_damage
from adapters.logs.dataflash import DataflashReader
from adapters.logs.ulog import DROPOUT, TEXT, UlogReader
from adapters.message import Message


@dataclass(frozen=True)
class Kind:
    """One kind of onboard log: a flight, where its records end, and how it is read."""

    suffix: str
    flight: bytes
    ends: list[int]
    head: int
    first: int
    silent: bytes
    wanted: frozenset[str]
    refused: bytes
    reader: Callable[..., Any]

    def read(self, folder: Path, data: bytes, **options: Any) -> tuple[list[Message], ScanStatistics]:
        path = folder / f"a{self.suffix}"
        path.write_bytes(data)
        reader = self.reader(path, options.pop("only", None), **options)
        return since_boot(reader), reader.statistics()

    def messages(self, places: list[int]) -> int:
        """Return how many records are messages: formats, subscriptions and marks of ULog are none."""
        return sum(self.flight[start + 2] not in self.silent for start, _ in pairwise(places))


ULOG = Kind(
    suffix=".ulg",
    flight=bytes(test_adapters_ulog.LOG.data),
    ends=test_adapters_ulog.LOG.ends,
    head=16,
    first=20,
    silent=b"ABFS",
    wanted=frozenset({"sensor_baro/1", TEXT}),
    refused=b"\x55\x4c\x6f\x66\x01\x12\x35" + bytes(test_adapters_ulog.LOG.data[7:]),
    reader=UlogReader,
)
DATAFLASH = Kind(
    suffix=".bin",
    flight=bytes(test_adapters_dataflash.LOG.data),
    ends=test_adapters_dataflash.LOG.ends,
    head=0,
    first=30,
    silent=b"",
    wanted=frozenset({"IMU/1", "GPS"}),
    refused=b"\xa3\x94" + bytes(test_adapters_dataflash.LOG.data[2:]),
    reader=DataflashReader,
)
pytestmark = pytest.mark.parametrize("kind", [ULOG, DATAFLASH], ids=["ulog", "dataflash"])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("onboard")


def keys(messages: list[Message]) -> list[str]:
    return [repr(message) for message in messages]


WHOLE: dict[str, list[str]] = {}


def whole(kind: Kind, folder: Path) -> list[str]:
    if kind.suffix not in WHOLE:
        WHOLE[kind.suffix] = keys(kind.read(folder, kind.flight)[0])
    return WHOLE[kind.suffix]


def test_only_the_wanted_records_are_read(kind: Kind, folder: Path) -> None:
    found, _ = kind.read(folder, kind.flight, only=kind.wanted)
    assert {message.name for message in found} == kind.wanted
    wanted = [message for message in kind.read(folder, kind.flight)[0] if message.name in kind.wanted]
    assert keys(found) == keys(wanted)


@given(size=st.integers(1, 3_000))
def test_however_a_log_is_cut_into_batches_its_messages_are_the_same(kind: Kind, folder: Path, size: int) -> None:
    expected = whole(kind, folder)
    with mock.patch.object(compressed, "_PIECE_BYTES", size):
        found, statistics = kind.read(folder, kind.flight, read_ahead_bytes=size)
    assert keys(found) == expected
    assert scan_damage("a", statistics) is None


def test_numbers_are_columns_and_nothing_else_is(kind: Kind, folder: Path) -> None:
    (folder / f"a{kind.suffix}").write_bytes(kind.flight)
    (batch,) = kind.reader(folder / f"a{kind.suffix}")
    assert batch.count == len(whole(kind, folder))
    for columns in batch.columns:
        assert len(columns.position) == len(columns.received_ns)
        assert all(
            values.dtype.kind in "biuf" and len(values) == len(columns.position) for values in columns.fields.values()
        )
    for message in batch.others.values():
        assert message.name == DROPOUT or any(isinstance(value, str | dict) for value in message.fields.values())


@given(data=st.data())
def test_a_file_of_several_logs_is_refused_and_says_where_to_split_it(
    kind: Kind, folder: Path, data: st.DataObject
) -> None:
    end = data.draw(st.integers(kind.ends[2], len(kind.flight)))
    with pytest.raises(TelemetryError, match=rf"second from byte {end} on: split it there \(head -c {end}; "):
        kind.read(folder, kind.flight[:end] + kind.flight)


@pytest.mark.parametrize(("suffix", "pack"), [(".xz", lzma.compress), (".gz", gzip.compress)])
def test_compressed_logs_read_like_plain_ones(kind: Kind, folder: Path, suffix: str, pack: Any) -> None:
    path = folder / f"a{kind.suffix}{suffix}"
    path.write_bytes(pack(kind.flight))
    reader = kind.reader(path)
    assert keys(since_boot(reader)) == whole(kind, folder)
    assert scan_damage(path.name, reader.statistics()) is None


@given(data=st.data())
def test_a_truncated_log_gives_every_message_before_the_end(kind: Kind, folder: Path, data: st.DataObject) -> None:
    # behind the first record with a time, which says when the log begins
    cut = data.draw(st.integers(kind.ends[kind.first + 2], len(kind.flight) - 1))
    found, statistics = kind.read(folder, kind.flight[:cut])
    complete = [kind.head, *(end for end in kind.ends if end <= cut)]
    assert keys(found) == whole(kind, folder)[: kind.messages(complete)]
    # a log of ArduPilot ends wherever power is cut
    assert statistics.broken_off is (kind is ULOG and cut not in (kind.head, *kind.ends))
    assert (statistics.records, statistics.damaged) == (len(complete) - 1, 0)
    assert statistics.skipped_bytes == cut - complete[-1]


@given(data=st.data())
def test_damage_costs_no_message_before_it_and_reading_goes_on_behind_it(
    kind: Kind, folder: Path, data: st.DataObject
) -> None:
    place = data.draw(st.integers(kind.ends[kind.first], len(kind.flight) - 600))
    junk = data.draw(st.one_of(st.binary(min_size=1, max_size=300), st.integers(1, 300).map(bytes)))
    content = kind.flight[:place] + junk + kind.flight[place + len(junk) :]
    found, statistics = kind.read(folder, content)
    with mock.patch.object(compressed, "_PIECE_BYTES", 500):
        again, counts = kind.read(folder, content, read_ahead_bytes=500)
    assert (keys(again), counts) == (keys(found), statistics)
    before = kind.messages([kind.head, *(end for end in kind.ends if end <= place)])
    assert keys(found[:before]) == whole(kind, folder)[:before]
    assert repr(found[-1]) == whole(kind, folder)[-1]
    assert statistics.records <= len(kind.ends) + 300


@given(junk=st.binary(max_size=600))
def test_whatever_stands_behind_the_head_of_a_file_is_no_crash(kind: Kind, folder: Path, junk: bytes) -> None:
    with contextlib.suppress(TelemetryError):
        found, statistics = kind.read(folder, kind.flight[: kind.head or kind.ends[0]] + junk)
        assert statistics.records >= len(found)
    with contextlib.suppress(TelemetryError):
        kind.read(folder, junk)


@pytest.mark.parametrize("data", [b"", b"ULog", b"\xa3", bytes(5_000), None, b"x" * 99])
def test_a_file_that_is_no_such_log_is_refused_in_one_line(kind: Kind, folder: Path, data: bytes | None) -> None:
    with pytest.raises(TelemetryError, match=r"a\.\w+: not a (ULog file|DataFlash log)") as error:
        kind.read(folder, kind.refused if data is None else data)
    assert "\n" not in str(error.value)


def test_a_long_run_of_zeros_is_passed_over(kind: Kind, folder: Path) -> None:
    place = kind.ends[40]
    data = kind.flight[:place] + bytes(300_000) + kind.flight[place:]
    found, statistics = kind.read(folder, data, read_ahead_bytes=50_000)
    assert keys(found) == whole(kind, folder)
    damage = scan_damage("a", statistics)
    assert damage is not None
    assert damage.line() == "a: 1 damaged place, 300000 bytes unreadable"


def test_a_damaged_time_is_that_of_the_record_before(kind: Kind, folder: Path) -> None:
    times_us = (5, (1 << 64) - 1, 7)
    log: UlogWriter | DataflashWriter
    if kind is ULOG:
        log = UlogWriter(start_us=(1 << 64) - 1)
        log.define("A", "uint64_t timestamp")
        number = log.subscribe("A")
        for time_us in times_us:
            log.add(number, "A", {"timestamp": time_us})
    else:
        log = DataflashWriter()
        log.define("A", "Q", "TimeUS")
        for time_us in times_us:
            log.add("A", time_us)
    for size in (1, 1 << 20):
        found, _ = kind.read(folder, bytes(log.data), only=("A",), read_ahead_bytes=size)
        assert [message.received_ns for message in found] == [5_000, 5_000, 7_000]


SECOND = 1_000_000


def log_of(kind: Kind, records: list[tuple[str, int]]) -> bytes:
    """Return a log of records of some names, each with a stamp in microseconds."""
    names, times_us = (
        dict.fromkeys(name for name, _ in records),
        [time_us for name, time_us in records if name != "OTHR"],
    )
    log: UlogWriter | DataflashWriter
    if kind is ULOG:
        log = UlogWriter(start_us=records[0][1])
        for name in names:
            log.define(name, "uint64_t timestamp")
        numbers = {name: log.subscribe(name) for name in names}
        for name, time_us in records:
            log.add(numbers[name], name, {"timestamp": time_us})
    else:
        log = DataflashWriter(start_us=min(times_us))
        for name in names:
            log.define(name, "Q", "TimeUS")
        for name, time_us in records:
            log.add(name, time_us)
    return bytes(log.data)


@pytest.mark.parametrize("other_us", [0, 1_500_000_000_000_000, 400_000 * SECOND, 2 * SECOND])
@pytest.mark.parametrize("runs", [0, 1])
def test_a_topic_with_another_clock_does_not_move_that_of_the_log(
    kind: Kind, folder: Path, other_us: int, runs: int
) -> None:
    records = [("MINE", 100 * SECOND), ("ALSO", 100 * SECOND + 7)]
    for step in range(1, 200):
        now = 100 * SECOND + 10_000 * step
        records += [("MINE", now), ("OTHR", other_us + runs * 10_000 * step), ("ALSO", now + 7)]
    found, _ = kind.read(folder, log_of(kind, records))
    times = [(m.name, m.received_ns // 1_000) for m in found if m.name in ("MINE", "ALSO", "OTHR")]
    expected = [(name, time_us) for name, time_us in records if name != "OTHR"]
    assert [one for one in times if one[0] != "OTHR"] == expected
    assert {time_us for name, time_us in times if name == "OTHR"} == {time for name, time in expected[2::2]}


def test_a_topic_may_begin_with_another_clock_before_all_others(kind: Kind, folder: Path) -> None:
    records = [("OTHR", 400_000 * SECOND)] * 5
    records += [(name, 100 * SECOND + 10_000 * step) for step in range(50) for name in ("MINE", "ALSO")]
    found, _ = kind.read(folder, log_of(kind, records))
    assert [m.received_ns for m in found if m.name == "OTHR"] == [100 * SECOND * 1_000] * 5


def test_a_log_on_unix_time_keeps_it(kind: Kind, folder: Path) -> None:
    records = [("MINE", 1_700_000_000 * SECOND + 4_001 * step) for step in range(50)]
    found, _ = kind.read(folder, log_of(kind, records))
    assert [m.received_ns // 1_000 for m in found if m.name == "MINE"] == [time_us for _, time_us in records]


def test_two_flights_in_a_log_keep_their_times(kind: Kind, folder: Path) -> None:
    times_us = [start * SECOND + 10_000 * step for start, count in ((100, 50), (900, 90)) for step in range(count)]
    records = [(name, time_us) for time_us in times_us for name in ("MINE", "ALSO")]
    found, _ = kind.read(folder, log_of(kind, records))
    assert [m.received_ns // 1_000 for m in found if m.name in ("MINE", "ALSO")] == [time_us for _, time_us in records]
