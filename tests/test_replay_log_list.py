"""Which recordings arguments name, what their files are called, and that no log is overwritten."""

from __future__ import annotations

from pathlib import Path

import pytest

from adapters.errors import StorageError, TelemetryError, UsageError
from replay.runs.log_list import LogFile, check_outputs, find_logs, target


@pytest.fixture
def flights(tmp_path: Path) -> Path:
    """Return a folder of recordings, some below others, with a session of two files and with other things."""
    root = tmp_path / "flights"
    for name in (
        "b.tlog",
        "a.tlog.xz",
        "notes.txt",
        "day1/a.tlog",
        "day1/fit.json",
        "day2/quad-20260102T030405Z-0001.mcap",
        "day2/quad-20260102T030405Z-0002.mcap",
        "day2/clips/one.mcap",
        "day2/other.tlog",
    ):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(b"content")
    return root


def test_a_folder_stands_for_all_recordings_below_and_a_session_for_itself(flights: Path) -> None:
    found = find_logs([flights])
    assert [str(log.path.relative_to(flights)) for log in found] == [
        "a.tlog.xz",
        "b.tlog",
        "day1/a.tlog",
        "day2",
        "day2/clips/one.mcap",
        "day2/other.tlog",
    ]
    assert [log.name for log in found] == ["a", "b", "day1_a", "day2", "day2_clips_one", "day2_other"]


def test_the_folder_of_a_session_is_one_recording(flights: Path) -> None:
    (flights / "day2/clips/one.mcap").unlink()
    (flights / "day2/other.tlog").unlink()
    assert find_logs([flights / "day2"]) == [LogFile(flights / "day2", "day2")]
    (flights / "day2/quad-20260102T030405Z-0002.mcap").unlink()
    assert find_logs([flights / "day2"]) == [LogFile(flights / "day2", "day2")]


def test_recordings_of_the_same_name_get_names_of_their_own(flights: Path) -> None:
    found = find_logs([flights / "a.tlog.xz", flights / "day1/a.tlog", flights / "day1"])
    assert [log.name for log in found] == ["a", "a-2", "a-3"]


def test_a_folder_without_recordings_and_a_missing_file_are_refused(tmp_path: Path) -> None:
    for argument, complaint in ((tmp_path, "no recording in this folder"), (tmp_path / "no.tlog", "no such file")):
        with pytest.raises(TelemetryError, match=complaint):
            find_logs([argument])


def test_each_log_gets_a_file_of_its_own(tmp_path: Path) -> None:
    log = LogFile(Path("in/a.tlog"), "day1_a")
    assert target("--plot", None, log, ".png", many=True) is None
    assert target("--plot", str(tmp_path), log, ".png", many=False) == tmp_path / "day1_a.png"
    assert target("--plot", f"{tmp_path}/new", log, ".png", many=True) == tmp_path / "new" / "day1_a.png"
    pattern = f"{tmp_path}/{{log}}/estimates.png"
    assert target("--plot", pattern, log, ".png", many=True) == tmp_path / "day1_a" / "estimates.png"
    assert (tmp_path / "day1_a").is_dir()
    assert target("--plot", "one.png", log, ".png", many=False) == Path("one.png")
    with pytest.raises(UsageError, match=r"--plot one.png: takes one log at a time"):
        target("--plot", "one.png", log, ".png", many=True)


def test_no_log_is_overwritten(flights: Path) -> None:
    logs = find_logs([flights])
    check_outputs(logs, [flights / "new.mcap"], "twice")
    for path in (flights / "day1/../b.tlog", flights / "day2/quad-20260102T030405Z-0002.mcap"):
        with pytest.raises(StorageError, match="would be overwritten"):
            check_outputs(logs, [path], "twice")


def test_no_output_is_written_twice(flights: Path) -> None:
    one = flights / "new.png"
    with pytest.raises(UsageError, match="named twice"):
        check_outputs(find_logs([flights]), [one, flights / "day1" / ".." / "new.png"], "named twice")
