"""The soak test in short: four vehicles into one daemon, every sample counted; what it computes from its readings."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "bench"))
from fleet_sender import fleet_packets, read_flight
from soak import Reading, broken, drops, memory_growth, outside_latencies
from soak_expected import Expected, expected

from monitor.profile import read_profile

ROOT = Path(__file__).parent.parent
EXPECTED = Expected(packets=4, first=[0, 0, 1, 2], later=[0, 1, 1, 3], causes={("motors", 1000): 2})


def report(**changes: Any) -> dict[str, Any]:
    kept: dict[str, Any] = {
        "minutes": 30.0,
        "vehicles": {"copter-1": {"samples": 10, "samples_expected": 10}},
        "memory_percent": 1.9,
        "alarm_latency_ms": {"p50": 2.0, "p99": 19.0, "max": 40.0},
        "cpu_percent_per_vehicle": 24.0,
        "daemon_exit": 0,
    }
    return kept | changes


@pytest.mark.long
def test_four_vehicles_lose_no_sample(tmp_path: Path) -> None:
    command = [sys.executable, str(ROOT / "bench" / "soak.py"), "--minutes", "0.3", "--json", "--keep", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=110, check=False)
    assert done.stdout, done.stderr
    found = json.loads(done.stdout)
    assert len(found["vehicles"]) == 4
    for one in found["vehicles"].values():
        assert one["samples"] == one["samples_expected"] > 0
        assert one["packets_sent"] > 300 * 60 * 0.3
    assert found["losses"] == {}
    assert found["alarm_latency_events"] > 4
    assert found["daemon_exit"] == 0
    # How fast it is depends on what else this machine does; that is for the long run to judge.
    assert done.returncode == bool(found["broken"])


def test_samples_of_later_turns_count_from_the_second_on() -> None:
    assert [EXPECTED.samples(sent) for sent in (0, 1, 4, 5, 6, 8, 12, 15)] == [0, 0, 2, 2, 3, 5, 8, 9]


def test_what_is_expected_of_three_turns_holds_for_every_shorter_run(data: Path) -> None:
    profile = read_profile(ROOT / "replay" / "data" / "quad")
    flight = read_flight(data / "copter_motor3_090.tlog.xz", 1, 0.0, 2.0)
    of_three = expected(profile, flight)
    assert of_three.later[-1] > 100
    for seconds in (0.5, 2.5, 5.0):
        sent = len(list(fleet_packets([flight], seconds)))
        assert expected(profile, flight, seconds).samples(sent) == of_three.samples(sent) > 0


def test_an_event_is_as_late_as_it_came_behind_the_packet_that_caused_it() -> None:
    event = {"vehicle": "copter-1", "observer": "motors", "vehicle_time_ms": 1000}
    silence = {"vehicle": "copter-1", "observer": "link", "vehicle_time_ms": 1000}
    heard = [
        {"at_ns": 3_500_000, "key": "fauio/copter-1/alarm/motors/motor1", "payload": event},
        {"at_ns": 8_000_000, "key": "fauio/copter-1/alarm/motors/motor1", "payload": event},
        {"at_ns": 9_000_000, "key": "fauio/copter-1/alarm/link/telemetry", "payload": silence},
        {"at_ns": 9_000_000, "key": "fauio/copter-1/status", "payload": {}},
    ]
    sent = np.arange(1, 9) * 1_000_000
    assert outside_latencies(heard, [EXPECTED], [sent]) == ([0.5, 1.0], 1)


def test_memory_is_compared_by_thirds() -> None:
    readings = [Reading(float(at), 100.0 if at < 20 else 103.0, 0.0) for at in range(31)]
    assert memory_growth(readings) == pytest.approx(3.0)


def test_only_counters_of_losses_that_are_not_zero_are_told() -> None:
    metrics = '# HELP x_lost_total of\nx_lost_total 0.0\ny_dropped_total{link="a b"} 2.0\nz_total 5.0\n'
    assert drops(metrics) == {'y_dropped_total{link="a b"}': 2.0}


def test_nothing_is_broken_where_every_limit_is_kept() -> None:
    assert broken(report()) == []


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"vehicles": {"copter-1": {"samples": 9, "samples_expected": 10}}}, "copter-1: 9 samples instead of 10"),
        ({"memory_percent": 2.1}, "memory: +2.10 %"),
        ({"alarm_latency_ms": {"p50": 2.0, "p99": 40.0, "max": 60.0}}, "p99 40.0 ms"),
        ({"alarm_latency_ms": {}}, "no alarm event"),
        ({"cpu_percent_per_vehicle": 25.0}, "25.0 % of a core"),
        ({"daemon_exit": 1}, "ended with status 1"),
    ],
)
def test_every_limit_that_is_broken_is_told(changes: dict[str, Any], told: str) -> None:
    [said] = broken(report(**changes))
    assert told in said


def test_a_short_run_says_nothing_about_memory() -> None:
    assert broken(report(minutes=1.0, memory_percent=50.0)) == []
