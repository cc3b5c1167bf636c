"""Recordings are opened by what their names end in."""

from __future__ import annotations

import gzip
from pathlib import Path

import pytest

from adapters.errors import TelemetryError
from adapters.mcap_log import MessageLogWriter
from adapters.recordings import read_recording, recording_kind

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


@pytest.mark.parametrize("name", ["a", "a.csv", "a.xz", "a.tlog.zip", "a.mcap.bz2", "tlog"])
def test_an_unknown_kind_is_reported_with_what_is_known(tmp_path: Path, name: str) -> None:
    (tmp_path / name).touch()
    with pytest.raises(TelemetryError, match=f"{name}: unknown kind of recording; use .tlog or .mcap"):
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
