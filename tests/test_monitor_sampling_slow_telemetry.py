"""Telemetry that comes too seldom is told: by the fit, by info, by what a replay could not check."""

import json
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest

import fauio
from adapters.channels import Channel
from adapters.logs.mcap_log import MessageLogWriter
from adapters.logs.recordings import read_recording
from monitor.profile import Profile, read_profile
from monitor.sampling.slow_telemetry import SELDOM, motor_gain, slow_messages, slow_text, slowest_text, spanned
from replay.inspection.log_info import log_info

FAST = ("ATTITUDE", "HIGHRES_IMU", "SERVO_OUTPUT_RAW")


def thinned(folder: Path, flight: Path, every: int) -> Path:
    """Return a flight with one in so many of its frequent messages."""
    path, seen = folder / "slow.mcap", Counter[str]()
    with MessageLogWriter(path) as writer:
        for message in read_recording(flight):
            seen[message.name] += 1
            if message.name not in FAST or seen[message.name] % every == 0:
                writer.write(message)
    return path


@pytest.fixture(scope="module")
def slow_log(tmp_path_factory: pytest.TempPathFactory, data: Path) -> Path:
    return thinned(tmp_path_factory.mktemp("slow"), data / "copter_healthy_square.tlog.xz", 10)


def test_slow_messages_are_those_far_below_what_is_wanted_and_not_slow_by_nature() -> None:
    rates = {"ATTITUDE": 4.0, "HIGHRES_IMU": 45.0, "GPS_RAW_INT": 5.0, "VIBRATION": 10.0}
    channels = [Channel("x", name, ("x",)) for name in rates]
    assert slow_messages([rates, rates | {"ATTITUDE": 50.0}], channels, 50.0) == {"ATTITUDE": 4.0}


def test_topics_with_positions_are_slow_by_nature_whatever_they_are_called() -> None:
    channels = [Channel("lat", "gps/fix", ("latitude",)), Channel("xacc", "imu", ("linear_acceleration", "x"))]
    assert slow_messages([{"gps/fix": 5.0, "imu": 10.0}], channels, 25.0) == {"imu": 10.0}


def test_advice_of_more_telemetry_has_its_gain_in_figures() -> None:
    slow = {"SERVO_OUTPUT_RAW": 10.0}
    assert motor_gain(10.0) in slow_text(slow, 50.0, onboard=False, commands_hz=10.0)
    assert "instead of 5 to 15 % within 10 to 20 s" in motor_gain(1.0)
    assert "motor" not in slow_text({"HIGHRES_IMU": 10.0}, 25.0, onboard=False)


@pytest.mark.long
def test_a_fit_on_slow_telemetry_says_in_one_line_what_is_needed(
    slow_log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "quad"
    assert fauio.main(["fit", "--vehicle", "multirotor", str(slow_log), "-o", str(folder)]) == 0
    captured = capsys.readouterr()
    [line] = [line for line in captured.err.splitlines() if "slow telemetry" in line]
    assert line.startswith(
        "fauio: slow telemetry: ATTITUDE 10 Hz, HIGHRES_IMU 10 Hz, SERVO_OUTPUT_RAW 10 Hz; 50 Hz or more show faults"
    )
    assert line.removeprefix("fauio: ") in (folder / "fit.txt").read_text()
    warnings = json.loads((folder / "fit.json").read_text())["warnings"]
    assert [one for one in warnings if "slow telemetry" in one] == [line.removeprefix("fauio: ")]
    assert "slow telemetry" not in captured.out


def test_a_log_that_is_far_slower_than_the_others_is_named() -> None:
    logs = [(name, dict.fromkeys(FAST, 10.0)) for name in ("monday", "tuesday")]
    assert slowest_text(logs, FAST) is None
    assert slowest_text([("radio", {FAST[0]: 4.0, FAST[1]: 2.0, FAST[2]: 2.5}), *logs], FAST) == (
        "all logs are fitted at the rates of the slowest; without it faults show sooner: "
        f"radio ({FAST[1]} 2 Hz, others 10 Hz)"
    )


def test_a_fit_on_fast_telemetry_says_nothing_of_it(quad_folder: Path) -> None:
    assert "slow telemetry" not in (quad_folder / "fit.txt").read_text()
    assert "warnings" not in json.loads((quad_folder / "fit.json").read_text())


def test_info_names_the_messages_that_come_too_seldom(slow_log: Path, data: Path) -> None:
    vehicle = log_info(slow_log)["vehicle"]
    assert "ATTITUDE at 50 Hz: it comes at 10 Hz" in vehicle["fits"]["multirotor"]["missing"]
    assert "ATTITUDE at 25 Hz: it comes at 10 Hz" in vehicle["fits"]["inertial"]["missing"]
    whole = log_info(data / "copter_healthy_square.tlog.xz")["vehicle"]["fits"]
    assert whole["multirotor"]["missing"] == whole["inertial"]["missing"] == []


@pytest.mark.long
def test_at_one_sample_a_second_info_says_so_and_position_is_watched(data: Path, tmp_path: Path) -> None:
    log = thinned(tmp_path, data / "copter_healthy_square.tlog.xz", 100)
    missing = log_info(log)["vehicle"]["fits"]["inertial"]["missing"]
    assert "HIGHRES_IMU at 25 Hz: it comes at 1 Hz" in missing
    assert [lack for lack in missing if "no HIGHRES_IMU" in lack and lack.endswith("of 10 Hz or more")]
    assert fauio.main(["fit", "--vehicle", "inertial", str(log), "-o", str(tmp_path / "quad")]) == 0
    watched = {alarm.channel for alarm in read_profile(tmp_path / "quad").observers[0].alarms}
    assert {"gps_north", "gps_east", "baro"} <= watched
    assert "accel_x" not in watched


def test_an_observer_names_messages_between_which_it_takes_many_samples(quad_profile: Profile) -> None:
    motors, _, inertial = (observer.source for observer in quad_profile.observers)
    rates = dict.fromkeys((*FAST, *SELDOM), 4.0)
    assert spanned(motors, 100.0, rates) == dict.fromkeys(FAST, 25.0)
    assert set(spanned(inertial, 25.0, rates)) == {"ATTITUDE", "HIGHRES_IMU"}
    assert spanned(motors, 100.0, dict.fromkeys(FAST, 50.0)) == {}


def test_a_command_that_holds_until_the_next_one_may_come_seldom(quad_profile: Profile) -> None:
    source = quad_profile.observers[0].source
    held = tuple(replace(channel, interpolation="previous") for channel in source.inputs)
    found = spanned(replace(source, inputs=held, fitted_hz={}), 100.0, dict.fromkeys(FAST, 4.0))
    assert set(found) == {channel.message for channel in source.outputs}


def test_a_replay_of_a_log_far_slower_than_the_profile_says_so(
    slow_log: Path, quad_folder: Path, data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert fauio.main(["replay", str(quad_folder), str(slow_log)]) == 0
    said = capsys.readouterr().out
    assert "; motors watches nothing: ATTITUDE 10 Hz, fitted at 100 Hz, " in said
    assert "is not watched: motors: " in said
    assert "delivers" not in said
    assert fauio.main(["replay", str(quad_folder), str(data / "copter_wind_step.tlog.xz")]) == 0
    assert "watches nothing" not in capsys.readouterr().out
