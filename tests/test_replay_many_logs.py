"""Many logs in several processes: the same as one by one, also where a log or a process fails."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import threading
from multiprocessing import active_children
from pathlib import Path
from typing import Any

import pytest
from daemons import ENVIRONMENT, FAUIO
from loopback import until

import fauio
from monitor.profile import read_profile
from replay.runs.many_logs import replay_in_processes
from replay.runs.one_log import LogTask

QUAD = Path(__file__).parent.parent / "replay" / "data" / "quad"
FLIGHTS = ("copter_gps_step25m", "copter_motor3_090")


@pytest.fixture
def flights(tmp_path: Path, data: Path) -> Path:
    """Return a folder with flights and a file that is none."""
    folder = tmp_path / "flights"
    folder.mkdir()
    for name in FLIGHTS:
        shutil.copy(data / f"{name}.tlog.xz", folder)
    (folder / "copter_garbage.tlog").write_bytes(b"no telemetry" * 100)
    return folder


def replayed(flights: Path, folder: Path, *options: str) -> tuple[int, list[dict[str, Any]]]:
    """Replay into a folder; return the exit status and the alarm events that were written."""
    folder.mkdir()
    alarms = folder / "alarms.jsonl"
    status = fauio.main(["replay", str(QUAD), str(flights), "--alarms", str(alarms), "-o", f"{folder}/out", *options])
    return status, [json.loads(line) for line in alarms.read_text().splitlines()]


def without_progress(said: str) -> str:
    """Leave out the lines of a slow machine: how far it is after ten seconds."""
    return "".join(line for line in said.splitlines(keepends=True) if "fauio: replaying: " not in line)


def test_two_processes_find_what_one_finds(flights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one_status, one = replayed(flights, tmp_path / "one")
    one_said = capsys.readouterr()
    two_status, two = replayed(flights, tmp_path / "two", "--jobs", "2")
    two_said = capsys.readouterr()
    assert one == two
    assert one_said.out == two_said.out
    assert without_progress(one_said.err) == without_progress(two_said.err)
    assert one_status == two_status == 2
    assert "copter_garbage.tlog: holds no MAVLink 1 or 2 packet" in one_said.err
    assert without_progress(one_said.err).count("\n") == 1
    logs = [f"{flights}/{name}.tlog.xz" for name in FLIGHTS]
    assert list(dict.fromkeys(event["log"] for event in one)) == logs
    assert [event["channel"] for event in one if event["state"] == "raised"] == ["gps_north", "motor3"]
    for name in FLIGHTS:
        first, second = (tmp_path / run / "out" / f"{name}.mcap" for run in ("one", "two"))
        assert first.read_bytes() == second.read_bytes()


def test_a_process_that_dies_fails_its_log_alone(data: Path) -> None:
    tasks = [LogTask(name, data / "copter_5s.tlog.xz") for name in ("a", "b", "c")]
    killed = threading.Thread(target=kill_first_child)
    killed.start()
    outcomes = list(replay_in_processes(read_profile(QUAD), tasks, 2))
    killed.join()
    assert [outcome.log for outcome in outcomes] == ["a", "b", "c"]
    [failed] = [outcome for outcome in outcomes if outcome.error is not None]
    assert failed.error == f"{failed.log}: the process that replayed it was ended, perhaps for want of memory"
    assert all(outcome.samples for outcome in outcomes if outcome is not failed)


def kill_first_child() -> None:
    until(lambda: bool(active_children()))
    os.kill(active_children()[0].pid or 0, signal.SIGKILL)


def test_an_interrupt_ends_all_processes(flights: Path, data: Path) -> None:
    for k in range(20):
        (flights / f"later{k}.tlog.xz").symlink_to(data / "copter_healthy_square.tlog.xz")
    command = [*FAUIO, "replay", str(QUAD), str(flights), "--jobs", "2", "--json"]
    with subprocess.Popen(
        command, env=ENVIRONMENT, start_new_session=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert json.loads(process.stdout.readline())["error"]
        # as a terminal does: to all processes at once
        os.killpg(process.pid, signal.SIGINT)
        _, complaints = process.communicate(timeout=60)
    assert process.returncode == fauio.INTERRUPTED
    assert without_progress(complaints).count("\n") == 1
    assert "copter_garbage" in complaints
    until(lambda: not group_exists(process.pid))


def group_exists(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True
