"""A watched folder: each log that has come becomes a report once, and the page lists them all."""

from __future__ import annotations

import json
import os
import shutil
import time
from pathlib import Path

import pytest

import fauio
from adapters.logs.mcap_log import MessageLogWriter
from adapters.simulation.arm import SCENARIOS, simulate_arm
from adapters.simulation.arm_source import arm_messages
from monitor.profile import Profile
from replay.watch.folder_watch import FolderWatch, read_watched
from replay.watch.watch_command import INDEX_FILE

START_NS = 10**18


@pytest.fixture
def profile_folder(arm_profile: Profile, tmp_path: Path) -> Path:
    folder = tmp_path / "arm"
    folder.mkdir()
    for name, content in arm_profile.files.items():
        (folder / name).write_bytes(content)
    return folder


def write_log(path: Path, scenario: str = "healthy", seconds: float = 12.0) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with MessageLogWriter(path) as writer:
        for message in arm_messages(simulate_arm(SCENARIOS[scenario], seconds, 100.0, "zero"), START_NS):
            writer.write(message)


def watched(profile_folder: Path | None, tmp_path: Path, settled_s: float = 0.0) -> FolderWatch:
    out = tmp_path / "reports"
    out.mkdir(exist_ok=True)
    return FolderWatch(tmp_path / "logs", out, profile_folder, settled_s=settled_s)


def test_each_log_is_read_once_and_again_where_it_changed(profile_folder: Path, tmp_path: Path) -> None:
    write_log(tmp_path / "logs" / "monday" / "a.mcap")
    write_log(tmp_path / "logs" / "b.mcap", "case2", 30.0)
    watch = watched(profile_folder, tmp_path)
    flights = {flight.log: flight for flight in watch.look()}
    assert set(flights) == {"monday/a.mcap", "b.mcap"}
    assert flights["monday/a.mcap"].alarms == 0
    assert flights["monday/a.mcap"].verdict.startswith("no alarm in ")
    assert flights["b.mcap"].alarms > 0
    assert flights["b.mcap"].severity in ("warning", "critical")
    assert " from 01:4" in flights["b.mcap"].verdict
    page = (tmp_path / "reports" / INDEX_FILE).read_text()
    for flight in flights.values():
        assert f'href="{flight.report}"' in page
        assert "<h1>" in (tmp_path / "reports" / flight.report).read_text()
    assert watch.look() == []
    # another run goes on where this one was
    assert watched(profile_folder, tmp_path).look() == []
    write_log(tmp_path / "logs" / "b.mcap")
    [again] = watch.look()
    assert (again.log, again.alarms) == ("b.mcap", 0)


def test_a_log_that_is_still_being_written_waits(profile_folder: Path, tmp_path: Path) -> None:
    write_log(tmp_path / "logs" / "a.mcap")
    assert watched(profile_folder, tmp_path, settled_s=3600.0).look() == []
    assert "No log has come yet" in (tmp_path / "reports" / INDEX_FILE).read_text()


def test_a_log_that_was_written_before_the_clock_was_set_back_does_not_wait_for_it(
    profile_folder: Path, tmp_path: Path
) -> None:
    write_log(tmp_path / "logs" / "a.mcap")
    ahead_s = time.time() + 1800.0
    os.utime(tmp_path / "logs" / "a.mcap", (ahead_s, ahead_s))
    assert [one.log for one in watched(profile_folder, tmp_path, settled_s=3600.0).look()] == ["a.mcap"]


def test_a_log_that_cannot_be_read_is_listed_with_the_reason(profile_folder: Path, tmp_path: Path) -> None:
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "x<b>.ulg").write_bytes(b"no log")
    [flight] = watched(profile_folder, tmp_path).look()
    assert flight.error
    assert flight.report == ""
    page = (tmp_path / "reports" / INDEX_FILE).read_text()
    assert "x&lt;b&gt;.ulg" in page
    assert "<b>" not in page


def test_what_was_kept_may_be_damaged(tmp_path: Path) -> None:
    for text in ("", "{", '[{"log": 1, "colour": 2}]', "3"):
        (tmp_path / "flights.json").write_text(text)
        assert read_watched(tmp_path / "flights.json") == []


def test_the_command_reads_what_is_there(
    profile_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_log(tmp_path / "logs" / "a.mcap")
    command = ["watch", str(tmp_path / "logs"), "--profile", str(profile_folder), "-o", str(tmp_path / "out")]
    assert fauio.main([*command, "--once", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["log"] == "a.mcap"
    assert fauio.main([*command, "--once"]) == 0
    assert capsys.readouterr().out == ""
    assert fauio.main(["watch", str(tmp_path / "none"), *command[2:]]) == 2
    assert "is no folder" in capsys.readouterr().err


def test_without_a_profile_logs_are_reviewed(data: Path, tmp_path: Path) -> None:
    (tmp_path / "logs").mkdir()
    shutil.copy(data / "copter_wind_step.tlog.xz", tmp_path / "logs")
    [log] = watched(None, tmp_path).look()
    assert log.error == ""
    assert log.alarms == 0
    assert "Nothing wrong found" in log.verdict
    assert "What could not be judged" in (tmp_path / "reports" / log.report).read_text()
