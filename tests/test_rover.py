"""Recorded drives: fitted on a healthy one, the monitor sees steering that turns half as commanded, and its end.

The fault's times and size are those that the simulator injected; see tests/data/README.md.
"""

import json
from pathlib import Path

import pytest
from conftest import plain_fits

import fauio
from adapters.logs.mcap_log import MessageLogWriter
from adapters.logs.recordings import read_batches, read_recording
from monitor.event import AlarmEvent
from monitor.profile import Profile, read_profile
from replay.player import play_batches

ONSET_S, END_S = 102.066, 152.056


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, data: Path) -> Path:
    """Fit a profile with the command a user types."""
    folder = tmp_path_factory.mktemp("fit") / "rover"
    log = str(data / "rover_healthy_manual.tlog.xz")
    with plain_fits():
        assert fauio.main(["fit", "--vehicle", "rover", log, "-o", str(folder)]) == 0
    return folder


@pytest.fixture(scope="module")
def profile(folder: Path) -> Profile:
    return read_profile(folder)


def events(profile: Profile, path: Path) -> tuple[AlarmEvent, ...]:
    return play_batches(profile, read_batches(path)).events


def test_weak_steering_is_seen_in_the_turn_it_begins_in(profile: Profile, data: Path) -> None:
    found = events(profile, data / "rover_steering_050.tlog.xz")
    assert {event.channel for event in found} == {"steering"}
    raised = [event for event in found if event.state == "raised"]
    assert 0.0 < raised[0].vehicle_time_ms / 1000 - ONSET_S < 0.2
    assert any(
        event.message.startswith("steering turns ") and "less than commanded" in event.message for event in found
    )
    assert next(event.relative for event in found if event.relative) == pytest.approx(-0.5, abs=0.05)


def test_its_end_clears_the_alarm(profile: Profile, data: Path) -> None:
    found = events(profile, data / "rover_steering_050_end.tlog.xz")
    assert [event.state for event in found if event.state != "updated"] == ["raised", "cleared"]
    assert found[0].relative == pytest.approx(-0.5, abs=0.05)
    assert 0.0 < found[-1].vehicle_time_ms / 1000 - END_S < 5.0


@pytest.mark.parametrize("name", ["rover_healthy", "rover_healthy_manual"])
def test_healthy_drives_raise_no_alarm(name: str, profile: Profile, data: Path) -> None:
    found = play_batches(profile, read_batches(data / f"{name}.tlog.xz"))
    assert found.events == ()
    assert found.evidence > 1000


def test_a_profile_holds_how_estimates_are_read(folder: Path, profile: Profile) -> None:
    observer = profile.observers[0]
    assert (profile.vehicle, observer.name, observer.rate_hz) == ("rover", "drive", 50.0)
    assert not profile.gate.require_airborne
    assert set(observer.effectiveness) == {"steering", "throttle"}
    assert (observer.effectiveness["steering"].full, observer.effectiveness["throttle"].full) == ("speed", None)
    assert max(observer.effectiveness["steering"].misfit, observer.effectiveness["throttle"].misfit) > 1.0
    assert set(observer.reached) <= {*observer.gains[0].inputs, *observer.gains[0].outputs}
    assert any("steering" in rule.channels and "gyro_z" in rule.by for rule in profile.excuses)
    compass = next(rule for rule in profile.observers[1].alarms if rule.channel == "compass")
    assert compass.slow >= compass.threshold  # an attitude that is wrong turns the heading by half of it
    rule = observer.effectiveness["steering"]
    sees = f"steering alarm from {100 * rule.certainty * rule.loss_doubt:.0f} % loss"  # of which the model may be wrong
    assert sees in (folder / "fit.txt").read_text()
    report = json.loads((folder / "fit.json").read_text())["observers"]["drive"]
    assert report["watched"] == ["steering", "throttle"]
    assert report["axes"]["yaw_rate"]["explained"] > 0.99


def test_a_drive_without_steering_is_refused_with_what_to_drive(
    tmp_path: Path, data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "straight.mcap"
    with MessageLogWriter(path) as writer:
        for message in read_recording(data / "rover_healthy.tlog.xz"):
            if message.name == "SERVO_OUTPUT_RAW":
                message.fields.update(servo1_raw=1500, servo3_raw=1500)  # type: ignore[attr-defined]
            writer.write(message)
    assert fauio.main(["fit", "--vehicle", "rover", str(path), "-o", str(tmp_path / "p")]) == 2
    said = capsys.readouterr().err
    assert "steering" in said
    assert "slalom" in said
    assert said.count("\n") == 1


def test_a_drive_without_velocity_is_refused_with_what_to_record(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = str(data / "copter_wind_step.tlog.xz")
    assert fauio.main(["fit", "--vehicle", "rover", log, "-o", str(tmp_path / "p"), "--force"]) == 2
    assert "LOCAL_POSITION_NED" in capsys.readouterr().err
