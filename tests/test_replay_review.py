"""A review names what a log shows, in the order it happened, and nothing of what only looks like it."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from dataflash_writer import DataflashWriter
from review_logs import (
    DISARM_S,
    HOVER,
    LANDING_S,
    TAKEOFF_S,
    Flight,
    ardupilot_log,
    px4_log,
    telemetry,
    usual_height,
    usual_motors,
)
from synthetic_run import START_NS, event

import fauio
from adapters.logs.tlog import TlogReader
from adapters.mavlink.mavlink_message import message_number
from monitor.alarms.command_watch import CommandSent
from replay.player import Replay
from replay.review import learning
from replay.review.facts.log_facts import LearnedAlarm, LearnedWatch, LogFacts, LogSignal, flown
from replay.review.findings.loss_of_control import tumbles
from replay.review.review import LogReview, judged, review_log
from replay.review.rules import RULES

FALLS_S = 30.0
DATA = Path(__file__).parent / "data"


def fallen(at: float) -> float:
    """Return the height of a flight whose motors stop at a time."""
    height = usual_height(min(at, FALLS_S))
    return max(height - 4.9 * max(at - FALLS_S, 0.0) ** 2, 0.0)


def stopped(at: float) -> list[float]:
    return usual_motors(at) if at < FALLS_S else [0.0] * 4


def one_motor(number: int, share: float, start: float, end: float) -> Callable[[float], list[float]]:
    """Return commands of which one is another for a while."""

    def motors(at: float) -> list[float]:
        commands = usual_motors(at)
        if start <= at < end:
            commands[number - 1] = share
        return commands

    return motors


def speeds(number: int = 0, start: float = 30.0, end: float = 33.0) -> Callable[[float], list[float]]:
    """Return speeds as commanded, of which one is nearly none for a while."""

    def rpm(at: float) -> list[float]:
        turns = [8000.0 if turning(at) else 0.0 for _ in range(4)]
        if number and start <= at < end:
            turns[number - 1] = 300.0
        return turns

    return rpm


def turning(at: float) -> bool:
    return usual_motors(at)[0] > 0


def yawing(at: float) -> list[float]:
    """Return commands of two motors that go up while those of the others go down, and back again."""
    more = 0.36 * ((30.0 <= at < 32.0) - 1.0 * (35.0 <= at < 37.0))
    return [share and share + sign * more for share, sign in zip(usual_motors(at), (1, 1, -1, -1), strict=True)]


def between(start: float, end: float, inside: float, outside: float) -> Callable[[float], float]:
    return lambda at: inside if start <= at < end else outside


LANDED_THERE = Flight(height=fallen, motors=stopped, landed=lambda at: not 3.0 <= at < FALLS_S - 0.1)
CASES: dict[str, Flight] = {
    "motors_stopped_in_air": Flight(height=fallen, motors=stopped, killed=lambda at: at >= FALLS_S - 0.1),
    "motor_command_stopped": Flight(
        motors=one_motor(2, 0.0, 30.0, 33.0), yaw_deg=lambda at: 50.0 * min(max(at - 30.0, 0.0), 3.0)
    ),
    "motor_at_limit": Flight(motors=one_motor(3, 0.95, 30.0, 32.0)),
    "esc_stopped": Flight(rpm=speeds(4)),
    "battery_low": Flight(volts=lambda at: 15.4 - 0.07 * at),
    "gps_stuck": Flight(north_m=lambda at: 2.0 * (30.0 if 30.0 <= at < 33.0 else at)),
    "gps_lost": Flight(fix=lambda at: 0 if 30.0 <= at < 35.0 else 3),
    "innovations_refused": Flight(ratio=between(30.0, 33.0, 1.8, 0.1)),
    "estimator_reset": Flight(resets=lambda at: 1 + (at > 30.0)),
    "vibration": Flight(vibration=lambda at: 25.0 if turning(at) else 0.5, clipped=lambda at: int(10 * at)),
    "failsafe": Flight(failsafe=lambda at: 30.0 <= at < 40.0),
    "commands_from_outside": Flight(commands=[(1.0, 190, 400, 1.0), (30.0, 77, 176, 1.0)]),
    "descent_not_followed": Flight(
        climb_wanted=between(30.0, 38.0, -1.5, 0.0),
        height=lambda at: usual_height(at) + 0.6 * min(max(at - 30.0, 0.0), 8.0),
        motors=lambda at: [0.10, 0.14, 0.13, 0.11] if 30.0 <= at < 38.0 else usual_motors(at),
    ),
    "attitude_not_followed": Flight(tilt_deg=between(30.0, 32.0, 50.0, 0.0)),
    "turned_over": Flight(tilt_deg=between(30.0, 32.0, 150.0, 0.0)),
}
SHOWN_APART = {"log_ends_in_flight", "position_altered", "attitude_contradicted"}
"""Findings whose flights take more than a PX4 log of the usual records: each has a test of its own."""
LOOK_ALIKES: dict[str, Flight] = {
    "a plain flight": Flight(rpm=speeds()),
    "a landing on a roof": Flight(
        height=lambda at: usual_height(min(at, 40.0)),
        motors=lambda at: usual_motors(at) if at < 42.0 else [0.0] * 4,
        landed=lambda at: not TAKEOFF_S <= at < 41.9,
    ),
    "a saturated mixer": Flight(motors=one_motor(1, 0.0, 30.0, 30.5)),
    "a hard climb": Flight(motors=lambda at: [1.0 if 30.0 <= at < 33.0 else share for share in usual_motors(at)]),
    "a dash at full tilt": Flight(
        motors=one_motor(4, 1.0, 30.5, 33.0),
        tilt_deg=between(30.2, 33.2, 29.0, 0.0),
        tilt_wanted_deg=between(30.0, 33.0, 29.0, 0.0),
    ),
    "a flight against the wind at the greatest tilt that the autopilot wants": Flight(
        motors=one_motor(4, 1.0, 30.5, 33.0),
        tilt_deg=between(30.2, 33.2, 20.0, 0.0),
        tilt_wanted_deg=between(30.0, 33.0, 20.0, 0.0),
        parameters={"MPC_TILTMAX_AIR": 20.0},
    ),
    "a dash at little tilt": Flight(motors=one_motor(4, 1.0, 30.5, 33.0), north_m=lambda at: 20.0 * at),
    "a vehicle that leans against a wall": Flight(
        motors=lambda at: [0.36, 0.34, 0.95, 0.80] if 30.0 <= at < 41.0 else usual_motors(at)
    ),
    "a motor at its end in a spin": Flight(
        motors=one_motor(4, 1.0, 30.5, 33.0), yaw_deg=lambda at: 200.0 * min(max(at - 30.0, 0.0), 3.0)
    ),
    "no battery connected": Flight(volts=lambda _: 0.05, connected=False),
    "cells of lithium ion": Flight(
        volts=lambda at: 15.4 - 0.05 * at, parameters={"BAT1_N_CELLS": 4, "BAT1_V_EMPTY": 2.8}
    ),
    "a dip of voltage at full thrust": Flight(volts=between(30.0, 31.5, 12.9, 15.4)),
    "a receiver that nobody uses": Flight(fix=lambda _: 0, gps_used=False),
    "the ground station's own commands": Flight(commands=[(1.0, 190, 400, 1.0), (30.0, 190, 176, 1.0)]),
    "a request from elsewhere": Flight(commands=[(1.0, 190, 400, 1.0), (30.0, 77, 512, 1.0)]),
    "a disarming on the ground": Flight(commands=[(1.0, 190, 400, 1.0), (56.0, 77, 400, 0.0)]),
    "a receiver that holds its position while a vehicle hovers": Flight(
        north_m=lambda at: 2.0 * min(at, 30.0) + 2.0 * max(at - 40.0, 0.0)
    ),
    "a receiver that has its first fix in flight": Flight(fix=lambda at: 0 if at < 30.0 else 3),
    "one innovation": Flight(ratio=between(30.0, 30.2, 3.0, 0.1)),
    "a reset at take-off": Flight(resets=lambda at: 1 + (at > 4.0)),
    "a blow in the air": Flight(clipped=lambda at: 194 * (at > 30.0)),
    "a hard landing": Flight(vibration=between(LANDING_S - 0.5, LANDING_S + 1.0, 30.0, 2.0)),
    "a failsafe on the ground": Flight(failsafe=lambda at: at > DISARM_S),
    "a barometer that rises as rotors run down on the ground": replace(
        CASES["descent_not_followed"], others=lambda _: {"vehicle_gps_position": {"vel_d_m_s": 0.0}}
    ),
    "somebody who asked for the log before take-off": Flight(commands=[(1.0, 190, 2510, 0.0), (30.0, 77, 176, 1.0)]),
    "an updraft": Flight(
        climb_wanted=between(30.0, 32.0, -1.5, 0.0), height=lambda at: usual_height(at) + min(max(at - 30, 0), 2)
    ),
    "what follows a kill switch near the ground": Flight(
        killed=lambda at: at >= 53.0, resets=lambda at: 1 + (at > 53.5)
    ),
    "a fast turn at full sticks": Flight(
        tilt_wanted_deg=between(30.0, 33.0, 60.0, 0.0), tilt_deg=between(30.3, 33.3, 60.0, 0.0)
    ),
    "turn rates that are wanted in place of an attitude": Flight(
        tilt_deg=between(30.0, 32.0, 50.0, 0.0),
        others=lambda at: {"vehicle_attitude_setpoint": None} if 29.0 <= at < 33.0 else {},
    ),
    "sticks that move on the ground": Flight(
        height=lambda _: 0.2, tilt_wanted_deg=between(30.0, 33.0, 45.0, 0.0), tilt_deg=lambda _: 1.0
    ),
    "a vehicle that the ground holds, and its log does not say so": Flight(
        motors=one_motor(1, 1.0, 30.0, 50.0),
        tilt_wanted_deg=between(30.0, 50.0, 30.0, 0.0),
        ratio=between(35.0, 38.0, 1.8, 0.1),
    ),
    "sticks from one end to the other": Flight(
        tilt_wanted_deg=lambda at: 45.0 if 30.0 <= at < 33.0 and at % 0.8 < 0.4 else 0.0,
        tilt_deg=lambda at: 45.0 if 30.3 <= at < 33.3 and (at - 0.3) % 0.8 < 0.4 else 0.0,
    ),
    "a throttle that was closed in the air": Flight(
        motors=lambda at: [0.1, 0.1, 0.12, 0.1] if 30.0 <= at < 31.0 else usual_motors(at),
        tilt_deg=between(30.2, 31.0, 50.0, 0.0),
    ),
    "motors that run up together": Flight(rpm=lambda at: [8000.0 * turning(at) if at > 5.0 else 300.0] * 4),
    "a large propeller that runs down to idle": Flight(
        rpm=lambda at: [1200.0 if 30.0 <= at < 33.0 else 8000.0 * turning(at), *[8000.0 * turning(at)] * 3],
        motors=one_motor(1, 0.15, 30.0, 33.0),
    ),
    "ESCs with numbers of their own": Flight(
        rpm=lambda at: [12000.0 * share**0.5 for share in (yawing(at) * 2)[2:6]],
        motors=yawing,
    ),
    "all speeds lower at lower commands": Flight(
        rpm=lambda at: [8000.0 * (share / HOVER) ** 0.5 for share in one_motor(2, 0.1, 30.0, 33.0)(at)],
        motors=one_motor(2, 0.1, 30.0, 33.0),
    ),
}


def rules_on(path: Path) -> LogReview:
    """Return the verdict without learning from the flight: a made-up one moves too simply to learn from."""
    return review_log(path, learn=False)


def names(review: LogReview) -> list[str]:
    return [one.rule.name for one in review.findings if one.rank]


@pytest.mark.parametrize("name", CASES)
def test_each_finding_is_first_where_it_is_the_cause(name: str, tmp_path: Path) -> None:
    review = rules_on(px4_log(tmp_path / "flight.ulg", CASES[name]))
    assert review.first is not None
    assert (review.first.rule.name, review.wrong) == (name, True)
    said = review.first.judgement
    assert said.evidence and review.first.counter
    if name not in ("battery_low", "vibration"):
        assert said.start_s == pytest.approx(30.0, abs=0.35)


def test_every_finding_has_a_flight_that_shows_it() -> None:
    assert {rule.name for rule in RULES} == {*CASES, *LEARNED, *SHOWN_APART}


@pytest.mark.parametrize(
    ("altered_m", "found"),
    [
        (between(30.0, 40.0, -7.0, 0.0), True),
        (between(30.0, 30.9, 60.0, 0.0), False),
        (between(30.0, 40.0, 8.0, 0.0), False),
        (lambda at: 99.0 * 20.0 * at, False),
    ],
    ids=["an attack", "a change of lane", "the other lane", "centimetres"],
)
def test_a_position_altered_behind_the_estimator_is_first(
    altered_m: Callable[[float], float], found: bool, tmp_path: Path
) -> None:
    flight = Flight(north_m=lambda at: 20.0 * at, altered_m=altered_m)
    review = rules_on(ardupilot_log(tmp_path / "flight.bin", flight))
    assert names(review) == ["position_altered"] * found
    assert [(one.judgement.start_s, "up to 7 m" in one.judgement.text) for one in review.findings] == [
        (30.0, True)
    ] * found


@pytest.mark.parametrize("name", LOOK_ALIKES)
def test_what_only_looks_wrong_is_no_finding(name: str, tmp_path: Path) -> None:
    review = rules_on(px4_log(tmp_path / "flight.ulg", LOOK_ALIKES[name]))
    assert names(review) == []
    assert review.sentence.startswith("Nothing wrong found in ")


def test_a_reset_of_the_estimator_says_how_far_it_went(tmp_path: Path) -> None:
    flight = Flight(resets=lambda at: 1 + (at > 30.0), reset_by_m=7.25)
    review = rules_on(px4_log(tmp_path / "flight.ulg", flight))
    assert "reset its position 1 time in flight, by 7.2 m" in review.sentence


def test_a_failure_is_named_as_the_log_names_it(tmp_path: Path) -> None:
    """The same bit of vehicle_status has meant a motor in one version and an unbalanced propeller in another."""
    flags = {"fd_imbalanced_prop": True, "fd_motor": False}
    flight = Flight(others=lambda at: {"failure_detector_status": flags if at >= 30.0 else dict.fromkeys(flags, False)})
    review = rules_on(px4_log(tmp_path / "flight.ulg", flight))
    assert review.sentence.startswith(
        "First, at 30.0 s, the autopilot announced: failure detector: propeller imbalance"
    )


def test_a_vehicle_without_any_motor_is_judged_by_the_rest(tmp_path: Path) -> None:
    flight = Flight(motors=lambda _: [float("nan")] * 4, fix=lambda at: 0 if 30.0 <= at < 35.0 else 3)
    assert names(rules_on(px4_log(tmp_path / "flight.ulg", flight))) == ["gps_lost"]


def test_a_log_without_a_landing_detector_flies_by_its_estimators_height(tmp_path: Path) -> None:
    flight = Flight(
        others=lambda _: {"vehicle_land_detected": None, "vehicle_air_data": None},
        texts=[(30.0, "[ekf2] primary EKF changed 1 (filter fault) -> 0")],
    )
    review = rules_on(px4_log(tmp_path / "flight.ulg", flight))
    assert review.facts.flight == (pytest.approx((TAKEOFF_S + 0.7, LANDING_S - 0.7), abs=0.2),)
    assert "primary EKF changed 1" in review.sentence


def test_of_several_accelerometers_the_one_that_clips_is_looked_at(tmp_path: Path) -> None:
    def second(at: float) -> dict[str, dict[str, object]]:
        return {"vehicle_imu_status/1": {"accel_clipping": [0, 0, int(10 * at)], "accel_vibration_metric": 30.0}}

    review = rules_on(px4_log(tmp_path / "flight.ulg", Flight(others=second)))
    assert names(review) == ["vibration"]
    assert "vehicle_imu_status/1: " in review.findings[0].judgement.evidence[1]


@pytest.mark.parametrize(("write", "suffix"), [(px4_log, "ulg"), (ardupilot_log, "bin")])
def test_parameters_changed_in_flight_are_in_the_time_line(
    write: Callable[[Path, Flight], Path], suffix: str, tmp_path: Path
) -> None:
    changes = [(0.0, "FENCE_ENABLE", 1.0), (1.0, "RTL_ALT", 15.0), (30.0, "FENCE_ENABLE", 0.0), (31.0, "LOG_FILE", 2.0)]
    review = rules_on(write(tmp_path / f"flight.{suffix}", Flight(changes=changes)))
    told = [(round(at), text) for at, kind, text in review.timeline() if kind == "parameter"]
    assert told == [(30, "FENCE_ENABLE set to 0 (1 before)")]


def test_a_flood_of_commands_is_a_finding(tmp_path: Path) -> None:
    flight = Flight(commands=[(1.0, 190, 400, 1.0), *((30.0, 190, 512, 0.0) for _ in range(60))])
    review = rules_on(px4_log(tmp_path / "flight.ulg", flight))
    assert names(review) == ["commands_from_outside"]
    assert "60 commands a second" in review.sentence


def test_what_comes_after_a_fall_is_no_finding(tmp_path: Path) -> None:
    flight = Flight(
        height=fallen,
        motors=stopped,
        landed=lambda at: 29.9 <= at < 30.1 or not 3.0 <= at < 40.0,
        ratio=between(33.0, 36.0, 2.0, 0.1),
        tilt_deg=between(30.5, 32.0, 120.0, 0.0),
    )
    assert names(rules_on(px4_log(tmp_path / "flight.ulg", flight))) == ["motors_stopped_in_air"]


@pytest.mark.parametrize(("navigation_alone", "found"), [(False, ["attitude_not_followed"]), (True, [])])
def test_telemetry_tells_the_wanted_attitude_if_flights_follow_it(
    navigation_alone: bool, found: list[str], tmp_path: Path
) -> None:
    path = telemetry(tmp_path / "flight.tlog", CASES["attitude_not_followed"], 0.1, navigation_alone=navigation_alone)
    assert names(rules_on(path)) == found


def test_attitudes_are_compared_by_the_shorter_way_round(tmp_path: Path) -> None:
    flight = Flight(tilt_wanted_deg=between(30.0, 33.0, 175.0, 0.0), tilt_deg=between(30.0, 33.0, -175.0, 0.0))
    review = rules_on(px4_log(tmp_path / "flight.ulg", flight))
    assert "attitude_not_followed" not in [one.rule.name for one in review.findings]


def tilted(roll: float, **others: LogSignal) -> LogReview:
    """Return the verdict on a flight whose attitude is on its back for 4 s, with some other signals."""
    times = np.arange(600) / 10
    attitude = LogSignal(times, np.zeros((600, 3)), ("roll", "pitch", "yaw"), "", "attitude")
    attitude.values[300:340, 0] = roll
    wanted = LogSignal(times, np.zeros((600, 3)), ("roll", "pitch", "yaw"), "", "wanted")
    facts = LogFacts(
        autopilot="ArduPilot",
        vehicle="multirotor",
        start_ns=0,
        duration_s=60.0,
        armed=((0.0, 60.0),),
        flight=((1.0, 58.0),),
        signals={"attitude": attitude, "attitude_wanted": wanted, **others},
    )
    return judged(Path("carried.bin"), facts)


@pytest.mark.parametrize(
    ("felt", "climbed", "blow", "found"),
    [
        ((0.0, 4.0, -8.9), 0.1, 9.8, True),  # it leans by 24 degrees to the left
        ((0.0, -5.0, -14.0), 0.1, 9.8, False),  # a dash that keeps its height, by thrust and drag
        ((0.0, 0.0, -9.8), -7.0, 9.8, False),  # it falls
        ((0.0, -9.3, -3.0), 0.1, 9.8, False),  # it lies on its side
        ((0.0, 4.0, -8.9), 0.1, 150.0, False),  # it has hit the ground
    ],
)
def test_an_estimator_that_leans_alone_is_named(
    felt: tuple[float, float, float], climbed: float, blow: float, found: bool
) -> None:
    times = np.arange(600) / 10
    leaning = np.clip((times - 30.0) / 4.0, 0.0, 1.0)
    attitude = LogSignal(times, np.outer(leaning, [70.0, 0.0, 0.0]), ("roll", "pitch", "yaw"), "deg", "ATT")
    force = LogSignal(times, np.tile(felt, (600, 1)), ("x", "y", "z"), "", "IMU")
    force.values[310, 2] = -blow
    height = LogSignal(times, climbed * leaning[:, None], ("barometer",), "m", "BARO")
    signals = {"attitude": attitude, "acceleration": force, "height": height}
    facts = LogFacts("ArduPilot", "multirotor", 0, 60.0, ((0.0, 60.0),), ((1.0, 36.0),), signals)
    assert names(judged(Path("log.bin"), facts)) == ["attitude_contradicted"] * found


def test_an_attitude_is_not_judged_where_nothing_tells_what_the_motors_were_commanded() -> None:
    assert names(tilted(170.0)) == []


@pytest.mark.parametrize(
    ("blow", "found"), [(9.8, ["attitude_contradicted"]), (60.0, ["turned_over", "attitude_not_followed"])]
)
def test_an_attitude_that_accelerometers_and_barometer_contradict_is_the_estimators(
    blow: float, found: list[str]
) -> None:
    times = np.arange(600) / 10
    force = LogSignal(times, np.tile([0.0, 0.0, -9.8], (600, 1)), ("x", "y", "z"), "", "IMU")
    force.values[303, 2] = -blow
    height = LogSignal(times, np.full((600, 1), 0.2), ("barometer",), "m", "BARO")
    motors = LogSignal(times, np.full((600, 4), 0.4), ("a", "b", "c", "d"), "", "motors")
    assert names(tilted(170.0, acceleration=force, height=height, motors=motors, throttle=motors)) == found


def test_what_began_sooner_comes_first(tmp_path: Path) -> None:
    flight = Flight(ratio=between(25.0, 28.0, 2.0, 0.1), height=fallen, motors=stopped, landed=LANDED_THERE.landed)
    review = rules_on(px4_log(tmp_path / "flight.ulg", flight))
    assert names(review) == ["innovations_refused", "motors_stopped_in_air"]
    assert "Then, at 29.9 s, the landing detector" in review.sentence


def test_a_log_that_ends_in_the_air_is_said_and_no_finding(tmp_path: Path) -> None:
    review = rules_on(px4_log(tmp_path / "flight.ulg", Flight(end_s=30.0)))
    assert [one.rule.name for one in review.findings] == ["log_ends_in_flight"]
    assert not review.wrong


def watched(
    *alarms: LearnedAlarm,
    lost: bool = False,
    vehicle: str = "multirotor",
    then: Sequence[float] = (0.5,) * 4,
    gps: Sequence[int] = (3, 12),
    fast_m_s: Sequence[float] = (0.0, 0.0),
    flight: Sequence[tuple[float, float]] = ((1.0, 58.0),),
) -> LogReview:
    """Return the verdict on a flight of which a learned profile speaks; ``then`` and ``gps`` are so from 25 s on.

    ``fast_m_s`` says how fast it flies north before and after 20 s.
    """
    motors = LogSignal(np.arange(600) / 10, np.full((600, 4), 0.5), ("a", "b", "c", "d"), "", "motors")
    motors.values[250:] = then
    fixes = LogSignal(motors.time_s, np.tile([3.0, 12.0], (600, 1)), ("fix", "satellites"), "", "gps")
    fixes.values[250:] = gps
    way = np.cumsum(np.where(motors.time_s < 20.0, *fast_m_s)) / 10
    position = LogSignal(motors.time_s, np.stack([way, 0.0 * way], axis=1), ("north", "east"), "m", "gps")
    force = LogSignal(motors.time_s, np.full((600, 3), -9.81), ("x", "y", "z"), "m/s2", "accelerometer")
    attitude = LogSignal(np.arange(600) / 10, np.zeros((600, 3)), ("roll", "pitch", "yaw"), "", "attitude")
    attitude.values[300:320, 0] = 150.0 * lost
    facts = LogFacts(
        autopilot="PX4",
        vehicle=vehicle,
        start_ns=0,
        duration_s=60.0,
        armed=((0.0, 60.0),),
        flight=tuple(flight),
        signals={
            "motors": motors,
            "throttle": motors,
            "attitude": attitude,
            "acceleration": force,
            "gps": fixes,
            "position": position,
        },
        watch=LearnedWatch(20.0, alarms),
    )
    return judged(Path("flight.ulg"), facts)


LEARNED = {
    "actuator_effect": LearnedAlarm(25.0, 40.0, "motors", "motor2", 1.2, "motor2 delivers 15 % less than commanded"),
    "sensor_effect": LearnedAlarm(25.0, 40.0, "inertial", "gyro_x", 1.2, "gyro x reads 1 degree/s too much"),
}


@pytest.mark.parametrize("name", LEARNED)
def test_a_lasting_alarm_of_what_was_learned_is_a_finding(name: str) -> None:
    review = watched(LEARNED[name])
    assert names(review) == [name]
    assert "compared with the first 19 s of the flight" in review.sentence
    assert watched(replace(LEARNED[name], onset_s=22.5)).sentence.startswith("First, at 22.5 s")


@pytest.mark.parametrize(("vehicle", "channel"), [("plane", "aileron"), ("plane", "throttle"), ("rover", "steering")])
def test_actuators_of_planes_and_rovers_are_watched_too(vehicle: str, channel: str) -> None:
    assert names(watched(replace(LEARNED["actuator_effect"], channel=channel), vehicle=vehicle)) == ["actuator_effect"]


def test_a_gyro_beside_a_compass_is_one_of_two() -> None:
    gyro = replace(LEARNED["sensor_effect"], channel="gyro_z")
    review = watched(gyro, replace(gyro, channel="compass", start_s=24.0))
    assert names(review) == ["sensor_effect"]
    assert "the compass is wrong, or gyro" in review.sentence


@pytest.mark.parametrize(
    "alarm",
    [
        replace(LEARNED["actuator_effect"], end_s=36.0),
        replace(LEARNED["actuator_effect"], channel="unexplained"),
        replace(LEARNED["actuator_effect"], start_s=51.0, end_s=60.0),
        replace(LEARNED["sensor_effect"], channel="gps_east", share=1.9),
        replace(LEARNED["sensor_effect"], channel="gps_east", share=4.0, size=0.8),
        replace(LEARNED["sensor_effect"], channel="compass", share=9.0),
        replace(LEARNED["sensor_effect"], observer="motors"),
    ],
    ids=["it ended by itself", "unexplained", "at landing", "wind", "strong wind", "heading", "command against motion"],
)
def test_an_alarm_of_what_was_learned_may_be_the_flight_itself(alarm: LearnedAlarm) -> None:
    assert names(watched(alarm)) == []


def test_what_is_broken_in_every_turn_is_a_finding_although_each_alarm_ends() -> None:
    steering = replace(LEARNED["actuator_effect"], channel="steering", end_s=31.0)
    often = [replace(steering, start_s=25.0 + 8 * k, end_s=31.0 + 8 * k) for k in range(3)]
    assert names(watched(*often, vehicle="rover")) == ["actuator_effect"]
    assert names(watched(*often[:2], vehicle="rover")) == []


def test_more_than_two_motors_or_axes_at_once_are_no_fault_of_one() -> None:
    alarms = [replace(LEARNED["actuator_effect"], channel=f"motor{k}") for k in range(1, 4)]
    assert names(watched(*alarms)) == []
    assert len(names(watched(*alarms[:2]))) == 2
    axes = [replace(LEARNED["sensor_effect"], channel=name) for name in ("gyro_x", "gyro_y", "accel_x")]
    assert names(watched(*axes)) == []
    assert len(names(watched(*axes[:2]))) == 2


def test_an_alarm_that_ended_by_itself_is_information() -> None:
    review = watched(replace(LEARNED["actuator_effect"], end_s=36.0))
    assert [(one.rule.name, one.judgement.weight) for one in review.findings] == [("actuator_effect", "information")]


def test_an_alarm_that_lasts_to_the_end_of_the_flight_may_be_short() -> None:
    assert names(watched(replace(LEARNED["actuator_effect"], start_s=49.0, end_s=60.0))) == ["actuator_effect"]


@pytest.mark.parametrize(
    ("then", "weight"),
    [((0.5, 0.65, 0.5, 0.5), "warning"), ((0.42, 0.58, 0.5, 0.5), "information")],
    ids=["a motor is made up for", "the opposite one gives way: wind, a load that moved"],
)
def test_motors_that_lift_as_before_lack_nothing(then: Sequence[float], weight: str) -> None:
    (found,) = watched(replace(LEARNED["actuator_effect"], end_s=60.0, size=0.15), then=then).findings
    assert found.judgement.weight == weight
    assert any("together lift" in line for line in found.counter) is (weight == "information")


@pytest.mark.parametrize(
    ("fast_m_s", "weight"), [((5.0, 14.0), "warning"), ((5.0, 22.0), "information"), ((22.0, 22.0), "warning")]
)
def test_motors_are_not_judged_at_speeds_that_the_begin_did_not_have(fast_m_s: Sequence[float], weight: str) -> None:
    (found,) = watched(LEARNED["actuator_effect"], fast_m_s=fast_m_s).findings
    assert found.judgement.weight == weight
    assert any("22 m/s" in line for line in found.counter) is (weight == "information")


@pytest.mark.parametrize(("again_s", "weight"), [(25.0, "warning"), (33.0, "information")])
def test_what_was_learned_may_not_hold_after_a_landing(again_s: float, weight: str) -> None:
    alarm = replace(LEARNED["sensor_effect"], start_s=35.0, end_s=60.0)
    (found,) = watched(alarm, flight=((1.0, 22.0), (again_s, 58.0))).findings
    assert found.judgement.weight == weight
    assert any("landed since" in line for line in found.counter) is (weight == "information")


@pytest.mark.parametrize(("fast_m_s", "weight"), [(5.0, "warning"), (25.0, "information")])
def test_a_receiver_is_off_by_what_it_is_late(fast_m_s: float, weight: str) -> None:
    alarm = replace(LEARNED["sensor_effect"], channel="gps_north", size=4.0, share=9.0)
    (found,) = watched(alarm, fast_m_s=(0.0, fast_m_s)).findings
    assert found.judgement.weight == weight


@pytest.mark.parametrize(("satellites", "weight"), [(9, "warning"), (5, "information")])
def test_a_gyro_is_not_judged_by_a_receiver_that_loses_satellites(satellites: int, weight: str) -> None:
    (found,) = watched(LEARNED["sensor_effect"], gps=(3, satellites)).findings
    assert found.judgement.weight == weight
    assert any("satellites" in line for line in found.counter) is (weight == "information")


@pytest.mark.parametrize(("until", "weight"), [(32.0, "information"), (DISARM_S, "critical")])
def test_who_turns_over_in_acro_and_stays_so_did_not_mean_it(until: float, weight: str, tmp_path: Path) -> None:
    flight = Flight(
        mode=10, tilt_deg=between(30.0, until, 150.0, 0.0), tilt_wanted_deg=between(30.0, until, 150.0, 0.0)
    )
    review = rules_on(px4_log(tmp_path / "flight.ulg", flight))
    assert [one.judgement.weight for one in review.findings] == [weight]


def test_a_size_that_no_actuator_can_have_is_not_stated() -> None:
    """The commands of a vehicle that lay on the ground were so small that a motor was to lack four times as much."""
    review = watched(replace(LEARNED["actuator_effect"], possible=False, text="motor2 is off by 22 % of full thrust"))
    assert names(review) == []
    assert "motor2 would have an impossible fault" in review.unjudged["An actuator does less than before"]


@pytest.mark.parametrize(
    ("channel", "relative", "estimate", "possible"),
    [
        ("motor1", -0.06, -0.06, True),
        ("motor1", None, -0.06, False),
        ("gyro_y", None, 0.1, True),
        ("motion_east", None, 101.0, False),
        ("gps_velocity_east", None, -9.0, True),
    ],
)
def test_what_was_learned_does_not_hold_where_it_says_what_cannot_be(
    channel: str, relative: float | None, estimate: float, possible: bool
) -> None:
    said = {"channel": channel, "relative": relative, "estimate": estimate}
    run = Replay(events=(event(6000, "raised", **said), event(9000, "cleared", **said)))
    facts = LogFacts("PX4", "multirotor", START_NS, 100.0, (), ((0.0, 100.0),), {})
    assert [one.possible for one in learning._alarms(run, facts, 40.0)] == [possible]


def test_what_was_learned_as_healthy_is_said() -> None:
    said = watched().unjudged["A fault from take-off on"]
    assert "before 20 s" in said
    assert "a 50 %, b 50 %" in said


def test_an_alarm_after_control_was_lost_is_a_consequence() -> None:
    alarm = replace(LEARNED["sensor_effect"], start_s=31.0, end_s=60.0)
    assert names(watched(alarm, lost=True)) == ["turned_over"]


@pytest.mark.long
def test_a_fault_is_told_from_the_flights_own_begin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # a review asks nobody what its profile will detect, which takes a fifth of the time
    monkeypatch.delattr("replay.fit.measure_capability")
    healthy, attacked = DATA / "copter_healthy_square.tlog.xz", str(tmp_path / "attacked.mcap")
    bias = ["--channel", "gps_north", "--kind", "bias", "--size", "20", "--start", "42", "-o", attacked]
    assert fauio.main(["inject", str(healthy), *bias]) == 0
    review = review_log(Path(attacked))
    assert names(review) == ["sensor_effect"]
    assert "GPS is" in review.sentence
    assert review.findings[0].judgement.start_s == pytest.approx(42.0, abs=2.0)


def test_a_short_flight_teaches_nothing() -> None:
    review = review_log(DATA / "copter_motor2_080.tlog.xz")
    assert "14 s of flight are too few to learn from" in review.unjudged["An actuator does less than before"]


@pytest.mark.parametrize(("log", "vehicle"), [("plane_healthy", "plane"), ("rover_healthy", "rover")])
def test_planes_and_rovers_are_judged_while_they_move(log: str, vehicle: str) -> None:
    review = review_log(DATA / f"{log}.tlog.xz", learn=False)
    assert (review.facts.vehicle, names(review)) == (vehicle, [])
    assert review.facts.flight_s > 20.0
    assert "Failsafe announced" in review.watched
    assert ("s of flight" in review.sentence) is (vehicle == "plane")


def test_accelerations_and_pressure_of_a_link_are_taken_from_its_imu(tmp_path: Path) -> None:
    facts = review_log(DATA / "copter_motor2_080.tlog.xz", learn=False).facts
    assert np.median(facts.signal("acceleration").values[:, 2]) == pytest.approx(-9.8, abs=1.0)
    assert facts.signal("height").origin == "HIGHRES_IMU"
    slow = tmp_path / "slow.tlog"
    highres_imu = 105
    packets = enumerate(TlogReader(DATA / "copter_motor2_080.tlog.xz").packets())
    kept = (one for k, one in packets if message_number(one[1]) != highres_imu or k % 30 == 0)
    slow.write_bytes(b"".join((at // 1000).to_bytes(8) + packet for at, packet in kept))
    review = review_log(slow, learn=False)
    assert "less than 20 times a second" in review.unjudged["Attitude contradicted by accelerometers"]


def test_what_the_log_lacks_is_said(tmp_path: Path) -> None:
    review = rules_on(px4_log(tmp_path / "flight.ulg", Flight(connected=False, volts=lambda _: 0.05, gps_used=False)))
    assert "none is connected" in review.unjudged["Battery empty"]
    assert "did not use GPS" in review.unjudged["GPS fix lost in flight"]
    assert "motor speeds" in review.unjudged["Motor slower than commanded"]


def test_a_log_without_a_flight_is_not_judged(tmp_path: Path) -> None:
    review = rules_on(px4_log(tmp_path / "flight.ulg", Flight(armed=lambda _: False, motors=lambda _: [0.0] * 4)))
    assert review.sentence == "The log shows no flight, it was never armed: nothing was judged."
    assert not review.watched
    # one reason is said once
    assert [why for _, why in review.reasons()] == ["the log shows no flight"]


@pytest.mark.parametrize(
    "name", ["motors_stopped_in_air", "motor_at_limit", "gps_lost", "turned_over", "commands_from_outside"]
)
def test_logs_of_ardupilot_are_judged_alike(name: str, tmp_path: Path) -> None:
    review = rules_on(ardupilot_log(tmp_path / "flight.bin", (CASES | {"motors_stopped_in_air": LANDED_THERE})[name]))
    assert review.facts.autopilot == "ArduPilot"
    assert review.first is not None
    assert review.first.rule.name == name


def test_a_log_of_ardupilot_that_begins_in_the_air_shows_a_flight(tmp_path: Path) -> None:
    flight = Flight(
        landed=lambda at: at >= LANDING_S,
        armed=lambda at: at < DISARM_S,
        motors=lambda at: [HOVER * (at < LANDING_S)] * 4,
    )
    review = rules_on(ardupilot_log(tmp_path / "flight.bin", flight, landed_at_begin=False))
    assert review.facts.flight[0] == (0.0, pytest.approx(LANDING_S))


@pytest.mark.parametrize("first_output", [1, 9])
def test_motors_are_on_the_outputs_that_the_parameters_say(first_output: int, tmp_path: Path) -> None:
    log = telemetry(tmp_path / "flight.tlog", CASES["motor_at_limit"], first_output=first_output)
    review = rules_on(log)
    assert names(review) == ["motor_at_limit"]
    assert "motor3 was at full command" in review.sentence


def test_a_height_that_drifted_before_the_vehicle_armed_is_no_flight(tmp_path: Path) -> None:
    """A copter that is held on the ground lets its controllers run to their ends."""
    flight = Flight(
        height=lambda _: 0.0,
        motors=lambda at: [0.97, 0.9, 0.2, 0.2] if at > 5.0 else [0.0] * 4,
        armed=lambda at: 4.0 <= at < DISARM_S,
    )
    review = rules_on(telemetry(tmp_path / "flight.tlog", flight, drift_m=2.5))
    assert (
        review.sentence
        == "The log shows no flight, it was armed for 53 s and never seen to leave the ground: nothing was judged."
    )


def test_a_flight_that_begins_while_the_link_is_lost_is_one(tmp_path: Path) -> None:
    """Heard again, the vehicle is armed and in the air, and the estimator's height begins there."""
    review = rules_on(telemetry(tmp_path / "flight.tlog", Flight(), unheard=(0.75, 20.0)))
    assert review.facts.flight == (pytest.approx((20.0, 53.5), abs=0.3),)


@pytest.mark.parametrize(
    ("ratio", "found"),
    [
        (lambda at: 2.0 + 0.1 * (at % 0.7), ["innovations_refused"]),
        (lambda _: 2.12, []),
        (lambda at: 1.0 + (at > 20.0) + (at > 40.0), []),
    ],
    ids=["an innovation", "a Kalman filter that does not run", "a gear"],
)
def test_what_does_not_change_with_measurements_is_no_innovation(
    ratio: Callable[[float], float], found: list[str], tmp_path: Path
) -> None:
    """A rover's reports hold one value from boot on, another's the gear that it drives in."""
    log = telemetry(tmp_path / "flight.tlog", Flight(), estimator=lambda at: (831, ratio(at)))
    assert names(rules_on(log)) == found


def test_one_sample_in_the_air_shows_who_turned_over_and_fell(tmp_path: Path) -> None:
    """A slow link has the next sample of the attitude from the ground, on which it stays upside down."""
    flight = Flight(height=fallen, tilt_deg=lambda at: 170.0 * (at >= FALLS_S + 1.0))
    review = rules_on(telemetry(tmp_path / "flight.tlog", flight, period_s=0.7))
    assert review.facts.flight[-1][1] - (FALLS_S + 1.0) < 1.4
    assert "turned_over" in names(review)


@pytest.mark.parametrize(("period_s", "found"), [(0.5, ["motor_command_stopped"]), (2.3, [])])
def test_one_sample_does_not_say_how_long_a_motor_was_stopped(
    period_s: float, found: list[str], tmp_path: Path
) -> None:
    flight = replace(CASES["motor_command_stopped"], motors=one_motor(2, 0.0, 30.0, 32.2))
    assert names(rules_on(telemetry(tmp_path / "flight.tlog", flight, period_s))) == found


@pytest.mark.parametrize("suffix", ["ulg", "tlog"])
def test_motors_of_a_vtol_may_stand_in_the_air(suffix: str, tmp_path: Path) -> None:
    flight = replace(CASES["motor_command_stopped"], vtol=True)
    review = rules_on((px4_log if suffix == "ulg" else telemetry)(tmp_path / f"flight.{suffix}", flight))
    assert names(review) == []
    assert review.unjudged["One motor commanded to stop"] == "for multirotors alone; the vehicle is a VTOL"


def test_a_rover_loses_its_fix_while_it_is_armed() -> None:
    times = np.arange(60.0)
    fixes = np.stack([np.where((times > 20.0) & (times < 30.0), 1.0, 3.0), np.full(60, 9.0)], axis=1)
    gps = LogSignal(times, fixes, ("fix", "satellites"), "", "GPS")
    facts = LogFacts("ArduPilot", "rover", 0, 60.0, ((0.0, 60.0),), ((0.0, 60.0),), {"gps": gps})
    assert "GPS lost its fix for 9.0 s while armed" in judged(Path("rover.tlog"), facts).sentence


def test_a_rover_may_be_disarmed_by_anybody() -> None:
    facts = LogFacts("PX4", "rover", 0, 60.0, ((1.0, 60.0),), ((1.0, 60.0),), {})
    facts = replace(
        facts, commands=(CommandSent(0.5, 1, 191, "400", (1.0,)), CommandSent(59.0, 255, 190, "400", (0.0,)))
    )
    assert not judged(Path("rover.ulg"), facts).wrong
    assert judged(Path("copter.ulg"), replace(facts, vehicle="multirotor")).wrong


def test_a_log_that_begins_in_flight_does_not_know_who_commanded_before() -> None:
    facts = LogFacts("PX4", "multirotor", 0, 60.0, ((0.0, 60.0),), ((0.0, 60.0),), {})
    review = judged(Path("copter.ulg"), replace(facts, commands=(CommandSent(0.5, 255, 0, "400", (0.0,)),)))
    assert not review.wrong
    [found] = review.findings
    assert (found.judgement.weight, "begins in flight" in found.judgement.counter[0]) == ("information", True)


def test_a_plane_whose_log_has_no_barometer_flies_by_its_receivers_height(tmp_path: Path) -> None:
    log = DataflashWriter()
    log.define("MSG", "QZ", "TimeUS,Message")
    log.define("GPS", "QBBf", "TimeUS,Status,NSats,Alt")
    log.add("MSG", 0, "ArduPlane V3.1.2")
    for second in range(60):
        log.add("GPS", 1_000_000 * second, 3, 9, 500.0 + 50.0 * (10 <= second < 40))
    path = tmp_path / "plane.bin"
    path.write_bytes(log.data)
    assert rules_on(path).facts.flight == (pytest.approx((10.0, 40.0), abs=0.1),)


@pytest.mark.parametrize(("mode", "found"), [(0, ["turned_over", "attitude_not_followed"]), (1, ["turned_over"])])
def test_the_oldest_versions_say_height_throttle_and_what_is_wanted_under_other_names(
    mode: int, found: list[str], tmp_path: Path
) -> None:
    """ArduCopter 3.1 without barometer's and outputs' records; in acro its RollIn is a stick."""
    log = DataflashWriter()
    log.define("MSG", "QZ", "TimeUS,Message")
    log.define("MODE", "QB", "TimeUS,Mode")
    log.define("ATT", "Qffffff", "TimeUS,RollIn,Roll,PitchIn,Pitch,NavYaw,Yaw")
    log.define("CTUN", "Qhf", "TimeUS,ThrOut,BarAlt")
    log.add("MSG", 0, "ArduCopter V3.1")
    log.add("MODE", 0, mode)
    for tick in range(400):
        at = tick / 10
        roll = 130.0 + 10.0 * (tick % 4) if at >= 30.0 else 5.0
        log.add("ATT", tick * 100_000, 5.0, roll, 0.0, 0.0, 0.0, 0.0)
        log.add("CTUN", tick * 100_000, 550, 20.0 * (at >= 5.0) - 5.0 * max(at - 30.0, 0.0))
    path = tmp_path / "copter.bin"
    path.write_bytes(log.data)
    assert sorted(names(rules_on(path))) == sorted(found)


def test_a_submarine_is_judged_while_armed_and_needs_no_fix(tmp_path: Path) -> None:
    log = DataflashWriter()
    log.define("MSG", "QZ", "TimeUS,Message")
    log.define("EV", "QB", "TimeUS,Id")
    log.define("PARM", "QNf", "TimeUS,Name,Value")
    log.define("BAT", "Qff", "TimeUS,Volt,Curr")
    log.define("GPS", "QBB", "TimeUS,Status,NSats")
    log.add("MSG", 0, "ArduSub V4.1.2")
    log.add("PARM", 0, "BAT1_N_CELLS", 4.0)
    log.add("EV", 5_000_000, 10)
    for second in range(60):
        log.add("BAT", 1_000_000 * second, 16.0 - 4.0 * (second >= 30), 9.0)
        log.add("GPS", 1_000_000 * second, 3 * (second < 20), 9)
    path = tmp_path / "sub.bin"
    path.write_bytes(log.data)
    review = rules_on(path)
    assert names(review) == ["battery_low"]
    assert review.unjudged["GPS fix lost in flight"] == "receivers have no fix under water"


@pytest.mark.parametrize(("parameter", "vehicle"), [("LAND_SPEED", "multirotor"), ("CRUISE_SPEED", "rover")])
def test_a_log_without_texts_tells_its_vehicle_by_its_parameters(parameter: str, vehicle: str, tmp_path: Path) -> None:
    log = DataflashWriter()
    log.define("PARM", "QNf", "TimeUS,Name,Value")
    log.define("CURR", "Qff", "TimeUS,Volt,Curr")
    log.add("PARM", 0, parameter, 50.0)
    log.add("CURR", 1_000_000, 15.6, 9.0)
    path = tmp_path / "flight.bin"
    path.write_bytes(log.data)
    assert rules_on(path).facts.vehicle == vehicle


def test_old_versions_log_hundredths_of_volts(tmp_path: Path) -> None:
    log = DataflashWriter()
    log.define("MSG", "QZ", "TimeUS,Message")
    log.define("CURR", "Qhh", "TimeUS,Volt,Curr")
    log.add("MSG", 0, "ArduCopter V3.2.1")
    log.add("CURR", 1_000_000, 1557, 2038)
    path = tmp_path / "copter.bin"
    path.write_bytes(log.data)
    assert rules_on(path).facts.signals["battery"].values.tolist() == [[15.57, 20.38]]


@pytest.mark.parametrize(("pitch", "found"), [(0.0, 1), (-75.0, 0)])
def test_roll_says_nothing_of_a_vehicle_that_stands_on_its_nose(pitch: float, found: int) -> None:
    attitude = LogSignal(np.arange(100) / 10, np.tile([125.0, pitch, 0.0], (100, 1)), ("r", "p", "y"), "deg", "ATT")
    facts = LogFacts("ArduPilot", "multirotor", 0, 10.0, ((0.0, 10.0),), ((0.0, 10.0),), {"attitude": attitude})
    assert len(tumbles(facts)) == found


def test_what_the_ground_holds_does_not_fly_whatever_a_damaged_stamp_says() -> None:
    times = np.append(np.arange(600) / 10, 1e12)  # the last one thirty thousand years off
    turn = np.where((times >= 20.0) & (times < 40.0), 30.0, 0.0)
    wanted = LogSignal(times, np.stack([turn, 0 * turn, 0 * turn], axis=1), ("r", "p", "y"), "deg", "ATT")
    signals = {"attitude": replace(wanted, values=0 * wanted.values), "attitude_wanted": wanted}
    facts = LogFacts("ArduPilot", "multirotor", 0, 60.0, ((0.0, 60.0),), ((0.0, 60.0),), signals)
    assert np.ravel(flown(facts)) == pytest.approx([0.0, 20.0, 40.0, 60.0], abs=0.5)


@pytest.mark.parametrize("output", ["Ch", "Chan"])
def test_outputs_of_old_versions_are_motors_too(output: str, tmp_path: Path) -> None:
    flight = replace(CASES["motor_at_limit"], rpm=None)
    review = rules_on(ardupilot_log(tmp_path / "flight.bin", flight, output=output))
    assert names(review) == ["motor_at_limit"]


def test_full_command_of_old_versions_is_a_part_of_the_throttle_channels_range(tmp_path: Path) -> None:
    """A motor at 1850 us, 93 % of 1113 to 1906, had failed, and nothing was at full command."""
    range_of = {"RC3_MIN": 1113.0, "RC3_MAX": 1906.0, "MOT_TCRV_ENABLE": 1.0, "MOT_TCRV_MAXPCT": 93.0}
    flight = replace(CASES["motor_at_limit"], motors=one_motor(3, 0.85, 30.0, 32.0), parameters=range_of)
    assert names(rules_on(ardupilot_log(tmp_path / "flight.bin", flight, output="Chan"))) == ["motor_at_limit"]


def test_a_kill_switch_stops_motors_whatever_is_commanded(tmp_path: Path) -> None:
    flight = Flight(height=fallen, killed=lambda at: at >= FALLS_S)
    assert names(rules_on(px4_log(tmp_path / "flight.ulg", flight))) == ["motors_stopped_in_air"]


@pytest.mark.parametrize(
    ("blow", "found"),
    [(slice(0, 0), True), (slice(290, 292), False), (slice(0, 600), True)],
    ids=["none", "a blow", "vibration"],
)
def test_what_an_estimator_refuses_after_a_blow_is_its_consequence(blow: slice, found: bool) -> None:
    times = np.arange(600) / 10
    ratio = np.where((times >= 30.0) & (times < 33.0), 2.0, 0.1) + 0.01 * (times % 0.7)
    ratios = LogSignal(times, np.stack([ratio] * 3, axis=1), ("velocity", "position", "height"), "", "ratios")
    force = LogSignal(times, np.tile([0.0, 0.0, -9.81], (600, 1)), ("x", "y", "z"), "m/s2", "accelerometer")
    force.values[blow] = 100.0
    signals = {"ratios": ratios, "acceleration": force}
    facts = LogFacts("PX4", "multirotor", 0, 60.0, ((0.0, 60.0),), ((0.0, 60.0),), signals)
    assert judged(Path("flight.ulg"), facts).wrong is found


@pytest.mark.parametrize("name", ["attitude_not_followed", "turned_over"])
def test_a_log_without_outputs_has_the_thrust_that_was_wanted(name: str, tmp_path: Path) -> None:
    flight = replace(CASES[name], others=lambda _: {"actuator_motors": None})
    assert name in names(rules_on(px4_log(tmp_path / "flight.ulg", flight)))


def test_on_the_ground_with_idle_motors_nothing_is_judged(tmp_path: Path) -> None:
    """It fell at 25 s, lies on its back and is carried about, and the log never says that it landed."""
    flight = Flight(
        height=lambda at: usual_height(min(at, 25.0)) if at < 25.0 else 0.0,
        motors=lambda at: usual_motors(at) if at < 25.0 else [0.06] * 4,
        landed=lambda at: at < TAKEOFF_S,
        tilt_deg=between(30.0, 50.0, 170.0, 0.0),
        fix=lambda at: 0 if at > 30.0 else 3,
    )
    review = rules_on(px4_log(tmp_path / "flight.ulg", flight))
    assert review.facts.flight == ((TAKEOFF_S, pytest.approx(25.0)),)
    assert names(review) == []


@pytest.mark.parametrize("parameters", [{}, {"BAT1_N_CELLS": 6}], ids=["guessed", "contradicted by its voltage"])
def test_an_unsure_number_of_cells_is_no_finding(parameters: dict[str, float], tmp_path: Path) -> None:
    review = rules_on(px4_log(tmp_path / "flight.ulg", replace(CASES["battery_low"], parameters=parameters)))
    assert [one.rule.name for one in review.findings] == ["battery_low"]
    assert "for each of 4 cells" in review.findings[0].judgement.text
    assert not review.wrong


@pytest.mark.parametrize(
    "flight",
    [
        Flight(motors=one_motor(2, 0.0, 30.0, 33.0)),
        Flight(motors=lambda at: [0.02, 0.05, 0.2, 0.1 + 0.02 * (at % 2)], height=lambda at: 0.3 * (at > 10.0)),
    ],
    ids=["still, with a stopped motor", "idle motors below a metre"],
)
def test_a_multirotor_that_nothing_carries_stands_on_the_ground(flight: Flight, tmp_path: Path) -> None:
    review = rules_on(px4_log(tmp_path / "flight.ulg", flight))
    assert review.facts.flight == ()
    assert review.sentence.startswith("The log shows no flight")


@pytest.mark.parametrize(
    ("at", "text", "said"),
    [
        (30.0, "Battery Failsafe", True),
        (30.0, "Low Battery!", True),
        (30.0, "EKF variance", True),
        (30.0, "GPS Glitch cleared", False),
        (30.0, "Throttle failsafe off", False),
        (30.0, "PreArm: Radio failsafe on", False),
        (LANDING_S + 2.0, "Crash: Disarming", True),
        (LANDING_S + 2.0, "Battery Failsafe", False),
    ],
)
def test_what_the_autopilot_announces_by_text_is_a_reaction(at: float, text: str, said: bool, tmp_path: Path) -> None:
    review = rules_on(telemetry(tmp_path / "flight.tlog", Flight(texts=[(at, text)])))
    assert names(review) == ["failsafe"] * said
    assert (text in review.sentence) is said


def test_a_stamp_of_another_year_makes_no_flight_of_years(tmp_path: Path) -> None:
    path = telemetry(tmp_path / "flight.tlog", Flight())
    packets = bytearray(path.read_bytes())
    # the stamp of the last tick
    last = packets.rindex((1_795_251_917_000_000 + 59_750_000).to_bytes(8))
    packets[last : last + 8] = (1_200_000_000_000_000).to_bytes(8)
    path.write_bytes(packets)
    review = rules_on(path)
    assert review.facts.duration_s == pytest.approx(60.0, abs=1.0)
    assert "1 records are stamped a day and more from these: left out" in [said for _, _, said in review.timeline()]


def test_an_error_of_ardupilot_is_a_reaction(tmp_path: Path) -> None:
    path = ardupilot_log(tmp_path / "flight.bin", Flight(ratio=between(30.0, 33.0, 1.8, 0.1)), [(29.9, 16, 2)])
    assert names(rules_on(path)) == ["failsafe", "innovations_refused"]
    assert rules_on(path).sentence.startswith("First, at 30.0 s, the estimator refused")


def test_the_command_says_it_in_words_in_json_and_on_a_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bad = str(px4_log(tmp_path / "bad.ulg", LANDED_THERE))
    good = str(px4_log(tmp_path / "good.ulg", Flight()))
    page = tmp_path / "bad.html"
    assert fauio.main(["review", "--quick", bad, "--report", str(page)]) == 5
    assert "[first] 29.9 s, Motors stopped in the air (certain)" in capsys.readouterr().out
    text = page.read_text()
    # what shows the finding, then the flight as a whole
    assert text.count("data-chart=") >= 4
    assert "height (vehicle_air_data)" in text
    # a finding's charts show what was about it, those of the flight all of it, whichever was drawn first
    assert '"window":[9.9,44.9]' in text
    assert '"window":[0.0,59.9]' in text
    assert "default-src 'none'" in text
    assert fauio.main(["review", "--quick", good, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["first"], said["severity"], said["wrong"], said["findings"]) == (None, "information", False, [])
    assert fauio.main(["review", "--quick", bad, good, "--json"]) == 5
    assert len(capsys.readouterr().out.splitlines()) == 2


def test_a_page_shows_roll_and_pitch_without_the_scale_of_yaw(tmp_path: Path) -> None:
    log, page = px4_log(tmp_path / "leans.ulg", CASES["attitude_not_followed"]), tmp_path / "leans.html"
    assert fauio.main(["review", "--quick", str(log), "--report", str(page)]) == 5
    said = page.read_text()
    assert '"roll"' in said
    assert '"yaw"' not in said


def test_a_page_draws_a_condition_of_the_whole_flight_over_the_whole(tmp_path: Path) -> None:
    log, page = px4_log(tmp_path / "shaken.ulg", CASES["vibration"]), tmp_path / "shaken.html"
    assert fauio.main(["review", "--quick", str(log), "--report", str(page)]) == 1
    said = page.read_text()
    windows = {part.split("]")[0] for part in said.split('"window":[')[1:]}
    assert windows == {"0.0,59.9"}


def test_bad_input_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    letter = tmp_path / "letter.ulg"
    letter.write_text("Dear Sir or Madam\n")
    assert fauio.main(["review", "--quick", str(letter)]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
