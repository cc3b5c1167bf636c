"""A profile knows what kind of vehicle it was fitted to; fit, replay and daemon say where that does not agree."""

from __future__ import annotations

import csv
import json
import socket
import time
from dataclasses import replace
from pathlib import Path

import pytest
from daemons import DaemonProcess, Flight, free_ports

import fauio
from adapters.logs.mcap_log import MessageLogWriter
from adapters.logs.recordings import read_recording
from monitor.profile import Profile, read_profile

ROOT = Path(__file__).parent.parent
QUAD = str(ROOT / "replay" / "data" / "quad")
MISMATCH = "another vehicle than the profile's: it says it is a fixed wing, the profile was fitted to a quadrotor"
PATIENCE_S = 60.0


def test_a_fit_notes_what_its_recordings_say_the_vehicle_is(quad_profile: Profile) -> None:
    assert quad_profile.vehicle_type == read_profile(QUAD).vehicle_type == "quadrotor"


@pytest.mark.long
def test_a_fit_on_different_vehicles_says_so_and_takes_none_of_their_types(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rover, other = data / "rover_healthy_manual.tlog.xz", tmp_path / "other.mcap"
    with MessageLogWriter(other) as writer:
        for message in read_recording(rover):
            boat = message.name == "HEARTBEAT" and message.fields["type"] == 10
            writer.write(replace(message, fields=dict(message.fields) | {"type": 11}) if boat else message)
    folder = tmp_path / "rover"
    assert fauio.main(["fit", "--vehicle", "rover", str(rover), str(other), "-o", str(folder)]) == 0
    assert "fauio: recordings of different vehicles (ground rover, surface boat): " in capsys.readouterr().err
    assert read_profile(folder).vehicle_type == ""


def test_a_replay_of_another_vehicle_says_so_in_verdict_json_table_and_report(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, table, report = data / "plane_healthy.tlog.xz", tmp_path / "table.csv", tmp_path / "report.html"
    options = ["--alarms", str(tmp_path / "alarms.jsonl"), "--table", str(table), "--report", str(report)]
    assert fauio.main(["replay", QUAD, str(log), *options]) == 0
    assert MISMATCH in capsys.readouterr().out
    with table.open(newline="") as file:
        assert [row["mismatch"] for row in csv.DictReader(file)] == [MISMATCH]
    assert "it says it is a fixed wing" in report.read_text()
    assert fauio.main(["replay", QUAD, str(log), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["mismatch"] == MISMATCH


def test_a_replay_of_the_profiles_vehicle_says_nothing_of_it(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert fauio.main(["replay", QUAD, str(data / "copter_motor3_090.tlog.xz"), "--json"]) == 0
    assert "mismatch" not in json.loads(capsys.readouterr().out)


def test_a_daemon_logs_that_it_hears_another_vehicle(data: Path, tmp_path: Path) -> None:
    [udp] = free_ports(1, socket.SOCK_DGRAM)
    [tcp] = free_ports(1)
    config = tmp_path / "fauio.toml"
    config.write_text(f'profile = "{QUAD}"\nmavlink = "udpin:127.0.0.1:{udp}"\nlisten = ["tcp/127.0.0.1:{tcp}"]\n')
    with DaemonProcess(config) as daemon, Flight(data / "plane_healthy.tlog.xz", [udp], 0.0):
        deadline = time.monotonic() + PATIENCE_S
        while not (said := [line for line in daemon.log() if MISMATCH in line.get("because", "")]):
            assert time.monotonic() < deadline, daemon.log()
            time.sleep(0.1)
    assert (said[0]["event"], said[0]["level"]) == ("status", "warning")
