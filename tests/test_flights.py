"""Recorded autopilot flights: fitted on healthy ones, the monitor names the right motor and how much it lost.

The faults' times and sizes are those that the simulator injected; see tests/data/README.md.
"""

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest

import fauio
from adapters.logs.recordings import read_batches, read_recording
from gains.plants.model_file import read_model
from monitor.profile import Profile
from replay.player import Replay, play_batches

ONSET_S = 112.704
FLIGHTS = {"copter_motor3_090": ("motor3", 0.10), "copter_motor2_080": ("motor2", 0.20)}


def replayed(profile: Profile, path: Path) -> Replay:
    return play_batches(profile, read_batches(path), keep_traces=True)


@pytest.fixture(scope="module")
def flown(quad_profile: Profile, data: Path) -> dict[str, Replay]:
    return {name: replayed(quad_profile, data / f"{name}.tlog.xz") for name in FLIGHTS}


@pytest.mark.parametrize("name", FLIGHTS)
def test_the_right_motor_and_only_it_is_named_within_half_a_second(name: str, flown: dict[str, Replay]) -> None:
    motor, _ = FLIGHTS[name]
    events = flown[name].events
    assert {event.channel for event in events} == {motor}
    raised = [event for event in events if event.state == "raised"]
    assert len(raised) == 1
    assert 0.0 < raised[0].vehicle_time_ms / 1000 - ONSET_S < 0.5
    assert raised[0].message.startswith(f"{motor} delivers ")


@pytest.mark.parametrize("name", FLIGHTS)
def test_the_loss_is_within_two_points_of_the_truth(name: str, flown: dict[str, Replay]) -> None:
    motor, loss = FLIGHTS[name]
    trace = flown[name].traces[0]
    index = trace.layout.faults.index(motor)
    during = trace.vehicle_ns / 1e9 > ONSET_S + 0.5
    relative = trace.isolated[during, index] / trace.u[during, index]
    assert np.mean(relative) == pytest.approx(-loss, abs=0.02)


@pytest.mark.parametrize("name", ["copter_wind_step", "copter_healthy_vel_gusty"])
def test_wind_is_no_fault_and_no_impostor(name: str, quad_profile: Profile, data: Path) -> None:
    found = replayed(quad_profile, data / f"{name}.tlog.xz")
    assert found.events == ()
    assert found.evidence > 1000


def test_the_fit_reports_what_it_learned(quad_folder: Path) -> None:
    report = json.loads((quad_folder / "fit.json").read_text())["observers"]["motors"]
    assert report["motors"] == ["motor1", "motor2", "motor3", "motor4"]
    assert report["rate_hz"] == 100.0
    assert max(report["axis_relative_error"].values()) < 0.05
    hover = report["hover_command"]
    assert max(report["alarms"][motor]["threshold"] / hover[motor] for motor in report["motors"]) < 0.05
    assert report["alarms"]["motor1"]["level_low"] <= report["alarms"]["motor1"]["level_high"]


def test_the_fit_says_what_it_is_worth_on_flight_it_has_not_seen(quad_folder: Path) -> None:
    report = json.loads((quad_folder / "fit.json").read_text())["observers"]["motors"]
    explained = report["validation"]["explained"]
    assert set(explained) == {"one step ahead", "0.2 s ahead"}
    assert all(0.9 < share < 1.0 for shares in explained.values() for share in shares.values())
    assert set(report["validation"]["residual"]) == {"roll_rate", "pitch_rate", "yaw_rate"}
    text = (quad_folder / "fit.txt").read_text()
    assert "on data kept back" in text
    assert all(found["note"] in text for found in report["validation"]["residual"].values())


def test_the_uncertainty_of_the_motors_is_reported_and_designed_for(quad_folder: Path) -> None:
    report = json.loads((quad_folder / "fit.json").read_text())["observers"]["motors"]
    assert all(0.001 < report["effectiveness_relative_error"][motor] < 0.05 for motor in report["motors"])
    plant = read_model(quad_folder / "motors.model.toml")
    rates = zip(plant.disturbances[:3], plant.noises[:3], strict=True)
    assert all(1.0 < disturbance.scale / noise.scale < 1.5 for disturbance, noise in rates)


def test_what_the_fit_says_will_be_detected_is_seen_in_a_flight_with_the_fault(
    quad_folder: Path, flown: dict[str, Replay]
) -> None:
    report = json.loads((quad_folder / "fit.json").read_text())["observers"]["motors"]["capability"]
    alarms = tomllib.loads((quad_folder / "profile.toml").read_text())["observers"]["motors"]["alarms"]
    assert alarms["motor2"]["sees"] in report["motor2"]["text"]
    _, loss = FLIGHTS["copter_motor2_080"]
    within = [limit for limit, size in report["motor2"]["smallest"] if size is not None and size <= loss]
    assert flown["copter_motor2_080"].events[0].vehicle_time_ms / 1000 - ONSET_S < min(within)


def test_a_log_without_motor_commands_is_refused_with_what_is_missing(
    tmp_path: Path, data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from adapters.logs.mcap_log import MessageLogWriter

    path = tmp_path / "poor.mcap"
    with MessageLogWriter(path) as writer:
        for message in read_recording(data / "copter_wind_step.tlog.xz", {"ATTITUDE", "HIGHRES_IMU"}):
            writer.write(message)
    assert fauio.main(["fit", "--vehicle", "multirotor", str(path), "-o", str(tmp_path / "p")]) == 2
    said = capsys.readouterr().err
    assert "SERVO_OUTPUT_RAW" in said
    assert said.count("\n") == 1


def test_too_short_a_flight_is_refused(tmp_path: Path, data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = str(data / "copter_wind_step.tlog.xz")
    assert fauio.main(["fit", "--vehicle", "multirotor", log, "-o", str(tmp_path / "p")]) == 2
    assert "healthy flight" in capsys.readouterr().err


def test_replay_writes_alarms_that_a_program_can_read(quad_folder: Path, tmp_path: Path, data: Path) -> None:
    out = tmp_path / "alarms.jsonl"
    log = str(data / "copter_motor3_090.tlog.xz")
    assert fauio.main(["replay", str(quad_folder), log, "--alarms", str(out), "--fail-on-alarm"]) == 4
    events = [json.loads(line) for line in out.read_text().splitlines()]
    assert events[0]["state"] == "raised"
    assert events[0]["channel"] == "motor3"
    assert events[0]["relative"] == pytest.approx(-0.10, abs=0.05)  # told by the first samples
    assert events[1]["state"] == "updated"
    assert events[1]["vehicle_time_ms"] - events[0]["vehicle_time_ms"] < 1100
    assert {event["state"] for event in events[2:]} <= {"updated"}
    for event in events:
        command = event["estimate"] / event["relative"]
        assert event["estimate"] == pytest.approx(-0.10 * command, abs=2.0 * event["sd"])
    assert all(event["relative"] == pytest.approx(-0.10, abs=0.01) for event in events[1:])


def test_a_converted_log_replays_to_the_same_events(
    quad_profile: Profile, tmp_path: Path, data: Path, flown: dict[str, Replay]
) -> None:
    source, target = data / "copter_motor2_080.tlog.xz", tmp_path / "flight.mcap"
    assert fauio.main(["convert", str(source), "-o", str(target)]) == 0
    assert replayed(quad_profile, target).events == flown["copter_motor2_080"].events


def test_a_recorded_replay_replays_to_the_same_bits(quad_profile: Profile, tmp_path: Path, data: Path) -> None:
    record = tmp_path / "out.mcap"
    first = play_batches(
        quad_profile, read_batches(data / "copter_motor3_090.tlog.xz"), record=record, keep_traces=True
    )
    second = replayed(quad_profile, record)
    assert second.events == first.events
    for name in ("vehicle_ns", "unix_ns", "u", "y", "x", "fault", "isolated", "residual", "armed"):
        assert np.array_equal(getattr(first.traces[0], name), getattr(second.traces[0], name)), name


def test_other_vehicles_in_a_log_do_not_enter_the_fit(data: Path) -> None:
    from monitor.fitting.survey import of_one_vehicle

    flight = list(read_batches(data / "copter_5s.tlog.xz"))
    assert {columns.system for batch in flight for columns in batch.columns} > {1}
    assert {columns.system for batch in of_one_vehicle(flight) for columns in batch.columns} == {1}


@pytest.mark.parametrize(
    ("name", "channel", "onset_s", "within_s", "size"),
    [
        ("copter_gps_drift05", "gps_north", 102.774, 0.5, 0.5),
        ("copter_gps_step25m", "gps_north", 112.754, 0.5, 25.0),
        ("copter_baro_glitch", "baro", 112.764, 0.5, 8.0),
    ],
)
def test_a_sensor_that_disagrees_is_named_with_its_size_and_no_other(
    quad_profile: Profile, data: Path, name: str, channel: str, onset_s: float, within_s: float, size: float
) -> None:
    found = play_batches(quad_profile, read_batches(data / f"{name}.tlog.xz"), keep_traces=True)
    assert {event.channel for event in found.events} == {channel}
    raised = found.events[0]
    # The first fix that is wrong is enough, and the truth is known to 20 ms.
    assert -0.02 < raised.vehicle_time_ms / 1000 - onset_s < within_s
    (trace,) = (trace for trace in found.traces if trace.layout.observer == "inertial")
    since = trace.vehicle_ns / 1e9 - onset_s
    truth = size * since if name == "copter_gps_drift05" else np.full(len(since), size)
    late = since > 2.0
    estimate = trace.isolated[:, trace.layout.faults.index(channel)]
    assert estimate[late] == pytest.approx(truth[late], rel=0.2)


def test_a_gyro_that_jumps_is_not_taken_for_a_motor_or_the_gps(quad_profile: Profile, data: Path) -> None:
    events = replayed(quad_profile, data / "copter_gyro1_bias.tlog.xz").events
    assert {event.channel for event in events} <= {"gyro_x"}


def test_a_log_without_a_gps_says_which_observer_saw_nothing(
    quad_folder: Path, data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert fauio.main(["replay", str(quad_folder), str(data / "copter_wind_step.tlog.xz")]) == 0
    assert "s of watched flight; inertial saw nothing (no GPS_RAW_INT)" in capsys.readouterr().out
