"""The inertial plant on a trajectory with exact truth, with noise of known size."""

from __future__ import annotations

from functools import cache
from itertools import permutations
from typing import Any

import numpy as np
import pytest
import strapdown_truth as truth

from adapters.channels import Channel
from adapters.errors import ModelError
from adapters.sample import Samples
from gains.analysis.estimability import problem_of
from gains.identification.segment import Segment
from gains.plants.plant import FloatArray, Plant
from gains.synthesis.bank import Hypothesis
from gains.synthesis.certificate import certify
from gains.synthesis.compilation import compile_gains
from monitor.core.repeats import Frozen
from monitor.estimation.affine import AffineObserver
from monitor.fitting.flights import Flight
from monitor.profile import FaultChannel
from monitor.vehicles.inertial.fit import _alarms as sensor_alarms
from monitor.vehicles.inertial.identify import inertial_bank, inertial_hypotheses, inertial_plant, smallest_faults
from monitor.vehicles.inertial.readings import _CALMER, BENT_DOUBLE, BENT_SINGLE, frozen_times, line_s
from monitor.vehicles.inertial.sensor_fit import (
    InertialData,
    InertialFit,
    Washouts,
    best_delays,
    delay_costs,
    identify_inertial,
)
from monitor.vehicles.inertial.strapdown import ACCELEROMETERS, BAROMETER, Strapdown

ONSET = 500
WASHOUTS = Washouts(30.0, 10.0, 3.0)


def noisy(raw: FloatArray, seed: int) -> FloatArray:
    rng = np.random.default_rng(seed)
    sizes = np.zeros(raw.shape[1])
    sizes[:3], sizes[3:6], sizes[14], sizes[15:] = 0.05, 0.005, 0.05, 0.002
    return raw + sizes * rng.normal(size=raw.shape)


def segment(raw: FloatArray, **parameters: float) -> Segment:
    _, samples = truth.transformed(raw, parameters)
    return Segment(np.array([s.u for s in samples]), np.array([s.y for s in samples]))


@cache
def fitted() -> InertialFit:
    transform, _ = truth.transformed(truth.signals(0.1))
    flights = [segment(noisy(truth.signals(60.0, start_s=100.0 * seed), seed)) for seed in (1, 2)]
    return identify_inertial(InertialData(flights, transform.inputs, transform.outputs, 25.0, WASHOUTS))


@cache
def designed() -> tuple[Hypothesis, ...]:
    return inertial_bank(inertial_plant(fitted(), "vehicle"))


def estimates(hypothesis: Hypothesis, raw: FloatArray) -> dict[str, FloatArray]:
    gains = compile_gains(hypothesis.plant, hypothesis.design, certify(hypothesis.plant, hypothesis.design))
    data = segment(raw)
    return dict(zip(gains.faults, AffineObserver([gains]).run(data.u, data.y).fault.T, strict=True))


def culprit(name: str) -> Hypothesis:
    return next(hypothesis for hypothesis in designed() if name in hypothesis.faults)


def test_scales_follow_the_sensors() -> None:
    fit = fitted()
    assert fit.noise["baro_down"] == pytest.approx(0.05, rel=0.5)
    assert fit.noise["gps_down"] < 0.02
    assert fit.speed_scale["position_north"] == pytest.approx(1.0, abs=1e-3)
    assert fit.seconds > 110.0


def test_every_hypothesis_can_be_estimated_and_names_one_vertical_culprit() -> None:
    plant = inertial_plant(fitted(), "vehicle")
    found = inertial_hypotheses(plant)
    assert [names[-1] for names in found] == ["baro", "gps_down", "accel_z", "baro"]
    motion = [{name for name in names if name.startswith(("motion", "gps_velocity"))} for names in found]
    assert motion == [{"motion_north", "motion_east"}] * 3 + [{"gps_velocity_north", "gps_velocity_east"}]
    assert all(problem_of(plant, names) is None for names in found)
    assert all(hypothesis.design.sqrt_mu > 0.0 for hypothesis in designed())


@pytest.mark.parametrize(
    ("name", "column", "size", "expected"),
    [("gps_north", 9, 1e-4, 11.1183), ("gps_down", 11, -6.0, 6.0), ("baro", 14, 8.0, 8.0)],
)
def test_a_step_of_a_position_is_read_at_once_and_named_alone(
    name: str, column: int, size: float, expected: float
) -> None:
    raw = noisy(truth.signals(30.0, start_s=300.0), 3)
    raw[2000:, column] += size
    found = estimates(culprit(name), raw)
    assert found[name][ONSET + 5] == pytest.approx(expected, rel=0.05)
    assert abs(found[name][ONSET - 10]) < 0.3
    others = [other for other in found if other not in (name, "accel_z") and not other.startswith("gyro")]
    assert all(np.max(np.abs(found[other][50:])) < 0.3 for other in others)


def test_a_walking_position_is_followed_at_the_rate_it_walks() -> None:
    raw = noisy(truth.signals(40.0, start_s=300.0), 4)
    t = np.maximum(np.arange(len(raw)) / 100.0 - 20.0, 0.0)
    raw[:, 9] += 0.5 * t / 111_183.0
    found = estimates(designed()[0], raw)["gps_north"]
    assert found[ONSET + 50] == pytest.approx(0.97, rel=0.2)


def test_a_consistent_spoof_is_a_velocity_that_accelerometers_did_not_feel() -> None:
    raw = noisy(truth.signals(30.0, start_s=300.0), 5)
    t = np.maximum(np.arange(len(raw)) / 100.0 - 20.0, 0.0)
    north = raw[:, 12] * np.cos(np.radians(raw[:, 13])) + 0.5 * t
    east = raw[:, 12] * np.sin(np.radians(raw[:, 13]))
    raw[:, 12], raw[:, 13] = np.hypot(north, east), np.degrees(np.arctan2(east, north))
    raw[:, 9] += 0.25 * t**2 / 111_183.0
    found = estimates(designed()[0], raw)
    assert found["motion_north"][ONSET + 75] == pytest.approx(1.3, rel=0.15)
    assert estimates(designed()[-1], raw)["gps_velocity_north"] == pytest.approx(found["motion_north"], abs=0.05)
    assert np.max(np.abs(found["gps_north"][50:])) < 0.3


def test_the_wrong_vertical_culprit_leaves_a_residual() -> None:
    raw = noisy(truth.signals(30.0, start_s=300.0), 6)
    raw[2000:, 14] += 8.0
    data = segment(raw)
    left = {}
    for name in ("baro", "gps_down", "accel_z"):
        one = culprit(name)
        run = AffineObserver([compile_gains(one.plant, one.design, certify(one.plant, one.design))]).run(data.u, data.y)
        left[name] = float(np.max(np.abs(run.residual[ONSET - 5 : ONSET + 25, 0, 4:6])))
    assert left["baro"] < 0.2
    assert left["gps_down"] > 1.0
    assert left["accel_z"] > 1.0


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_gyro_bias_is_read_on_its_axis_and_not_as_a_compass_fault(axis: int) -> None:
    raw = noisy(truth.signals(40.0, start_s=300.0), 7)
    raw[2000:, 3 + axis] += 0.1
    found = estimates(designed()[0], raw)
    names = [f"gyro_{letter}" for letter in "xyz"]
    assert found[names.pop(axis)][-1] == pytest.approx(0.1, rel=0.2)
    assert all(abs(found[name][-1]) < 0.02 for name in names)
    assert np.max(np.abs(found["compass"][50:])) < 0.35


def test_delays_are_those_of_the_sensors() -> None:
    raw = noisy(truth.signals(40.0, gps_late_s=0.12, baro_late_s=0.2), 8)
    transform, _ = truth.transformed(truth.signals(0.1))
    trials = {}
    for delay in np.arange(0.0, 0.31, 0.04).tolist():
        parameters = dict.fromkeys(("gps_delay_s", "baro_delay_s", "compass_delay_s"), delay)
        data = [segment(raw, **parameters)]
        trials[delay] = delay_costs(InertialData(data, transform.inputs, transform.outputs, 25.0, WASHOUTS))
    found = best_delays(trials)
    assert found["gps_delay_s"] == pytest.approx(0.12, abs=0.01)
    assert found["baro_delay_s"] == pytest.approx(0.2, abs=0.02)
    assert found["compass_delay_s"] == 0.0


@pytest.mark.parametrize(
    ("missing", "gone", "left"),
    [
        ("gps", {"gps_north", "gps_velocity_east", "motion_east", "gps_down"}, {"accel_z", "compass", "gyro_x"}),
        ("barometer", {"baro", "gps_down"}, {"accel_z", "gps_north", "gps_velocity_east"}),
        ("magnetometer", {"compass"}, {"baro", "gyro_z"}),
    ],
)
def test_a_missing_sensor_takes_its_faults_with_it(missing: str, gone: set[str], left: set[str]) -> None:
    whole, _ = truth.transformed(truth.signals(0.1))
    transform = Strapdown({missing: 0.0}, 100.0, 25.0)
    keep = [whole.signals.index(name) for name in transform.signals]
    samples = truth.fed(transform, noisy(truth.signals(40.0), 9)[:, keep])
    data = [Segment(np.array([s.u for s in samples]), np.array([s.y for s in samples]))]
    fit = identify_inertial(InertialData(data, transform.inputs, transform.outputs, 25.0, WASHOUTS))
    plant = inertial_plant(fit, "vehicle")
    names = {name for found in inertial_hypotheses(plant) for name in found}
    assert not names & gone
    assert left <= names
    assert set(smallest_faults(fit)) == names
    assert all(_designs(plant))


def _designs(plant: Plant) -> list[bool]:
    return [certify(one.plant, one.design).holds for one in inertial_bank(plant)]


def test_too_little_recording_is_said_so() -> None:
    transform, _ = truth.transformed(truth.signals(0.1))
    data = [segment(truth.signals(15.0))]
    with pytest.raises(ModelError, match="at least 20 s"):
        identify_inertial(InertialData(data, transform.inputs, transform.outputs, 25.0, WASHOUTS))


@pytest.mark.parametrize("judged", [*permutations(ACCELEROMETERS)])
def test_sensors_that_come_once_a_second_are_fitted_in_their_order(judged: tuple[str, ...]) -> None:
    transform, _ = truth.transformed(truth.signals(0.1))
    rng, outputs = np.random.default_rng(4), (*transform.outputs, *judged)
    flight = Segment(rng.normal(size=(150, len(transform.inputs))), rng.normal(size=(150, len(outputs))))
    fit = identify_inertial(InertialData([flight], transform.inputs, outputs, 1.0, WASHOUTS))
    assert all(0.0 < size < 100.0 for size in fit.noise.values())
    assert tuple(name for name in fit.noise if name in judged) == judged


@pytest.mark.parametrize(("off", "watched"), [(0.02, True), (2.0, False)])
def test_a_compass_that_healthy_flight_turns_around_is_not_watched(off: float, watched: bool) -> None:
    headings = off * np.random.default_rng(3).standard_t(3.0, size=(4000, 1))
    compass = FaultChannel("compass", "sensor", "rad", None)
    found = sensor_alarms([compass], [np.abs(headings)], [], 25.0, {"compass": 0.17}, ())
    assert [alarm.rule.channel for alarm in found] == ["compass"] * watched


@pytest.mark.parametrize(("kind", "bent_from"), [(np.float32, BENT_SINGLE), (np.float64, BENT_DOUBLE)])
def test_lines_between_slow_measurements_are_found_although_numbers_are_rounded(
    kind: type[np.floating[Any]], bent_from: float
) -> None:
    """A height measured 5 times a second, told 250 times a second on the lines between, and sampled at 25 Hz."""
    times, measured = np.arange(0.0, 40.0, 0.004), np.arange(0.0, 41.0, 0.2)
    heights = 40.0 + np.random.default_rng(0).normal(scale=0.1, size=len(measured))
    told = np.interp(times, measured, heights).astype(kind).astype(np.float64)
    grid = np.arange(0.0, 39.0, 0.04)
    count = len(grid)
    always, stamps, nothing = np.ones(count, np.bool_), np.arange(count), np.zeros((count, 1), np.bool_)
    u = np.interp(grid, times, told)[:, None]
    samples = Samples(stamps, stamps, stamps, u, u[:, :0], always, always, stamps, always, nothing)
    assert line_s([Flight(samples, always)], 0, 25.0, bent_from) == 0.2


def heights(noise: float, moves: float, readings: int) -> FloatArray:
    """Return a barometer's readings in steps of 1, 10 a second, each held for 10 ticks (10 * readings, 1)."""
    rng, times = np.random.default_rng(1), 0.1 * np.arange(readings)
    read = np.round(noise * rng.normal(size=readings) + moves * np.sin(0.5 * times))
    return np.repeat(read, 10)[:, None]


@pytest.mark.parametrize("moves", [0.0, 20.0])
@pytest.mark.parametrize(("noise", "known"), [(0.0, False), (0.5, False), (20.0, True), (100.0, True)])
def test_a_noisy_barometer_is_frozen_where_it_repeats_a_reading_longer_than_chance_allows(
    noise: float, moves: float, known: bool
) -> None:
    u = heights(noise, moves, 2000)
    always, stamps = np.ones(len(u), np.bool_), np.arange(len(u))
    samples = Samples(stamps, stamps, stamps, u, u[:, :0], ~always, always, stamps, always, np.isnan(u))
    found = frozen_times([Flight(samples, always)], [Channel(BAROMETER[0], "VFR_HUD", "alt")], 100.0, 0.1)
    assert bool(found) == known
    if not known:
        return
    hold, reading = (round(100.0 * found[f"baro_{time}_s"]) for time in ("frozen", "reading"))
    assert hold <= 500
    # ten hours without motion and with a third of the noise, at a tenth of a false alarm an hour
    calm = heights(noise / _CALMER, 0.0, 360_000)
    signals, none = np.column_stack([np.arange(len(calm)) * 1.0, calm]), np.zeros((len(calm), 2), np.uint8)
    frozen = Frozen([1], [1], [hold], [reading], 1).run(signals, none, none[:, 0].copy())[:, 0]
    assert np.count_nonzero(np.diff(frozen.astype(int)) > 0) <= 2
