"""A profile knows which vehicle it was fitted to; fit, replay and monitor refuse another, a daemon goes on without."""

from __future__ import annotations

import csv
import json
import socket
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest
from daemons import ENVIRONMENT, FAUIO, DaemonProcess, Flight, free_ports
from loopback import until

import fauio
from adapters.logs.mcap_log import MessageLogWriter
from adapters.logs.recordings import packed, read_recording
from monitor.estimate import Estimates
from monitor.event import AlarmEvent
from monitor.pipeline import Pipeline
from monitor.profile import Profile, read_profile
from monitor.sampling.identity import Identity

ROOT = Path(__file__).parent.parent
QUAD = str(ROOT / "replay" / "data" / "quad")
MISMATCH = "another vehicle than the profile's: it says it is a fixed wing, the profile was fitted to a quadrotor"
PATIENCE_S = 60.0


def test_a_fit_notes_what_its_recordings_say_the_vehicle_is(quad_profile: Profile) -> None:
    assert quad_profile.identity == Identity("quadrotor", "ardupilotmega")
    assert read_profile(QUAD).identity.vehicle_type == "quadrotor"


def test_a_fit_of_another_kind_of_vehicle_is_refused(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = data / "plane_healthy.tlog.xz"
    assert fauio.main(["fit", "--vehicle", "multirotor", str(log), "-o", str(tmp_path / "quad")]) == 2
    assert capsys.readouterr().err == (
        f"fauio: {log}: says it is a fixed wing, which is no multirotor; fit it with --vehicle plane, or go on with "
        "--force\n"
    )
    assert not (tmp_path / "quad").exists()


def boat(rover: Path, path: Path) -> Path:
    """Write the drive of a rover as that of a boat."""
    with MessageLogWriter(path) as writer:
        for message in read_recording(rover):
            boat = message.name == "HEARTBEAT" and message.fields["type"] == 10
            writer.write(replace(message, fields=dict(message.fields) | {"type": 11}) if boat else message)
    return path


def test_a_fit_on_different_vehicles_is_refused(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rover = data / "rover_healthy_manual.tlog.xz"
    other = boat(rover, tmp_path / "other.mcap")
    assert fauio.main(["fit", "--vehicle", "rover", str(rover), str(other), "-o", str(tmp_path / "rover")]) == 2
    assert capsys.readouterr().err == (
        f"fauio: {other}: says it is a surface boat, {rover} that it is a ground rover; a profile is of one vehicle: "
        "fit each from its own recordings, or go on with --force\n"
    )


@pytest.mark.long
def test_a_forced_fit_on_different_vehicles_takes_none_of_their_types(data: Path, tmp_path: Path) -> None:
    rover, folder = data / "rover_healthy_manual.tlog.xz", tmp_path / "rover"
    other = boat(rover, tmp_path / "other.mcap")
    assert fauio.main(["fit", "--vehicle", "rover", str(rover), str(other), "--force", "-o", str(folder)]) == 0
    assert read_profile(folder).identity == Identity(autopilot="ardupilotmega")


def test_a_replay_of_another_vehicle_is_refused_in_one_line_and_leaves_no_recording(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, table, recording = data / "plane_healthy.tlog.xz", tmp_path / "table.csv", tmp_path / "out.mcap"
    assert fauio.main(["replay", QUAD, str(log), "--table", str(table), "-o", str(recording)]) == 2
    refusal = f"{MISMATCH}; take its own profile, or go on with --force"
    assert capsys.readouterr() == ("", f"fauio: {log}: {refusal}\n")
    assert not recording.exists()
    with table.open(newline="") as file:
        [row] = csv.DictReader(file)
    assert (row["status"], row["mismatch"]) == ("failed", refusal)


def test_a_refused_log_lets_others_be_replayed(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    logs = [str(data / name) for name in ("plane_healthy.tlog.xz", "copter_5s.tlog.xz")]
    assert fauio.main(["replay", QUAD, *logs, "--json"]) == 2
    plane, copter = map(json.loads, capsys.readouterr().out.splitlines())
    assert MISMATCH in plane["error"]
    assert plane["samples"] == 0 < copter["samples"]
    assert "error" not in copter


def test_a_forced_replay_of_another_vehicle_says_so_in_verdict_json_table_and_report(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, table, report = data / "plane_healthy.tlog.xz", tmp_path / "table.csv", tmp_path / "report.html"
    options = ["--alarms", str(tmp_path / "alarms.jsonl"), "--table", str(table), "--report", str(report), "--force"]
    assert fauio.main(["replay", QUAD, str(log), *options]) == 0
    assert MISMATCH in capsys.readouterr().out
    with table.open(newline="") as file:
        assert [row["mismatch"] for row in csv.DictReader(file)] == [MISMATCH]
    assert "it says it is a fixed wing" in report.read_text()
    assert fauio.main(["replay", QUAD, str(log), "--json", "--force"]) == 0
    assert json.loads(capsys.readouterr().out)["mismatch"] == MISMATCH


def test_a_replay_of_the_profiles_vehicle_says_nothing_of_it(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert fauio.main(["replay", QUAD, str(data / "copter_5s.tlog.xz"), "--json"]) == 0
    assert "mismatch" not in json.loads(capsys.readouterr().out)


def test_what_would_be_detected_is_not_measured_on_another_vehicle(
    data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert fauio.main(["detectability", QUAD, str(data / "plane_healthy.tlog.xz"), "--sizes", "0.1"]) == 2
    assert capsys.readouterr().err == f"fauio: plane_healthy.tlog.xz: {MISMATCH}; take its own profile\n"


def test_a_pipeline_raises_no_alarm_of_another_vehicle_unless_forced(quad_profile: Profile, data: Path) -> None:
    evidence = {}
    for force in (False, True):
        pipeline = Pipeline(quad_profile, force=force)
        hexa = (
            replace(message, fields=dict(message.fields) | {"type": 13}) if message.name == "HEARTBEAT" else message
            for message in read_recording(data / "copter_motor3_090.tlog.xz", pipeline.interests)
        )
        outputs = [output for batch in packed(hexa) for output in pipeline.run(batch)]
        evidence[force] = sum(int(one.armed.sum()) for one in outputs if isinstance(one, Estimates))
        assert any(isinstance(one, AlarmEvent) for one in outputs) is force
        assert pipeline.mismatch is not None
    assert evidence[False] == 0 < evidence[True]


def test_a_daemon_goes_on_without_watching_another_vehicle_and_says_so(data: Path, tmp_path: Path) -> None:
    [udp] = free_ports(1, socket.SOCK_DGRAM)
    [tcp] = free_ports(1)
    config = tmp_path / "fauio.toml"
    config.write_text(f'profile = "{QUAD}"\nmavlink = "udpin:127.0.0.1:{udp}"\nlisten = ["tcp/127.0.0.1:{tcp}"]\n')
    with DaemonProcess(config) as daemon, Flight(data / "plane_healthy.tlog.xz", [udp], 0.0):
        said = until(lambda: [line for line in daemon.log() if MISMATCH in line.get("because", "")], 0.05)
        assert daemon.process.poll() is None
    assert (said[0]["event"], said[0]["level"], said[0]["state"]) == ("status", "warning", "blind")
    assert said[0]["because"].startswith("not watched: ")


@pytest.mark.parametrize("force", [False, True])
def test_a_monitor_started_on_another_vehicle_ends_unless_forced(data: Path, tmp_path: Path, force: bool) -> None:
    [udp] = free_ports(1, socket.SOCK_DGRAM)
    [tcp] = free_ports(1)
    said = tmp_path / "said"
    command = [*FAUIO, "run", QUAD, "--mavlink", f"udpin:127.0.0.1:{udp}", "--listen", f"tcp/127.0.0.1:{tcp}"]
    with said.open("wb") as log:
        process = subprocess.Popen([*command, *(["--force"] if force else [])], stderr=log, env=ENVIRONMENT)
    with process, Flight(data / "plane_healthy.tlog.xz", [udp], 0.0):
        if force:
            until(lambda: MISMATCH in said.read_text(), 0.05)
            process.terminate()
        assert process.wait(PATIENCE_S) == (0 if force else 2)
    refusal = f"fauio: {MISMATCH}; take its own profile, or go on with --force"
    assert (refusal in said.read_text().splitlines()) is not force
