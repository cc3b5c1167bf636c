"""Recordings are opened by what their names end in."""

from __future__ import annotations

import gzip
from pathlib import Path

import pytest

from adapters.batch import messages
from adapters.errors import TelemetryError
from adapters.logs.mcap_log import MessageLogWriter
from adapters.logs.recordings import read_batches, read_recording, recording_kind
from adapters.message import Message
from adapters.source import ZENOH

FLIGHT = Path(__file__).parent / "data" / "copter_5s.tlog.xz"


def test_a_telemetry_log_and_its_mcap_hold_the_same_messages(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    with MessageLogWriter(path) as log:
        for message in read_recording(FLIGHT):
            log.write(message)
    packed = tmp_path / "flight.mcap.gz"
    packed.write_bytes(gzip.compress(path.read_bytes()))
    expected = list(read_recording(FLIGHT, {"ATTITUDE", "STATUSTEXT", "GPS_RAW_INT"}))
    assert len(expected) == 550
    for copy in (path, packed):
        assert list(read_recording(copy, {"ATTITUDE", "STATUSTEXT", "GPS_RAW_INT"})) == expected


def test_blocks_hold_the_messages_of_any_recording(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    with MessageLogWriter(path) as log:
        for message in read_recording(FLIGHT):
            log.write(message)
    for recording in (FLIGHT, path):
        for only in (None, {"ATTITUDE", "STATUSTEXT"}):
            blocks = list(read_batches(recording, only, count=1_000))
            found = [message for block in blocks for message in messages(block)]
            assert [repr(one) for one in found] == [repr(one) for one in read_recording(recording, only)]
            assert {one.name for block in blocks for one in block.columns} >= {"ATTITUDE"}
            assert max(block.count for block in blocks) < 2_000


@pytest.mark.parametrize("name", ["a", "a.csv", "a.xz", "a.tlog.zip", "a.mcap.bz2", "tlog"])
def test_an_unknown_kind_is_reported_with_what_is_known(tmp_path: Path, name: str) -> None:
    (tmp_path / name).touch()
    with pytest.raises(TelemetryError, match=f"{name}: unknown kind of recording; use .tlog, .mcap, .ulg or .bin"):
        recording_kind(tmp_path / name)


@pytest.mark.parametrize(
    ("name", "kind"), [("a.tlog", "tlog"), ("A.TLOG.GZ", "tlog"), ("a.b.mcap", "mcap"), ("a.mcap.xz", "mcap")]
)
def test_the_kind_is_told_by_the_suffix(tmp_path: Path, name: str, kind: str) -> None:
    (tmp_path / name).touch()
    assert recording_kind(tmp_path / name) == kind


def test_a_file_that_is_not_there_is_reported_at_once(tmp_path: Path) -> None:
    with pytest.raises(TelemetryError, match=r"a.tlog: no such file"):
        read_recording(tmp_path / "a.tlog")


def test_mistakes_in_a_mapping_are_told_of_recordings_that_need_none_too(tmp_path: Path) -> None:
    mapping = tmp_path / "mine.toml"
    mapping.write_text("[[ATITUDE]]\ntopic = 'a'\n")
    with pytest.raises(TelemetryError, match="is no MAVLink message"):
        read_recording(FLIGHT, mapping=mapping)
    mapping.write_text("ATTITUDE = []\n")
    assert len(list(read_recording(FLIGHT, {"ATTITUDE"}, mapping))) == len(list(read_recording(FLIGHT, {"ATTITUDE"})))


def write(path: Path, *numbers: int) -> None:
    with MessageLogWriter(path) as log:
        for number in numbers:
            log.write(Message(ZENOH, "k", 1 + number, {"n": number}))


def test_a_folder_is_read_as_one_session_in_the_order_of_names(tmp_path: Path) -> None:
    write(tmp_path / "a-1-20260101T000000Z-000010.mcap", 2, 3)
    write(tmp_path / "a-1-20260101T000000Z-000009.mcap", 0, 1)
    write(tmp_path / "a-1-20260102T000000Z-000000.mcap", 4)
    packed = tmp_path / "a-1-20260103T000000Z-000000.mcap"
    write(packed, 5)
    packed.with_suffix(".mcap.gz").write_bytes(gzip.compress(packed.read_bytes()))
    packed.unlink()
    (tmp_path / "a-1-20260104T000000Z-000000.mcap").touch()
    (tmp_path / "notes.txt").touch()
    assert recording_kind(tmp_path) == "mcap"
    assert [found.fields["n"] for found in read_recording(tmp_path)] == [*range(6)]
    assert list(read_recording(tmp_path, {"other"})) == []


def test_a_folder_of_one_file_of_any_name_is_a_session(tmp_path: Path) -> None:
    write(tmp_path / "flight.mcap", 1)
    assert len(list(read_recording(tmp_path))) == 1


def test_a_folder_without_recordings_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "a.tlog").touch()
    with pytest.raises(TelemetryError, match=r"^[^\n]*: holds no .mcap file; give a recording[^\n]*$"):
        recording_kind(tmp_path)


def test_a_folder_of_several_vehicles_names_them(tmp_path: Path) -> None:
    for vehicle in ("a-1", "a-2"):
        write(tmp_path / f"{vehicle}-20260101T000000Z-000000.mcap")
    with pytest.raises(TelemetryError, match=r"holds recordings of 2 vehicles or sessions \(a-1, a-2\); give one"):
        read_recording(tmp_path)
    write(tmp_path / "b.mcap")
    with pytest.raises(TelemetryError, match=r"3 vehicles or sessions \(a-1, a-2, b\)"):
        recording_kind(tmp_path)


@pytest.mark.parametrize("name", ["a.mcap", "a.ulg", "a.bin", "a.tlog.xz"])
def test_what_git_lfs_has_in_place_of_a_recording_is_named(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 647120\n")
    with pytest.raises(TelemetryError, match="is a Git LFS pointer, not the recording; get that with 'git lfs pull'"):
        recording_kind(path)
