"""Deflections as effects: scaling with speed, timing, evidence, grouping and restarts."""

from dataclasses import dataclass
from math import cos, exp, pi, sin

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sampled import Row, raw_samples, rows

from adapters.errors import TelemetryError
from gains.identification.regression import lagged
from monitor.vehicles.plane.transform import SurfaceInputs
from monitor.vehicles.rover.transform import DriveInputs

RATE_HZ = 100.0
SPEEDS = {"reference_speed": 20.0, "minimum_speed": 10.0}
CRAWL = {"reference_speed": 2.0, "minimum_speed": 0.5}


@dataclass
class Raw:
    """A raw sample."""

    index: int
    values: list[float]
    restart: bool = False
    complete: bool = True


def plane(index: int, *, aileron: float = 0.1, airspeed: float = 20.0, restart: bool = False) -> Raw:
    return Raw(index, [aileron, 0.2, 0.3, 0.4, airspeed, 0.5, 0.1, 1.0, 2.0, 3.0, 4.0, 5.0, -9.0], restart)


def rover(index: int, steering: float, speed: float, yaw: float = 0.0, *, restart: bool = False) -> Raw:
    return Raw(index, [steering, 0.3, speed * cos(yaw), speed * sin(yaw), yaw, 0.7, 0.9], restart)


def given_out(transform: SurfaceInputs | DriveInputs, raw: list[Raw]) -> list[Row]:
    samples = raw_samples(np.array([one.values for one in raw]))
    samples.index[:] = [one.index for one in raw]
    samples.vehicle_time_ns[:] = samples.index * 10_000_000
    samples.restart[:] = [one.restart for one in raw]
    samples.complete[:] = [one.complete for one in raw]
    return rows(transform.run(samples).samples)


@given(airspeed=st.floats(10.0, 40.0))
def test_surfaces_act_with_the_square_of_airspeed_and_damping_with_airspeed(airspeed: float) -> None:
    (sample,) = given_out(SurfaceInputs(SPEEDS, RATE_HZ, RATE_HZ), [plane(0, airspeed=airspeed, restart=True)])
    u = dict(zip(SurfaceInputs.inputs, sample.u, strict=True))
    s = airspeed / 20.0
    assert [u["aileron"], u["elevator"], u["rudder"]] == pytest.approx([0.1 * s * s, 0.2 * s * s, 0.3 * s * s])
    assert (u["throttle"], u["pressure"]) == pytest.approx((0.4, s * s))
    assert [u["roll_damping"], u["pitch_damping"], u["yaw_damping"]] == pytest.approx(
        [s - 1.0, 2.0 * (s - 1.0), 3.0 * (s - 1.0)], abs=1e-12
    )
    assert (u["side_force"], u["normal_force"]) == (5.0, -9.0)
    assert u["lift_drag"] == pytest.approx(81.0 / s**2)
    assert sample.y.tolist() == [1.0, 2.0, 3.0, 4.0]


def test_too_slow_an_airspeed_is_no_evidence_and_no_division_by_zero() -> None:
    samples = [plane(0, airspeed=0.0, restart=True), plane(1, airspeed=9.0), plane(2, airspeed=11.0)]
    found = given_out(SurfaceInputs(SPEEDS, RATE_HZ, RATE_HZ), samples)
    assert [any(sample.lost) for sample in found] == [True, True, False]
    assert all(sample.measured for sample in found)
    assert all(np.isfinite(sample.u).all() for sample in found)


def test_an_airspeed_that_jumps_unfelt_is_no_evidence_for_two_seconds() -> None:
    felt = 4.0 - 9.80665 * np.sin(0.1)

    def evidence(after: list[float]) -> list[bool]:
        speeds = [20.0] * 50 + after
        raw = [plane(k, airspeed=speed, restart=k == 0) for k, speed in enumerate(speeds)]
        return [not any(sample.lost) for sample in given_out(SurfaceInputs(SPEEDS, RATE_HZ, RATE_HZ), raw)][50:]

    jumped = evidence([15.0] * 300)
    assert not any(jumped[:200])
    assert all(jumped[250:])
    assert all(evidence([20.0 + felt * k / RATE_HZ for k in range(300)]))


@given(speed=st.floats(-8.0, 8.0), yaw=st.floats(-pi, pi), steering=st.floats(-1.0, 1.0))
def test_steering_acts_with_the_speed_along_the_heading_also_in_reverse(
    speed: float, yaw: float, steering: float
) -> None:
    transform = DriveInputs(CRAWL | {"steering_cubic": -0.1}, RATE_HZ, RATE_HZ)
    (sample,) = given_out(transform, [rover(0, steering, speed, yaw, restart=True)])
    assert sample.u == pytest.approx([(steering - 0.1 * steering**3) * speed / 2.0, 0.3, speed / 2.0], abs=1e-9)
    assert sample.y.tolist() == [0.7, 0.9]


def test_mixed_outputs_act_as_the_actuators_that_they_are_mixed_of() -> None:
    plain = plane(0, aileron=0.1, restart=True)
    (sample,) = given_out(SurfaceInputs(SPEEDS, RATE_HZ, RATE_HZ), [plain])
    for parameter, first in (("elevons", 0), ("v_tail", 2)):
        mixed = plane(0, restart=True)
        difference, mean = plain.values[first], plain.values[1]
        mixed.values[first], mixed.values[1] = mean + difference, mean - difference
        transform = SurfaceInputs(SPEEDS | {parameter: 1.0}, RATE_HZ, RATE_HZ)
        (found,) = given_out(transform, [mixed])
        assert found.u == pytest.approx(sample.u)
        assert transform.signals[first] == {"elevons": "elevon_left", "v_tail": "tail_left"}[parameter]


@pytest.mark.parametrize("speed", [-3.0, 0.6, 8.0])
def test_wheels_of_two_sides_steer_by_their_difference_at_every_speed(speed: float) -> None:
    transform = DriveInputs(CRAWL | {"sides": 1.0, "differential": 1.0}, RATE_HZ, RATE_HZ)
    (sample,) = given_out(transform, [rover(0, 0.7, speed, restart=True)])  # 0.7 left, 0.3 right
    assert sample.u == pytest.approx([0.2, 0.5, speed / 2.0])


def test_a_standing_rover_gives_no_evidence() -> None:
    samples = [rover(0, 1.0, 0.1, restart=True), rover(1, 1.0, -0.1), rover(2, 1.0, -0.9)]
    found = given_out(DriveInputs(CRAWL, RATE_HZ, RATE_HZ), samples)
    assert [any(sample.lost) for sample in found] == [True, True, False]
    assert all(sample.measured for sample in found)


def test_a_standing_rover_lacks_nothing_but_what_does_not_come() -> None:
    samples = raw_samples(np.array([rover(0, 0.1, speed).values for speed in (0.0, 1.0, 0.0)]))
    samples.index[:], samples.lost[2, 0] = range(3), True
    unflown = DriveInputs(CRAWL, RATE_HZ, RATE_HZ).run(samples).unflown
    assert unflown is not None
    assert unflown.tolist() == [True, False, False]


def test_sliding_sideways_is_no_speed() -> None:
    sliding = Raw(0, [0.5, 0.0, 0.0, 3.0, 0.0, 0.0, 0.0], restart=True)
    assert given_out(DriveInputs(CRAWL, RATE_HZ, RATE_HZ), [sliding])[0].u[2] == 0.0


def test_delay_and_lag_of_the_actuator_are_exact() -> None:
    transform = SurfaceInputs(SPEEDS | {"aileron_delay_s": 0.02, "aileron_lag_s": 0.1}, RATE_HZ, RATE_HZ)
    steps = [plane(k, aileron=0.0 if k < 5 else 1.0, restart=k == 0) for k in range(40)]
    aileron = [sample.u[0] for sample in given_out(transform, steps)]
    assert aileron[:7] == [0.0] * 7
    assert aileron[7:] == pytest.approx([1.0 - exp(-0.1 * (k + 1)) for k in range(33)])


@given(delay_s=st.floats(0.0, 0.1), lag_s=st.floats(0.0, 0.3), seed=st.integers(0, 100))
def test_the_timing_is_that_of_the_identification(delay_s: float, lag_s: float, seed: int) -> None:
    aileron = np.random.default_rng(seed).normal(size=60)
    transform = SurfaceInputs(SPEEDS | {"aileron_delay_s": delay_s, "aileron_lag_s": lag_s}, RATE_HZ, RATE_HZ)
    samples = [plane(k, aileron=float(value), restart=k == 0) for k, value in enumerate(aileron)]
    found = np.array([sample.u[0] for sample in given_out(transform, samples)])
    assert found == pytest.approx(lagged(aileron, delay_s, lag_s, RATE_HZ), abs=1e-9)


def test_groups_lie_on_the_grid_and_give_means() -> None:
    transform = DriveInputs(CRAWL, RATE_HZ, 50.0)
    samples = [rover(k, 0.0, float(k), restart=k == 5) for k in range(5, 12)]
    found = given_out(transform, samples)
    assert [sample.index for sample in found] == [3, 4, 5]
    assert [sample.u[2] for sample in found] == pytest.approx([6.5 / 2, 8.5 / 2, 10.5 / 2])
    assert [sample.restart for sample in found] == [True, False, False]
    assert [sample.vehicle_time_ns for sample in found] == [70_000_000, 90_000_000, 110_000_000]


def test_a_group_with_a_bridged_sample_is_no_evidence() -> None:
    samples = [rover(0, 0.0, 2.0, restart=True), rover(1, 0.0, 2.0), rover(2, 0.0, 2.0), rover(3, 0.0, 2.0)]
    samples[1].complete = False
    assert [s.complete for s in given_out(DriveInputs(CRAWL, RATE_HZ, 50.0), samples)] == [False, True]


def test_a_restart_forgets_the_lag_and_an_open_group() -> None:
    transform = SurfaceInputs(SPEEDS | {"aileron_lag_s": 0.3}, RATE_HZ, 50.0)
    samples = [plane(k, aileron=1.0, restart=k == 0) for k in range(3)]
    samples += [plane(k, aileron=-1.0, restart=k == 21) for k in range(21, 24)]
    found = given_out(transform, samples)
    assert [(sample.index, sample.restart, sample.u[0]) for sample in found] == [(0, True, 1.0), (11, True, -1.0)]


@pytest.mark.parametrize(
    ("parameters", "named"),
    [
        ({"reference_speed": 20.0}, "minimum_speed"),
        (SPEEDS | {"reference_speed": 0.0}, "reference_speed"),
        (SPEEDS | {"aileron_lag_s": -1.0}, "aileron_lag_s"),
        (SPEEDS | {"flap_lag_s": 0.1}, "flap_lag_s"),
        (SPEEDS | {"aileron_delay_s": float("nan")}, "aileron_delay_s"),
    ],
)
def test_a_wrong_parameter_is_named(parameters: dict[str, float], named: str) -> None:
    with pytest.raises(TelemetryError, match=named):
        SurfaceInputs(parameters, RATE_HZ, RATE_HZ)


def test_rates_that_do_not_divide_are_refused() -> None:
    with pytest.raises(TelemetryError, match="40 Hz"):
        DriveInputs(CRAWL, RATE_HZ, 40.0)
