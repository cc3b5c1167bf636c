"""The leaderboard counts what detectors find, late and falsely, and reads flights as they are."""

import csv
import json
import struct
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "bench/leaderboard"))
import alfa
import crazypad
import reviews
import spoofing
from review_logs import BEGIN_US, Flight, px4_log, usual_motors


def write_flight(path: Path, seed: int, onset: int | None, count: int = 1200) -> None:
    """Write a flight of noise whose pitch rate shifts at an index; the first rows lack what comes later."""
    path.parent.mkdir(parents=True, exist_ok=True)
    values = np.random.default_rng(seed).normal(size=(count, len(alfa.SIGNALS)))
    if onset is not None:
        values[onset:, alfa.SIGNALS.index("field.twist.angular.y")] += 9.0
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["%time", *alfa.SIGNALS, "field.data"])
        for row, sample in enumerate(values):
            known = ["" if row < 5 and column else f"{value:.4f}" for column, value in enumerate(sample)]
            writer.writerow([row, *known, float(onset is not None and row >= onset)])


@pytest.fixture(scope="module")
def flights(tmp_path_factory: pytest.TempPathFactory) -> list[alfa.Flight]:
    folder = tmp_path_factory.mktemp("alfa")
    for day in range(1, 5):
        write_flight(folder / f"engine/carbonZ_2018-07-0{day}-15-53-31_1_engine_failure.csv", 20 + day, 800)
        write_flight(folder / f"no_failure/carbonZ_2018-07-0{day}-15-53-31_2_no_failure.csv", 10 + day, None)
    return [alfa.read_flight(path) for path in sorted(folder.rglob("*.csv"))]


def test_a_flight_begins_where_all_signals_are_known(flights: list[alfa.Flight]) -> None:
    failed, healthy = flights[0], flights[-1]
    assert (len(failed.values), failed.onset) == (1195, 795)
    assert (len(healthy.values), healthy.onset) == (1195, 1195)
    assert failed.log == "2018-07-01-15-53-31"


@pytest.mark.parametrize("name", alfa.DETECTORS)
def test_a_plain_shift_is_found_at_once_by_all(name: str, flights: list[alfa.Flight]) -> None:
    found = alfa.summary(alfa.leave_one_out(flights, alfa.DETECTORS[name], 1.0))
    assert (found["found"], found["failures"], found["flights"]) == (4, 4, 8)
    assert 0.0 <= float(found["mean_delay_s"] or 0.0) < 1.0


def test_alarms_close_together_are_one() -> None:
    score = np.zeros(2000)
    score[[400, 500, 900, 1500]] = 2.0
    assert alfa.alarms(score, 1.0) == [(400, 500), (900, 900), (1500, 1500)]


def test_the_bound_of_nothing_seen_is_the_rule_of_three() -> None:
    assert alfa.poisson_bound(0) == pytest.approx(3.0, abs=0.01)
    assert alfa.poisson_bound(3) == pytest.approx(7.75, abs=0.01)


def test_a_flight_of_crazypad_is_read_from_its_log_and_says_what_is_cut(tmp_path: Path) -> None:
    fields = [*(f"controller.{name}" for names in crazypad.COLUMNS.values() for name in names)]
    fields += ["controller.accelz", "stateEstimate.z"]
    folder = tmp_path / "cut_M2_1.5мм_1мм_44.5мм_M1_1мм_45мм"
    folder.mkdir()
    head = struct.pack("<BHHH", 0xBC, 2, 1, 0) + b"fixedFrequency\0" + struct.pack("<H", len(fields))
    head += b"".join(f"{name}(f)".encode() + b"\0" for name in fields)
    rows = [[0.5 * crazypad.FULL, 0.1 * crazypad.FULL, 0.0, 0.0, 0.1, 0.2, 0.3, 1.0, 0.5]] * 3
    body = b"".join(struct.pack(f"<HQ{len(row)}f", 0, 10_000 * k, *row) for k, row in enumerate(rows))
    (folder / "E9_log00").write_bytes(head + body + b"\0" * 4)
    flight = crazypad.read_flight(folder / "E9_log00")
    assert flight.cut == {"motor2": 2.5, "motor1": 1.0}
    assert flight.hover() == pytest.approx([0.45, 0.45, 0.55, 0.55])
    assert flight.rates[0] == pytest.approx([0.1, 0.2, -0.3])
    assert {message.name for message in crazypad.messages(flight)} > {"SERVO_OUTPUT_RAW", "ATTITUDE", "PARAM_VALUE"}


@pytest.mark.parametrize("score", [crazypad.mean_command, crazypad.glr, crazypad.cusum, crazypad.kalman])
def test_a_motor_that_is_commanded_more_than_in_normal_flights_is_named(score: crazypad.Score) -> None:
    def flight(seed: int, excess: float) -> crazypad.Flight:
        """Return one whose third motor needs more, its rates by what the motors deliver."""
        draw = np.random.default_rng(seed)
        delivered = 0.5 + 0.05 * draw.normal(size=(1600, 4))
        rates = np.zeros((1600, 3))
        for row in range(1599):
            rates[row + 1] = 0.95 * rates[row] + (delivered[row] - 0.5) @ crazypad.MIXER[:, 1:]
        commands = delivered + np.array([0.0, 0.0, excess, 0.0])
        times = np.arange(1600) * 10_000_000
        flying = np.ones(1600, np.bool_)
        return crazypad.Flight("normal_flight", "E8", times, commands, rates, np.ones(1600), flying)

    normal = [flight(seed, 0.0) for seed in range(4)]
    assert crazypad.named_by(score)(normal, [flight(9, 0.1)]) == [{"motor3"}]


def write_north(path: Path, seed: int, led_m_s: float = 0.0) -> None:
    """Write what a position controller had in 40 s of flight; from 20 s on the position is led away."""
    path.parent.mkdir(parents=True, exist_ok=True)
    time_s = np.arange(400) / 10
    acceleration = np.random.default_rng(seed).normal(size=400)
    velocity = np.cumsum(acceleration) / 10
    position = np.cumsum(velocity) / 10 + led_m_s * np.maximum(time_s - 20.0, 0.0)
    rows = np.stack([position, position, velocity, acceleration], axis=1)
    text = [
        f"PSCN, {1e6 * (10.0 + at):.0f}, {', '.join(f'{one:.6f}' for one in row)}"
        for at, row in zip(time_s, rows, strict=True)
    ]
    path.write_text("\n".join(["\ufeffTimeUS,TPN,PN,VN,AN", *text, ""]), encoding="utf-8")


@pytest.mark.parametrize("name", ["residual energy", "GLR", "Kalman bank"])
def test_a_position_led_away_is_found_by_what_its_velocity_does_not_explain(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(spoofing, "ATTACKS", {"Flight": 30.0})
    for seed in range(3):
        write_north(tmp_path / f"{seed}.csv", seed)
    write_north(tmp_path / "Flight.csv", 9, led_m_s=3.0)
    flights = [spoofing.read_flight(path) for path in sorted(tmp_path.glob("*.csv"))]
    found = spoofing.compared(flights, spoofing.rival_alarms(spoofing.RIVALS[name]))
    assert found["Flight"] == pytest.approx(0.2, abs=1.0)


def test_verdicts_of_reviews_are_held_against_what_is_known(tmp_path: Path) -> None:
    def at_full_command(at: float) -> list[float]:
        return [*usual_motors(at)[:3], 0.95 if 30.0 <= at < 32.0 else usual_motors(at)[3]]

    by_hand, flown = tmp_path / "by_hand", tmp_path / "flown"
    for folder in (by_hand, flown):
        folder.mkdir()
    for name in ("motor_failure", "ekf_failure", "mine"):
        px4_log(by_hand / f"{name}.ulg", Flight())
    outcomes = {one.log: one.outcome for one in reviews.verdicts(by_hand, learn=False)}
    assert outcomes == {"motor_failure.ulg": "right", "ekf_failure.ulg": "wrong", "mine.ulg": "unknown"}
    for number in (4, 2):
        px4_log(flown / f"motor{number}.ulg", Flight(motors=at_full_command))
        fault = {
            "kind": "motor_stopped",
            "target": f"motor {number}",
            "on": {"time_boot_ms": BEGIN_US // 1000 + 30_000},
        }
        (flown / f"motor{number}.json").write_text(json.dumps({"vehicle": "copter", "faults": [fault]}))
    wrong, right = reviews.verdicts(flown, learn=False)  # in the order of names
    assert (wrong.outcome, right.outcome, right.delay_s) == ("wrong", "right", pytest.approx(0.0, abs=0.2))
    assert reviews.summary([wrong, right])["right"] == 1
