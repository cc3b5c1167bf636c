"""``fauio replay`` as a user runs it: statuses, outputs of several logs, what a terminal and a pipe get."""

from __future__ import annotations

import contextlib
import csv
import json
import os
import re
import subprocess
import threading
from pathlib import Path

import pytest
from daemons import ENVIRONMENT, FAUIO

import fauio
from adapters.logs.mcap_log import MessageLogWriter
from adapters.message import Message
from adapters.source import MAVLINK

QUAD = str(Path(__file__).parent.parent / "replay" / "data" / "quad")


@pytest.fixture
def flight(data: Path) -> str:
    return str(data / "copter_motor3_090.tlog.xz")


@pytest.fixture
def damaged(tmp_path: Path) -> str:
    """Return the path of an empty recording."""
    (tmp_path / "empty.mcap").touch()
    return str(tmp_path / "empty.mcap")


def test_a_failed_log_ends_with_2_after_all_others_were_replayed(
    flight: str, damaged: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table = tmp_path / "table.csv"
    assert fauio.main(["replay", QUAD, damaged, flight, "--table", str(table)]) == 2
    said = capsys.readouterr()
    assert said.err.startswith(f"fauio: {damaged}: ")
    assert said.err.count("\n") == 1
    assert "copter_motor3_090.tlog.xz: 1 alarm in 13 s" in said.out
    with table.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["log"], row["status"], row["alarms"]) for row in rows] == [
        (damaged, "failed", "0"),
        (flight, "ok", "1"),
    ]


def test_an_alarm_counts_for_more_than_a_failed_log_where_it_was_asked_for(flight: str, damaged: str) -> None:
    assert fauio.main(["replay", QUAD, damaged, flight, "--fail-on-alarm"]) == 4
    assert fauio.main(["replay", QUAD, damaged, "--fail-on-alarm"]) == 2


def test_a_log_without_the_profiles_messages_is_a_failure(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = tmp_path / "poor.mcap"
    with MessageLogWriter(log) as writer:
        writer.write(Message(MAVLINK, "HEARTBEAT", 10**18, {"type": 2, "autopilot": 3, "base_mode": 128}, 1, 1))
    assert fauio.main(["replay", QUAD, str(log), "--json"]) == 2
    said = capsys.readouterr()
    assert "no samples; the log lacks channels of the profile" in said.err
    assert "(needed: ATTITUDE, " in said.err
    assert "motors saw nothing (no " in said.err
    # what operators send is none of the vehicle's
    assert "shelve" not in said.err
    assert "no samples" in json.loads(said.out)["error"]


def test_an_output_that_cannot_be_written_fails_the_log_without_a_traceback(
    flight: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert fauio.main(["replay", QUAD, flight, "-o", str(tmp_path / "nowhere" / "out.mcap")]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "nowhere" in said


def test_one_file_for_several_logs_is_refused_before_anything_is_read(
    flight: str, damaged: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for option in ("-o", "--plot", "--rrd"):
        assert fauio.main(["replay", QUAD, flight, damaged, option, str(tmp_path / "one.out")]) == 2
        assert "takes one log at a time" in capsys.readouterr().err
    assert fauio.main(["replay", QUAD, damaged, "-o", damaged]) == 2
    assert "would be overwritten" in capsys.readouterr().err
    assert fauio.main(["replay", QUAD, flight, "-o", str(tmp_path / "a"), "--rrd", str(tmp_path / "a")]) == 2
    assert "the same file twice" in capsys.readouterr().err


def test_alarms_of_one_log_are_those_of_the_contract_and_of_several_say_their_log(flight: str, tmp_path: Path) -> None:
    one, two = tmp_path / "one.jsonl", tmp_path / "two.jsonl"
    assert fauio.main(["replay", QUAD, flight, "--alarms", str(one)]) == 0
    assert fauio.main(["replay", QUAD, flight, flight, "--alarms", str(two)]) == 0
    events = [json.loads(line) for line in one.read_text().splitlines()]
    assert "log" not in events[0]
    assert [json.loads(line) for line in two.read_text().splitlines()] == 2 * [
        event | {"log": flight} for event in events
    ]


@pytest.mark.parametrize("count", [1, pytest.param(2, marks=pytest.mark.long)])
def test_results_go_to_a_pipe_while_progress_goes_to_the_terminal(flight: str, count: int) -> None:
    terminal, theirs = os.openpty()
    shown: list[bytes] = []
    reader = threading.Thread(target=read_all, args=(terminal, shown))
    reader.start()
    command = [*FAUIO, "replay", QUAD, *[flight] * count]
    done = subprocess.run(
        command, env=ENVIRONMENT | {"TERM": "xterm"}, stdout=subprocess.PIPE, stderr=theirs, text=True, check=False
    )
    os.close(theirs)
    reader.join()
    os.close(terminal)
    assert done.returncode == 0
    lines = done.stdout.splitlines()
    said = re.search(r"motors/motor3  warning  motor3 delivers ([\d.]+) % less than commanded", lines[0])
    assert said is not None
    assert float(said[1]) == pytest.approx(10.0, abs=0.5)
    assert "1 alarm in 13 s" in lines[-1]
    assert (b"of 2 logs" if count == 2 else b"messages") in b"".join(shown)


def read_all(terminal: int, shown: list[bytes]) -> None:
    """Read what a terminal shows until nobody writes to it any more."""
    with contextlib.suppress(OSError):
        while piece := os.read(terminal, 4096):
            shown.append(piece)


def test_an_alarm_is_one_line_and_its_events_are_there_for_who_asks(
    flight: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert fauio.main(["replay", QUAD, flight]) == 0
    line, verdict = capsys.readouterr().out.splitlines()
    assert re.search(r"^\S+Z to the end  quad  motors/motor3 .* \(± [\d.]+ %, peak -\d+ % of thrust\)$", line)
    assert "1 alarm in 13 s" in verdict
    assert fauio.main(["replay", QUAD, flight, "--verbose"]) == 0
    first, *_, last_but_one, last = capsys.readouterr().out.splitlines()
    assert "motors/motor3  raised" in first
    assert (last_but_one, last) == (line, verdict)
