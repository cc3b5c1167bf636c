"""The measurement of detection: truth read from flights' JSON, accounting of alarms, and one flight end to end."""

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "bench"))
from accounting import (
    Found,
    Result,
    Spell,
    announced,
    at_equal_rate,
    before_any_fault,
    false_alarms,
    reading,
    verdict,
    watched_s,
)
from detection import fits_of, try_on
from detection_page import page
from detection_plot import draw
from detectors import DETECTORS, FAUIO, KALMAN_BANK, make_suite
from flights import Flight, Truth, expected_channels, flight, is_disturbance
from limit import tilt_limit

ON, OFF = 112_704, 118_000
LOSS = {"kind": "actuator_effectiveness_loss", "target": "motor/servo [3]", "magnitude": 0.9}


def entry(**changes: Any) -> dict[str, Any]:
    faults = [{**LOSS, "on": {"time_boot_ms": ON}, "off": {"time_boot_ms": OFF}}]
    base = {"vehicle": "copter", "model": "quad", "healthy": False, "faults": faults, "statustext": []}
    return {**base, **changes}


def described(name: str = "copter_motor3_090", log: Path = Path("none.tlog"), **changes: Any) -> Flight:
    return flight(entry(**changes), name, log)


@pytest.mark.parametrize(
    ("vehicle", "fault", "channels"),
    [
        ("copter", LOSS, {"motor3"}),
        ("copter", {"kind": "actuator_effectiveness_ramp", "target": "motor/servo [1, 4]"}, {"motor1", "motor4"}),
        ("copter", {"kind": "gps_offset_step", "magnitude": "25 m north"}, {"gps_north", "gps_velocity_north"}),
        ("copter", {"kind": "gps_offset_ramp", "magnitude": "1 m/s west"}, {"gps_east", "gps_velocity_east"}),
        ("copter", {"kind": "gps_loss", "magnitude": "no GPS"}, {"blind"}),
        ("copter", {"kind": "baro_step", "magnitude": "+8 m, both barometers"}, {"baro"}),
        ("copter", {"kind": "gyro_bias", "magnitude": "0.08 rad/s roll axis, IMU1 only"}, {"gyro_x"}),
        ("copter", {"kind": "gyro_bias", "magnitude": "0.1 rad/s"}, {"gyro_x", "gyro_y", "gyro_z"}),
        ("plane", {"kind": "actuator_effectiveness_loss", "target": "motor/servo [1]"}, {"aileron"}),
        ("plane", {"kind": "actuator_stuck", "target": "rudder"}, {"rudder"}),
        ("rover", {"kind": "actuator_effectiveness_loss", "target": "motor/servo [1]"}, {"steering"}),
        ("plane", {"kind": "airspeed_blocked", "target": None}, {"airspeed"}),
        ("copter", {"kind": "compass_offset", "magnitude": "30 deg"}, {"compass"}),
        ("copter", {"kind": "battery_sag", "magnitude": "20 %"}, set()),
    ],
)
def test_a_fault_is_expected_on_the_channels_that_its_text_names(
    vehicle: str, fault: dict[str, Any], channels: set[str]
) -> None:
    assert expected_channels(fault, vehicle) == channels


def test_a_note_on_the_servos_counts_more_than_their_usual_functions() -> None:
    fault = {"kind": "actuator_effectiveness_loss", "target": "motor/servo [2]"}
    assert expected_channels(fault, "plane", "SERVO2 rudder: swapped") == {"rudder"}


@pytest.mark.parametrize(
    ("fault", "truth"),
    [
        (LOSS, Truth("motor3", "share", 0.1)),
        ({"kind": "gps_offset_step", "magnitude": "25 m south"}, Truth("gps_north", "m", -25.0)),
        (
            {"kind": "gps_offset_ramp", "magnitude": "0.5 m/s north to 30 m", "ramp_s": 60},
            Truth("gps_north", "m", 30.0, 60.0),
        ),
        ({"kind": "baro_step", "magnitude": "+8 m, both barometers"}, Truth("baro", "m", 8.0)),
        ({"kind": "gyro_bias", "magnitude": "-0.08 rad/s yaw axis"}, Truth("gyro_z", "rad/s", -0.08)),
        ({"kind": "gps_frozen", "magnitude": None}, None),
    ],
)
def test_sizes_are_read_where_they_can_be_compared(fault: dict[str, Any], truth: Truth | None) -> None:
    timed = {**fault, "on": {"time_boot_ms": ON}, "off": {"time_boot_ms": OFF}}
    (found,) = described(faults=[timed]).faults
    if truth is None:
        assert found.truth is None
    else:
        assert found.truth == replace(truth, size=pytest.approx(truth.size))


def test_baselines_are_asked_for_more_until_they_raise_no_more_false_alarms_than_the_reference() -> None:
    def found(false: int, rarer: tuple[Found, ...] = ()) -> Found:
        return Found((), (), (), tuple(Spell("motor1", at, None) for at in range(false)), rarer)

    seen = {"ours": found(1), "theirs": found(9, (found(4), found(1), found(0)))}
    unseen = Result(described("a"), ("b",), frozenset(), 60.0, seen, ())
    (result,) = at_equal_rate([unseen], "ours")
    assert len(result.found["theirs"].false) == 1
    assert result.found["ours"] == seen["ours"]


def test_a_fading_motor_loses_in_proportion_to_time() -> None:
    truth = Truth("motor2", "share", 0.3, 60.0)
    np.testing.assert_allclose(truth.after(np.array([0.0, 30.0, 90.0])), [0.0, 0.15, 0.3])


def test_a_gust_is_no_fault_and_its_flight_is_not_fitted_on() -> None:
    gust = {"kind": "disturbance_wind_step", "on": {"time_boot_ms": ON}, "off": {"time_boot_ms": OFF}}
    assert is_disturbance(gust)
    windy = described("copter_wind_step", healthy=True, faults=[gust])
    assert windy.faults == ()
    assert not windy.healthy


def test_flights_share_a_profile_with_those_of_their_vehicle_frame_and_noise(tmp_path: Path) -> None:
    flights = [
        described("a", healthy=True, faults=[]),
        described("b", healthy=True, faults=[]),
        described("copter_noisy_c", healthy=True, faults=[]),
        described("d", model="hexa"),
        described("e"),
    ]
    fits, notes = fits_of(flights, tmp_path)
    made = {(tuple(f.name for f in fit.healthy), tuple(f.name for f in fit.tried_on)) for fit in fits}
    assert made == {(("a", "b"), ("a", "b", "e")), (("b",), ("a",)), (("a",), ("b",)), (("copter_noisy_c",),) * 2}
    assert notes == ["copter hexa: no healthy flight to fit on (1 flights left out)"]


def test_the_first_alarm_of_the_right_channel_counts_and_others_are_told() -> None:
    found = described()
    alarms = [
        Spell("motor3", ON - 500, ON - 100),
        Spell("motor1", ON + 150, ON + 900),
        Spell("motor3", ON + 250, OFF + 700),
    ]
    seen = verdict(found.faults[0], found, alarms)
    assert seen.delay_s == pytest.approx(0.25)
    assert seen.first_s == pytest.approx(0.15)
    assert seen.others == ("motor1",)
    assert seen.isolated is False
    assert seen.cleared_s == pytest.approx(0.7)
    assert false_alarms(found, alarms) == alarms[:1]


def test_a_wrong_name_is_a_miss_and_what_comes_after_the_end_is_late() -> None:
    found = described()
    seen = verdict(found.faults[0], found, [Spell("motor1", ON + 200, None), Spell("motor3", OFF + 100, None)])
    assert seen.delay_s is None
    assert seen.first_s == pytest.approx(0.2)
    assert seen.cleared_s == np.inf


def test_of_an_unknown_fault_or_a_detector_without_names_any_alarm_will_do() -> None:
    fault = {"kind": "battery_sag", "on": {"time_boot_ms": ON}, "off": {"time_boot_ms": OFF}}
    unknown, known = described(faults=[fault]), described()
    alarms = [Spell("unexplained", ON + 400, ON + 800)]
    for seen in (verdict(unknown.faults[0], unknown, alarms), verdict(known.faults[0], known, alarms, names=False)):
        assert seen.delay_s == pytest.approx(0.4)
        assert seen.isolated is None
        assert seen.others == ()


def test_only_evidence_outside_the_fault_and_its_aftermath_is_watched_for_false_alarms() -> None:
    time_ms = np.arange(ON - 10_000, OFF + 15_000, 10)
    armed = time_ms >= ON - 8_000
    assert watched_s(described(), time_ms, armed, 100.0) == pytest.approx(8.0 + 10.0, abs=0.02)


def test_the_autopilot_is_heard_from_warnings_up_between_takeoff_and_touchdown() -> None:
    def said(ms: int, severity: int, text: str) -> dict[str, Any]:
        return {"time_boot_ms": ms, "severity": severity, "text": text}

    texts = [
        said(40_000, 2, "before take-off"),
        said(ON - 3_000, 4, "early"),
        said(ON + 100, 6, "not loud"),
        said(ON + 260, 2, "EKF3 lane switch 1"),
        said(ON + 900, 2, "Glitch cleared"),
        said(ON + 10, 2, "Injected: gps stuck, all instances"),
        said(260_000, 2, "on the ground"),
    ]
    found = described(
        statustext=texts, t0_takeoff={"time_boot_ms": 52_000}, touchdown={"time_boot_ms": 250_000, "text": ""}
    )
    alarms = announced(found.said)
    seen = verdict(found.faults[0], found, alarms, names=False)
    assert seen.delay_s == pytest.approx(0.26)
    assert seen.named == ("EKF3 lane switch 1",)
    assert [spell.channel for spell in before_any_fault(found, alarms)] == ["early"]


def test_an_estimate_is_compared_while_its_fault_is_on() -> None:
    (fault,) = described().faults
    time_ms = np.arange(ON - 2_000, OFF + 2_000, 10)
    estimate = np.where((time_ms > ON + 1_000) & (time_ms < OFF), 0.11, 7.0)
    found = reading(fault, time_ms, estimate, np.ones(len(time_ms), np.bool_))
    assert found is not None
    assert (found.estimate, found.truth, found.rmse) == pytest.approx((0.11, 0.10, 0.01))
    assert reading(fault, time_ms, estimate, np.ones(len(time_ms), np.bool_), Spell("motor3", OFF - 900, OFF)) is None


def test_the_larger_a_gyros_bias_the_sooner_its_tilt_tells_it() -> None:
    assert tilt_limit(0.16) == pytest.approx(0.8)
    assert tilt_limit(0.02) == pytest.approx(2.2)
    assert tilt_limit(0.001) is None


@pytest.mark.long
def test_all_detectors_are_measured_on_a_flight_and_make_a_page(quad_folder: Path, data: Path, tmp_path: Path) -> None:
    healthy = [described(name, data / f"{name}.tlog.xz", healthy=True, faults=[]) for name in HEALTHY]
    suite = make_suite(quad_folder, [healthy[0].messages])
    assert suite.notes == ()
    result = try_on(suite, described(log=data / "copter_motor3_090.tlog.xz"), HEALTHY)
    for name in (FAUIO, KALMAN_BANK):
        (seen,) = result.found[name].verdicts
        assert seen.isolated is True
        assert seen.delay_s is not None
        assert seen.delay_s < 0.5
        (whole,) = result.found[name].whole
        assert whole is not None
        assert whole.estimate == pytest.approx(0.10, abs=0.02)
    (autopilot,) = result.found["autopilot"].verdicts
    assert autopilot.delay_s is None
    columns = ("autopilot", *DETECTORS)
    text = page([result], columns, ["a note"])
    assert "- a note" in text
    (limit,) = result.limits_s
    assert limit is not None
    assert 0.0 < limit < 0.1
    lost = "| copter_motor3_090 | actuator_effectiveness_loss motor/servo [3] 0.9 | motor3"
    assert f"{lost} | {limit:.2f} s | MISSED | 0." in text
    draw([result], columns, tmp_path / "picture.png")
    assert (tmp_path / "picture.png").stat().st_size > 10_000


HEALTHY = ("copter_healthy_square", "copter_healthy_vel_gusty")
