"""What is no fault is told as such: loads, wind, air pressure, each from half seconds of flight."""

from __future__ import annotations

import math
from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from adapters.sample import Samples
from monitor.conditions.condition import FlightCondition, latest_conditions
from monitor.conditions.conditions import Conditions, make_conditions
from monitor.conditions.half_seconds import SIGNALS, HalfSecond, HalfSeconds
from monitor.conditions.load import Load
from monitor.conditions.pressure import Pressure
from monitor.conditions.wind import Wind
from monitor.core.sampling import VehicleClock
from monitor.profile import Profile
from monitor.sampling.phase import FlightPhase

HOVER = HalfSecond(0, 0, math.log(0.5), (0.0, 0.0), (0.0, 0.0), (0.0, 0.0), 0.0, 10.0, 10.0)


def loads(load: NDArray[np.float64], *, climb: float = 0.0, mass_kg: float = 0.0) -> list[FlightCondition]:
    """Return what is told of a series of l whose second half climbs so fast."""
    stage, half = Load((1.0, 2.0), mass_kg), len(load) // 2
    found = []
    for number, value in enumerate(load):
        height = 10.0 + 0.5 * climb * max(0, number - half)
        shift = 0.1 * (number >= half)
        mean = HOVER._replace(number=number, time_ns=number, load=float(value), height=height, moments=(shift, 0.0))
        if (condition := stage.follow(mean)) is not None:
            found.append(condition)
    return found


def hovering(rng: np.random.Generator, count: int = 80) -> NDArray[np.float64]:
    return math.log(0.5) + rng.normal(0.0, 0.01, count)


@pytest.mark.parametrize("share", [-0.25, 0.3])
def test_a_load_that_changes_at_once_is_told_once_with_a_range_that_holds_it(share: float) -> None:
    load = hovering(np.random.default_rng(1))
    load[40:] += math.log1p(share) / 1.7  # thrust goes with the command to the 1.7
    [found] = loads(load)
    # what became heavier and what lost thrust of all motors look the same
    heavier = "payload picked up, or less thrust of all motors alike: +"
    assert found.text.startswith("payload dropped: -" if share < 0.0 else heavier)
    assert found.values["weight_share_low"] <= share <= found.values["weight_share_high"]
    assert found.values["weight_share"] == pytest.approx(share, rel=0.25)
    assert found.text.endswith("centre of gravity 15 % of the arm forward")
    assert found.to_json()["kind"] == "information"
    assert abs(found.since_ns - 40) <= 1
    [weighed] = loads(load, mass_kg=4.0)
    assert weighed.values["mass_kg"] == pytest.approx(4.0 * found.values["weight_share"])
    assert " kg (" in weighed.text


def test_what_comes_slowly_or_with_a_climb_is_no_load() -> None:
    rng = np.random.default_rng(2)
    sagging = hovering(rng) + np.linspace(0.0, 0.3, 80)
    climbing = hovering(rng) + 0.2 * (np.arange(80) >= 40)
    assert loads(hovering(rng)) == loads(sagging) == loads(climbing, climb=2.0) == []


def test_the_wind_is_told_once_the_drag_is_known_and_again_when_it_turns() -> None:
    rng, stage, found = np.random.default_rng(3), Wind(), []
    for number in range(400):
        wind = (3.0, -4.0) if number < 200 else (-3.0, 4.0)
        along = 4.0 * math.sin(0.3 * number), 4.0 * math.cos(0.2 * number)
        pull = [-0.35 * (v - w) + float(rng.normal(0.0, 0.1)) for v, w in zip(along, wind, strict=True)]
        if (told := stage.follow(HOVER._replace(time_ns=number, velocity=along, pull=(pull[0], pull[1])))) is not None:
            found.append(told)
    assert found[0].values["north_m_s"] == pytest.approx(3.0, abs=0.7)
    assert found[0].values["east_m_s"] == pytest.approx(-4.0, abs=0.7)
    assert found[0].values["from_deg"] == pytest.approx(127.0, abs=8.0)
    assert found[-1].since_ns > 200
    assert found[-1].values["from_deg"] == pytest.approx(307.0, abs=40.0)
    still = Wind()
    assert all(still.follow(HOVER._replace(pull=(0.5, 0.0))) is None for _ in range(400))


def test_a_drift_of_the_pressure_is_told_in_metres_and_hectopascal() -> None:
    stage = Pressure()
    found = [stage.follow(HOVER._replace(height=10.0 + 0.02 * number)) for number in range(600)]
    [told, *_] = [one for one in found if one is not None]
    assert told.values["height_m"] == pytest.approx(4.8, abs=1.3)
    assert told.values["sea_level_hpa"] == pytest.approx(-told.values["height_m"] / 8.3)
    steady = Pressure()
    assert not any(steady.follow(HOVER) for _ in range(600))


def test_half_seconds_turn_what_the_body_feels_to_north_and_east() -> None:
    stage = HalfSeconds(np.array([[1.0, 0.0], [-1.0, 0.0]]), 1.0)
    values = dict.fromkeys(SIGNALS, 0.0) | {"xacc": -1.0, "zacc": -9.80665, "yaw": math.pi / 2}
    values |= {"gps_speed": 5.0, "gps_course": 180.0, "baro_alt": 7.0}
    row = np.array([0.6, 0.4, *(values[name] for name in SIGNALS)])
    times = np.arange(0, 600_000_000, 100_000_000)
    assert not stage.run(times[:3], times[:3], np.tile(row, (3, 1)))
    (mean,) = stage.run(times[3:], times[3:], np.tile(row, (3, 1)))
    assert mean.pull == pytest.approx((0.0, -1.0))
    assert mean.velocity == pytest.approx((-5.0, 0.0))
    assert mean.moments == pytest.approx((0.2, 0.0))
    assert (mean.load, mean.height) == pytest.approx((math.log(0.5), 7.0))


def flown(count: int) -> Samples:
    """Return samples of a flight in wind, ten a second, that lets a load go."""
    rng = np.random.default_rng(4)
    t = np.arange(count) / 10.0
    rows = dict.fromkeys(SIGNALS, np.zeros(count)) | {
        "xacc": 0.5 * np.sin(t) + rng.normal(0.0, 0.1, count),
        "zacc": rng.normal(-9.8, 0.05, count),
        "gps_speed": 3.0 + 2.0 * np.sin(t),
    }
    command = np.where(t < 0.05 * count, 0.6, 0.5)
    ns = (t * 1e9).astype(np.int64)
    known = {"u": np.column_stack([*[command] * 4, *(rows[name] for name in SIGNALS)]), "y": np.zeros((count, 0))}
    blank = {"restart": np.zeros(count, np.bool_), "lost": np.zeros((count, 14), np.bool_)}
    times = dict.fromkeys(("vehicle_time_ns", "time_ns", "known_ns"), ns)
    ones = np.ones(count, np.bool_)
    return Samples(**{field.name: (known | blank | times).get(field.name, ones) for field in fields(Samples)})


def followed(profile: Profile, cuts: list[int]) -> list[FlightCondition]:
    conditions = make_conditions(profile, VehicleClock())
    assert isinstance(conditions, Conditions)
    samples, phase = flown(600), FlightPhase()
    for start, stop in zip([0, *cuts], [*cuts, len(samples)], strict=True):
        conditions.run(samples.part(start, stop), phase)
    return list(conditions.found)


@given(st.lists(st.integers(0, 600), max_size=8))
@settings(max_examples=8)
def test_conditions_do_not_depend_on_how_samples_are_cut(bundled_quad: Profile, cuts: list[int]) -> None:
    whole = followed(bundled_quad, [])
    assert [one.name for one in latest_conditions(whole)] == ["payload"]
    assert followed(bundled_quad, sorted(cuts)) == whole
