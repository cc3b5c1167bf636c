"""Wear across flights: intervals hold the truth as often as they say, and nothing is claimed of healthy vehicles."""

from __future__ import annotations

import json
import shutil
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import fauio
from adapters.logs.recordings import Recording
from monitor.alarms.alarm import CURRENT, LOG_TIMES, RESISTANCE, SPEED
from monitor.fitting.kept_flights import extent_of, write_kept
from monitor.profile import FaultChannel, read_profile
from replay.player import interests
from replay.reports.levels import WearLevel, WornChannel, wear_sign, worn_channels
from replay.runs.one_log import LogOutcome, LogTask, replay_log
from replay.runs.summary_table import SummaryTable
from replay.wear.line import fit_line
from replay.wear.trend import LoggedFlight, Wear, find_wear, read_table, wear_sentences

QUAD = Path(__file__).parent.parent / "replay" / "data" / "quad"
MOTORS = [WornChannel("motors", f"motor{n}", "% of thrust") for n in range(1, 5)]
LIMIT, BETWEEN = -4.0, 0.5


def flown(
    rng: np.random.Generator, count: int, slopes: dict[str, float], between: float = BETWEEN
) -> list[LoggedFlight]:
    """Return flights whose motors lose so many per cent each hour, each flight known as well as its length allows."""
    flights, hours = [], 0.0
    for number in range(count):
        length = float(rng.uniform(0.1, 0.5))
        levels = []
        for of in MOTORS:
            sd = float(rng.uniform(0.1, 0.3)) / np.sqrt(length)
            true = slopes.get(of.channel, 0.0) * (hours + 0.5 * length)
            levels.append(WearLevel(of, true + float(rng.normal(0.0, np.hypot(sd, between))), sd, LIMIT))
        flights.append(LoggedFlight(f"{number}.tlog", "", 3700.0 * length, 3600.0 * length, tuple(levels)))
        hours += length
    return flights


def more(*pairs: tuple[int, float]) -> list[Any]:
    """Return parameters for the long suite."""
    return [pytest.param(*pair, marks=pytest.mark.long) for pair in pairs]


def states(wear: Wear) -> dict[str, str]:
    return {trend.of.channel: trend.state for trend in wear.trends}


@pytest.mark.parametrize(
    ("count", "between"),
    [(4, 2.0), (8, 0.3), (25, 0.0), *more((4, 0.0), (4, 0.3), (8, 0.0), (8, 2.0), (25, 0.3), (25, 2.0))],
)
def test_95_percent_intervals_of_a_slope_hold_it_about_as_often(count: int, between: float) -> None:
    rng, held, runs = np.random.default_rng(count), 0, 300
    for _ in range(runs):
        x = np.cumsum(rng.uniform(0.1, 0.6, count))
        sd = rng.uniform(0.2, 1.5, count)
        line = fit_line(x, 1.0 - 2.0 * x + rng.normal(0.0, np.hypot(sd, between)), sd)
        held += abs(line.slope + 2.0) <= line.quantile() * line.slope_error
    # 300 runs know a share of 0.95 within 0.025 (two standard errors)
    assert 0.92 <= held / runs <= 0.98


def test_the_time_of_service_lies_in_its_interval_about_as_often() -> None:
    rng, held, told = np.random.default_rng(5), 0, 0
    for _ in range(120):
        flights = flown(rng, 20, {"motor3": -0.6})
        wear = find_wear(flights)
        [first] = [trend for trend in wear.trends if trend.of.channel == "motor3"]
        if first.due_h is not None:
            told += 1
            held += first.due_h[0] <= max(0.0, LIMIT / -0.6 - wear.hours) <= first.due_h[2]
    assert told > 90
    assert 0.9 <= held / told <= 0.99


@pytest.mark.parametrize(("count", "between"), [(4, BETWEEN), (12, 0.0), *more((4, 0.0), (12, BETWEEN))])
def test_nothing_is_claimed_of_healthy_vehicles(count: int, between: float) -> None:
    rng = np.random.default_rng(7 * count)
    runs = 100
    claimed = sum(
        any(state in ("due", "worn") for state in states(find_wear(flown(rng, count, {}, between))).values())
        for _ in range(runs)
    )
    assert claimed / runs < 0.05


def test_what_shows_in_neighbours_is_named_once_and_gains_are_no_wear() -> None:
    rng = np.random.default_rng(2)
    wear = find_wear(flown(rng, 15, {"motor2": -0.8, "motor4": -0.4, "motor1": 0.8}, 0.05))
    assert states(wear) == {"motor2": "worn", "motor4": "part", "motor3": "unclear", "motor1": "unclear"}
    [sentence] = wear_sentences(wear)
    assert sentence.startswith("motor2 will need service in ")
    assert "-4 % of thrust raises an alarm" in sentence
    assert next(trend for trend in wear.trends if trend.of.channel == "motor4").part_of == "motor2"


def test_service_is_due_at_the_limit_and_far_off_is_not_foretold() -> None:
    rng = np.random.default_rng(3)
    flights = flown(rng, 12, {"motor2": -0.5}, 0.05)
    near, far = (
        [replace(one, levels=tuple(replace(level, limit=limit) for level in one.levels)) for one in flights]
        for limit in (-0.3, -40.0)
    )
    [sentence] = wear_sentences(find_wear(near))
    assert sentence.startswith("motor2 needs service now: it is at -1")
    [sentence] = wear_sentences(find_wear(far))
    assert sentence.startswith("motor2 wears, ")
    assert "needs no service within the next" in sentence


def test_too_few_flights_tell_of_no_trend() -> None:
    flights = flown(np.random.default_rng(1), 3, {"motor1": -5.0})
    assert wear_sentences(find_wear(flights))[0].startswith("These flights show no trend (3 flights, ")


def test_flights_are_put_in_order_and_a_second_log_of_one_is_left_out() -> None:
    one, two, again = flown(np.random.default_rng(1), 3, {})
    dated = [
        replace(two, start_utc="2026-11-22T10:00:00.000Z"),
        replace(one, start_utc="2026-11-21T10:00:00.000Z"),
        replace(again, start_utc="2026-11-21T10:01:00.000Z"),
    ]
    wear = find_wear(dated)
    assert [flight.log for flight in wear.flights] == ["0.tlog", "1.tlog"]
    assert wear.doubled == ("2.tlog",)
    # without a date they stay as they were given
    unset = [replace(flight, start_utc="1970-01-01T00:00:09.000Z") for flight in dated]
    assert [flight.log for flight in find_wear(unset).flights] == ["1.tlog", "0.tlog", "2.tlog"]


@given(st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=12), st.floats(0.01, 100.0), st.floats(-5.0, 5.0))
def test_a_line_follows_shift_and_scale_of_its_values(values: list[float], scale: float, shift: float) -> None:
    x, y = np.arange(len(values), dtype=np.float64), np.array(values)
    sd = np.full(len(values), 0.1)
    plain, moved = fit_line(x, y, sd), fit_line(x, shift + scale * y, scale * sd)
    assert moved.slope == pytest.approx(scale * plain.slope, abs=1e-6 * scale)
    assert moved.slope_error == pytest.approx(scale * plain.slope_error, rel=1e-3)
    assert moved.between == pytest.approx(scale * plain.between, rel=1e-3, abs=1e-4 * scale)


@pytest.fixture(scope="module")
def worn(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the log of a flight all through which motor 2 lacks 3 % of its thrust."""
    log = tmp_path_factory.mktemp("worn") / "worn.mcap"
    healthy = str(data / "copter_healthy_square.tlog.xz")
    loss = ["--channel", "motor2", "--kind", "loss", "--size", "0.03", "--start", "0", "--profile", str(QUAD)]
    assert fauio.main(["inject", healthy, *loss, "-o", str(log)]) == 0
    return log


@pytest.fixture(scope="module")
def outcome(worn: Path) -> LogOutcome:
    return replay_log(read_profile(QUAD), LogTask("flight", worn))


def test_flights_that_a_profile_keeps_are_its_history(
    worn: Path, outcome: LogOutcome, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = Path(shutil.copytree(QUAD, tmp_path / "quad"))
    names = interests(read_profile(QUAD))
    log = Recording(worn, names)
    written = tomllib.loads((folder / "profile.toml").read_text())
    write_kept(folder, written, None, (), [("monday.tlog", extent_of(log.batches), log.batches)], names)
    assert fauio.main(["trend", "--profile", str(folder), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    [trend] = [one for one in said["trends"] if (one["observer"], one["channel"]) == ("motors", "motor2")]
    expected = next(level.value for level in outcome.levels if level.of == MOTORS[1])
    assert said["flights"] == 1
    assert trend["points"][0]["value"] == pytest.approx(expected, rel=1e-4)


def test_a_flight_tells_which_share_of_its_thrust_a_motor_lacks(outcome: LogOutcome) -> None:
    level = next(level for level in outcome.levels if level.of == MOTORS[1])
    assert level.value == pytest.approx(-3.0, abs=0.2)
    assert level.limit < 0.0 < level.sd < 0.2


def test_a_table_keeps_what_flights_say(tmp_path: Path, outcome: LogOutcome) -> None:
    worn = worn_channels(read_profile(QUAD))
    for suffix in (".csv", ".parquet"):
        path = tmp_path / f"table{suffix}"
        with SummaryTable(path, worn) as table:
            for one in (outcome, LogOutcome(log="b.tlog", error="b.tlog: holds nothing")):
                table.add(one)
        [flight] = read_table(path)
        assert (flight.log, flight.watched_s) == ("flight", pytest.approx(outcome.watched_s, abs=1e-3))
        assert [level.of for level in flight.levels] == [level.of for level in outcome.levels]
        for kept, level in zip(flight.levels, outcome.levels, strict=True):
            assert (kept.value, kept.sd, kept.limit) == pytest.approx((level.value, level.sd, level.limit), rel=1e-4)


@pytest.mark.parametrize(
    ("fault", "sign"),
    [
        (FaultChannel("motor1", "actuator", "fraction of full command", 0), -1),
        (FaultChannel("esc1", "actuator", SPEED, 0), -1),
        (FaultChannel("motor1", "actuator", CURRENT, 0), 1),
        (FaultChannel("battery", "actuator", RESISTANCE, 0), 1),
        (FaultChannel("vibration", "actuator", LOG_TIMES, None), 1),
        (FaultChannel("friction", "actuator", "N m", None), 0),
        (FaultChannel("gyro_x", "sensor", "rad/s", None), 0),
    ],
)
def test_wear_is_less_effect_more_current_resistance_and_vibration(fault: FaultChannel, sign: int) -> None:
    assert wear_sign(fault) == sign


def written(path: Path, flights: list[LoggedFlight]) -> Path:
    outcomes = [LogOutcome(log=one.log, evidence=1, watched_s=one.watched_s, levels=one.levels) for one in flights]
    with SummaryTable(path, MOTORS) as table:
        for one in outcomes:
            table.add(one)
    return path


def test_the_command_says_draws_and_prints_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = written(tmp_path / "table.csv", flown(np.random.default_rng(4), 12, {"motor2": -1.0}, 0.05))
    assert fauio.main(["trend", str(table), "--plot", str(tmp_path / "wear.png")]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("motor2 will need service")
    assert len(lines) == 5
    assert (tmp_path / "wear.png").stat().st_size > 10_000
    assert fauio.main(["trend", str(table), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    [trend] = [one for one in said["trends"] if one["channel"] == "motor2"]
    assert (said["flights"], trend["state"], len(trend["points"])) == (12, "worn", 12)
    low, slope, high = trend["slope_per_hour"]
    assert low < -1.0 < high
    assert low < slope < high


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["none.csv"], "none.csv: No such file"),
        ([], "no flights: give tables, or --profile PROFILE"),
        (["."], ": logs are replayed by a profile; add --profile PROFILE"),
        (["old.csv"], "old.csv: has no rows with columns of wear; write it anew"),
        (["bad.csv"], "bad.csv: row 1: 'motors/motor1 sd' is no number: 'x'; mend the table"),
        (["good.csv", "--since", "monday"], "--since monday: is no date"),
        (["good.csv", "--since", "2100-01-01"], "no flight that was watched since 2100-01-01"),
        (["good.csv", "--plot", "there/is/none.png"], "there is no folder there/is"),
        (["text.parquet"], "text.parquet: is no Parquet table"),
    ],
)
def test_mistakes_are_one_line(
    words: list[str], line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    good = written(Path("good.csv"), flown(np.random.default_rng(4), 1, {})).read_text()
    Path("old.csv").write_text("log,status\na.tlog,ok\n")
    head, row = good.splitlines()
    cells = row.split(",")
    cells[head.split(",").index("motors/motor1 sd")] = "x"
    Path("bad.csv").write_text("\n".join([head, ",".join(cells)]))
    Path("text.parquet").write_text("no table")
    assert fauio.main(["trend", *words]) == 2
    said = capsys.readouterr().err
    assert line in said
    assert said.count("\n") == 1
