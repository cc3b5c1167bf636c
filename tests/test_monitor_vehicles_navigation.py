"""The navigation of the strapdown transform names the gyro or accelerometer that went wrong, on exact truth."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest
import strapdown_truth as truth
from numpy.typing import NDArray
from sampled import raw_samples, rows

from adapters.sample import Samples
from monitor.vehicles.inertial.identify import SMALLEST_GYRO
from monitor.vehicles.inertial.strapdown import DEFAULTS, Strapdown

LEVEL = 12.1
FIELD = {**DEFAULTS, "judge_level": LEVEL, "field_noise": 0.01, "field_walk": 0.005}
MAG = slice(15, 18)
ONSET, END = 2000, 3000
NAMES = ("gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z")


def named(raw: NDArray[np.float64], parameters: Mapping[str, float] = FIELD) -> dict[str, NDArray[np.float64]]:
    """Return what each sensor is held to read too much at every tenth of a second."""
    transform = Strapdown(parameters, truth.SIGNAL_HZ, truth.RATE_HZ)
    assert transform.navigation is not None
    found = []
    for first in range(0, len(raw), 10):
        transform.run(part(raw, first, 10))
        found.append(transform.navigation.faults)
    return dict(zip(NAMES, np.array(found).T, strict=True))


def part(raw: NDArray[np.float64], first: int, count: int) -> Samples:
    """Return some samples of a recording, of which only the first one begins anew."""
    samples = raw_samples(raw[first : first + count], first)
    samples.restart[:] = np.arange(len(samples)) + first == 0
    return samples


def noisy(seconds: float, seed: int) -> NDArray[np.float64]:
    raw = truth.signals(seconds, start_s=300.0)
    rng = np.random.default_rng(seed)
    raw[:, :3] += 0.05 * rng.normal(size=(len(raw), 3))
    raw[:, 3:6] += 0.002 * rng.normal(size=(len(raw), 3))
    north, east = (raw[:, 12] * f(np.radians(raw[:, 13])) for f in (np.cos, np.sin))
    # a receiver gives five velocities a second, which are off by as much as each of them is
    off = np.repeat(0.05 * rng.normal(size=(len(raw) // 20 + 1, 2)), 20, axis=0)[: len(raw)]
    north, east = north + off[:, 0], east + off[:, 1]
    raw[:, 12], raw[:, 13] = np.hypot(north, east), np.degrees(np.arctan2(east, north)) % 360.0
    return raw


def others(found: dict[str, NDArray[np.float64]], name: str) -> float:
    return max(float(np.max(np.abs(sizes))) for other, sizes in found.items() if other != name)


def test_nothing_is_named_in_healthy_flight() -> None:
    assert others(named(noisy(120.0, 1)), "") == 0.0


@pytest.mark.parametrize("apart_s", [0.5, 1.0])
def test_a_gyro_is_named_with_its_size_where_fixes_are_slow(apart_s: float) -> None:
    raw = noisy(45.0, 2)
    course, ticks = np.radians(raw[:, 13]), np.arange(len(raw))
    fixes = ticks[:: round(apart_s * truth.SIGNAL_HZ)]
    # the sampler gives speed and course of a line between two velocities
    north, east = (np.interp(ticks, fixes, (raw[:, 12] * f(course))[fixes]) for f in (np.cos, np.sin))
    raw[:, 12], raw[:, 13] = np.hypot(north, east), np.degrees(np.arctan2(east, north)) % 360.0
    transform = Strapdown(FIELD, truth.SIGNAL_HZ, truth.RATE_HZ)
    transform.run(part(raw, 0, len(raw)))
    assert transform.scores.max() < 0.15 * LEVEL
    raw[ONSET:END, 3] += 0.06
    found = named(raw)
    assert found["gyro_x"][ONSET // 10 + 30 : END // 10] == pytest.approx(0.06, rel=0.15)
    assert found["gyro_x"][END // 10 + 30 :] == pytest.approx(0.0)
    assert others(found, "gyro_x") == 0.0


def test_a_receiver_whose_noise_doubles_in_flight_is_no_fault() -> None:
    raw, rng = noisy(60.0, 8), np.random.default_rng(18)
    off = np.repeat(0.1 * rng.normal(size=len(raw) // 20), 20)
    off[:ONSET] = 0.0
    transform = Strapdown(FIELD, truth.SIGNAL_HZ, truth.RATE_HZ)
    transform.run(part(led(raw, off), 0, len(raw)))
    assert transform.scores.max() < LEVEL


@pytest.mark.parametrize("onset", range(2000, 2160, 20))
def test_a_velocity_that_a_touchdown_stops_is_no_fault_at_whichever_fix_it_shows(onset: int) -> None:
    raw = noisy(30.0, 8)
    off = np.where(np.arange(len(raw)) < onset, 0.0, 0.5)
    transform = Strapdown(FIELD, truth.SIGNAL_HZ, truth.RATE_HZ)
    transform.run(part(led(raw, off), 0, len(raw)))
    assert transform.scores.max() < LEVEL


@pytest.mark.parametrize("seed", [0, 2, 4])
def test_samples_that_vibration_throws_about_are_no_fault(seed: int) -> None:
    raw, rng = noisy(60.0, seed), np.random.default_rng(seed)
    raw[:, :3] += 2.0 * rng.normal(size=(len(raw), 3))
    raw[:, 3:6] += 0.05 * rng.normal(size=(len(raw), 3))
    assert others(named(raw), "") == 0.0


@pytest.mark.parametrize("field_late_s", [0.03, 0.06, 0.12])
def test_gyros_and_a_field_that_are_late_make_no_fault_in_fast_turns(field_late_s: float) -> None:
    t, late_s = np.arange(12_000) / truth.SIGNAL_HZ, 0.06
    rate, speed = 2.0 * np.tanh(20.0 * np.sin(0.5 * t)), 5.0
    yaw = np.cumsum(rate) / truth.SIGNAL_HZ
    raw = np.zeros((len(t), 18))
    raw[:, 1], raw[:, 2] = speed * rate, -9.80665
    raw[:, 5] = np.interp(t - late_s, t, rate)
    raw[:, 8], raw[:, 9:11], raw[:, 12], raw[:, 13] = yaw, truth.HOME, speed, np.degrees(yaw) % 360.0
    headed = yaw - field_late_s * rate
    raw[:, MAG] = np.column_stack([0.21 * np.cos(headed), -0.21 * np.sin(headed), np.full(len(t), 0.43)])
    parameters = {**FIELD, "field_noise": 0.001, "compass_delay_s": 0.03}
    assert others(named(raw, parameters), "") == 0.0
    transform = Strapdown(parameters, truth.SIGNAL_HZ, truth.RATE_HZ)
    transform.run(part(raw, 0, len(raw)))
    assert transform.scores.max() < LEVEL


def test_a_field_of_the_vehicles_own_accuses_no_gyro_as_a_slow_turn_passes_the_true_heading() -> None:
    t, rate, speed = np.arange(12_000) / truth.SIGNAL_HZ, 0.1, 5.0
    raw = np.zeros((len(t), 18))
    raw[:, 1], raw[:, 2], raw[:, 5], raw[:, 8], raw[:, 9:11] = speed * rate, -9.80665, rate, rate * t, truth.HOME
    raw[:, 12], raw[:, 13] = speed, np.degrees(rate * t) % 360.0
    raw[:, MAG] = np.column_stack([0.21 * np.cos(rate * t), -0.21 * np.sin(rate * t), np.full(len(t), 0.43)])
    raw[ONSET:, 16] += 0.1
    assert others(named(raw), "") == 0.0


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("size", [0.02, 0.1])
def test_a_bias_of_all_gyros_is_named_although_the_attitude_follows_it(axis: int, size: float) -> None:
    raw = noisy(45.0, 2)
    raw[ONSET:END, 3 + axis] += size
    # the autopilot's attitude drifts away with its gyros, and goes on from there
    drift = size * np.clip(np.arange(len(raw)) - ONSET, 0, END - ONSET) / truth.SIGNAL_HZ
    raw[:, 6 + axis] += 0.9 * drift
    name = f"gyro_{'xyz'[axis]}"
    found = named(raw)
    within = round(10 * (4.0 if size < 0.05 else 2.0))
    assert found[name][ONSET // 10 + within] == pytest.approx(size, rel=0.3)
    assert found[name][END // 10 + 50 :] == pytest.approx(0.0)
    # less than what is worth an alarm, where the attitude was a radian off
    assert others(found, name) < SMALLEST_GYRO


@pytest.mark.parametrize("turned", [0.8, 2.5])
def test_an_autopilot_that_sets_its_heading_to_a_wrong_one_makes_no_fault(turned: float) -> None:
    raw = noisy(60.0, 5)
    raw[ONSET:, 8] += turned
    assert others(named(raw, {**DEFAULTS, "judge_level": LEVEL}), "") == 0.0


def test_without_a_magnetic_field_gyro_z_is_not_judged() -> None:
    raw = noisy(45.0, 2)
    raw[ONSET:END, 5] += 0.1
    assert np.all(named(raw, {**DEFAULTS, "judge_level": LEVEL})["gyro_z"] == 0.0)


@pytest.mark.parametrize("onset", [1700, 2000, 2150, 2600])
def test_a_compass_that_is_wrong_is_no_fault_of_a_gyro_although_the_attitude_follows_it(onset: int) -> None:
    raw = noisy(55.0, 8)
    # a field of the vehicle's own, half as strong as the horizontal one: its error changes as the vehicle turns
    raw[onset : onset + 2000, MAG.start] += 0.5 * np.hypot(raw[0, MAG.start], raw[0, MAG.start + 1])
    since = np.arange(len(raw)) - onset
    raw[:, 8] += 0.4 * (np.clip(since, 0, 300) - np.clip(since - 2000, 0, 300)) / 300.0
    assert others(named(raw), "") == 0.0


@pytest.mark.parametrize("axis", [0, 1])
def test_a_bias_of_all_accelerometers_is_named_in_body_axes(axis: int) -> None:
    raw = noisy(45.0, 3)
    raw[ONSET:END, axis] += 0.6
    name = f"accel_{'xy'[axis]}"
    found = named(raw)
    assert found[name][ONSET // 10 + 40] == pytest.approx(0.6, rel=0.25)
    assert found[name][END // 10 + 30 :] == pytest.approx(0.0)
    assert others(found, name) == 0.0


@pytest.mark.parametrize(
    ("name", "size", "last_sd"),
    [
        ("gyro_x", 0.02, 0.003),
        ("gyro_y", 0.1, 0.003),
        ("gyro_z", 0.1, 0.005),
        ("accel_x", 0.6, 0.09),
        ("accel_y", 0.6, 0.07),
    ],
)
def test_the_size_of_a_fault_is_within_twice_its_standard_deviation(name: str, size: float, last_sd: float) -> None:
    raw = noisy(30.0, 7)
    raw[ONSET:, {"gyro_x": 3, "gyro_y": 4, "gyro_z": 5, "accel_x": 0, "accel_y": 1}[name]] += size
    transform = Strapdown(FIELD, truth.SIGNAL_HZ, truth.RATE_HZ)
    assert transform.navigation is not None
    within = []
    for first in range(0, len(raw), 100):
        given = transform.run(part(raw, first, 100))
        fault = transform.navigation.faults[NAMES.index(name)]
        within.append(abs(fault - size) <= 2.0 * given.spread[name][-1] < size)
        assert given.sizes[name][-1] == fault
    assert not any(within[: ONSET // 100])
    # sizes a second apart hardly differ: all of them but the first are right, or none is
    assert np.mean(within[ONSET // 100 + 5 :]) >= 0.8
    # what neither showed before the fault nor since, as a bias that a tilt hides, is no error of its size
    assert given.spread[name][-1] < last_sd


def led(raw: NDArray[np.float64], away: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a recording in which the GPS's velocity north is off by so much (n,)."""
    course = np.radians(raw[:, 13])
    north, east = raw[:, 12] * np.cos(course) + away, raw[:, 12] * np.sin(course)
    raw = raw.copy()
    raw[:, 12], raw[:, 13] = np.hypot(north, east), np.degrees(np.arctan2(east, north))
    return raw


def gps_apart(raw: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return by how much speed and acceleration are apart from the GPS, washed out as the outputs are (n, 4)."""
    transform = Strapdown(FIELD, truth.SIGNAL_HZ, truth.RATE_HZ)
    samples = transform.run(raw_samples(raw, 0)).samples
    washed = np.zeros((len(samples), 4))
    for i, name in enumerate(("gps_north", "gps_east", "gps_velocity_north", "gps_velocity_east")):
        tau = DEFAULTS["washout_s" if i < 2 else "velocity_washout_s"]
        keep = np.exp(-1.0 / (tau * truth.RATE_HZ))
        for k in range(1, len(washed)):
            washed[k, i] = keep * washed[k - 1, i] + tau * (1.0 - keep) * samples.u[k - 1, i]
        washed[:, i] -= samples.y[:, transform.outputs.index(name)]
    return washed


def test_a_bias_of_accelerometer_z_that_manoeuvres_tilt_is_no_ramp_of_the_gps() -> None:
    t, rng = np.arange(6000) / truth.SIGNAL_HZ, np.random.default_rng(0)
    pitch = 0.4 * np.sin(2.0 * np.pi * t / 8.0) ** 3
    north = np.cumsum(-9.80665 * np.tan(pitch)) / truth.SIGNAL_HZ
    north += np.repeat(0.05 * rng.normal(size=len(t) // 20), 20) - north.mean()
    raw = np.zeros((len(t), 18))
    raw[:, 2], raw[:, 4], raw[:, 7] = -9.80665 / np.cos(pitch), np.gradient(pitch, t), pitch
    raw[:, :3] += 0.05 * rng.normal(size=(len(t), 3))
    raw[:, 9:11], raw[:, 12], raw[:, 13] = truth.HOME, np.abs(north), np.where(north < 0.0, 180.0, 0.0)
    dip = np.arctan2(0.43, 0.21) + pitch
    raw[:, MAG] = np.column_stack([0.48 * np.cos(dip), np.zeros(len(t)), 0.48 * np.sin(dip)])
    raw[ONSET:, 2] += 0.6
    found = named(raw)
    assert found["accel_z"][-1] == pytest.approx(0.6, abs=0.05)
    assert others(found, "accel_z") == 0.0


def test_a_velocity_of_the_gps_that_jumps_is_no_fault_of_the_imu() -> None:
    raw = noisy(45.0, 4)
    assert others(named(led(raw, np.where(np.arange(len(raw)) > ONSET, 1.0, 0.0))), "") == 0.0


@pytest.mark.parametrize(("acceleration", "seen"), [(0.15, False), (0.5, True)])
def test_a_velocity_of_the_gps_that_is_led_away_is_no_fault_of_the_imu_and_right_again_once_it_jumps_back(
    acceleration: float, seen: bool
) -> None:
    raw = noisy(75.0, 4)
    since = (np.arange(len(raw)) - ONSET) / truth.SIGNAL_HZ
    back = 5000
    away = np.where(np.arange(len(raw)) < back, acceleration * np.clip(since, 0.0, None), 0.0)
    spoofed = led(raw, away)
    # what was led away with its velocity
    spoofed[:, 9] += (
        np.where(away > 0.0, 0.5 * acceleration * since**2, 0.0) / truth.metres_per_degree(truth.HOME[0])[0]
    )
    assert others(named(spoofed), "") == 0.0
    difference = np.abs(gps_apart(spoofed) - gps_apart(raw))
    # a second before it ends nothing was forgotten of what was seen; a second later nothing is left, seen or not
    assert difference[(back - 100) // 4, 2] == pytest.approx(14.5 if seen else 0.0, rel=0.2, abs=0.2)
    assert difference[(back + 100) // 4 :, :2].max() < 0.5
    assert difference[(back + 100) // 4 :, 2:].max() < 0.3


def test_a_velocity_that_left_its_position_behind_leads_no_position_back() -> None:
    raw = noisy(60.0, 4)
    since, back = (np.arange(len(raw)) - ONSET) / truth.SIGNAL_HZ, 5000
    away = led(raw, np.where(np.arange(len(raw)) < back, 0.15 * np.clip(since, 0.0, None), 0.0))
    difference = np.abs(gps_apart(away) - gps_apart(raw))[:, 0]
    # the washout forgets within 30 s what the position has been off
    assert difference[(back + 200) // 4] == pytest.approx(difference[back // 4], rel=0.15)


@pytest.mark.parametrize(("size", "pulse"), [(0.05, 0.3), (0.1, -0.2)])
def test_a_tilt_that_a_gyros_fault_leaves_is_no_gps_that_is_led_away(size: float, pulse: float) -> None:
    raw = noisy(75.0, 4)
    raw[ONSET:, 4] += size
    uneven = raw.copy()
    uneven[3000:3050, 4] += pulse
    difference = np.abs(gps_apart(uneven) - gps_apart(raw))
    assert difference[900:].max() < 1.0


def test_a_position_that_is_off_stays_so_as_the_navigation_begins_anew_after_a_gyros_fault() -> None:
    raw = noisy(60.0, 4)
    since = (np.arange(len(raw)) - ONSET) / truth.SIGNAL_HZ
    for began_s, size in ((0.0, 0.1), (20.0, -0.1)):
        raw[:, 4] += np.where(since >= began_s, size * np.exp(-np.clip(since - began_s, 0.0, None)), 0.0)
    moved = raw.copy()
    moved[ONSET + 1900 :, 9] += 6.0 / truth.metres_per_degree(truth.HOME[0])[0]
    off = np.abs(gps_apart(moved) - gps_apart(raw))[:, 0]
    # but for what is washed out
    assert off[-1] == pytest.approx(6.0 * np.exp(-21.0 / DEFAULTS["washout_s"]), rel=0.05)


def test_the_accelerometers_fault_is_an_output_and_none_of_it_is_left_in_the_accelerations() -> None:
    raw = noisy(40.0, 5)
    raw[ONSET:, 0] += 0.6
    transform = Strapdown({**DEFAULTS, "judge_level": LEVEL}, truth.SIGNAL_HZ, truth.RATE_HZ)
    samples = rows(transform.run(raw_samples(raw, 0)).samples)
    y = np.array([sample.y for sample in samples])
    assert y[-200:, transform.outputs.index("accel_x")] == pytest.approx(0.6, rel=0.25)
    healthy = Strapdown(DEFAULTS, truth.SIGNAL_HZ, truth.RATE_HZ)
    without = rows(healthy.run(raw_samples(noisy(40.0, 5), 0)).samples)
    north = transform.inputs.index("acceleration_north")
    apart = [a.u[north] - b.u[north] for a, b in zip(samples[-200:], without[-200:], strict=True)]
    assert abs(np.mean(apart)) < 0.1


def test_how_samples_are_cut_into_batches_changes_no_bit() -> None:
    raw = noisy(30.0, 6)
    raw[ONSET:, 4] += 0.05
    whole = Strapdown(FIELD, truth.SIGNAL_HZ, truth.RATE_HZ)
    expected = whole.run(raw_samples(raw, 0)).samples.y
    parts = Strapdown(FIELD, truth.SIGNAL_HZ, truth.RATE_HZ)
    found = [parts.run(part(raw, first, 37)).samples.y for first in range(0, len(raw), 37)]
    assert np.array_equal(np.concatenate(found), expected)


def test_the_end_of_a_gyros_bias_is_one_step_to_nothing() -> None:
    raw = noisy(45.0, 4)
    raw[ONSET:END, 4] += 0.1
    sizes = named(raw)["gyro_y"][END // 10 :]
    ended = int(np.flatnonzero(sizes == 0.0)[0])
    assert ended <= 25
    assert np.all(sizes[ended:] == 0.0)
    assert np.all(sizes[:ended] > 0.05)


@pytest.mark.parametrize("axis", [0, 1])
def test_a_gyros_fault_that_an_autopilot_learns_and_unlearns_accuses_nothing_once_it_is_over(axis: int) -> None:
    raw = noisy(60.0, 4)
    since = (np.arange(len(raw)) - ONSET) / truth.SIGNAL_HZ
    # what is sent is less the bias that was learned: a pulse at the beginning, and the opposite one at the end
    for began_s, size in ((0.0, 0.1), (20.0, -0.1)):
        raw[:, 3 + axis] += np.where(since >= began_s, size * np.exp(-np.clip(since - began_s, 0.0, None)), 0.0)
    found = named(raw)
    assert np.max(found[NAMES[axis]]) > 0.02
    assert others(found, NAMES[axis]) == 0.0
    assert np.all(found[NAMES[axis]][ONSET // 10 + 100 :] == 0.0)


def test_another_fault_after_one_of_a_gyro_is_named() -> None:
    raw = noisy(75.0, 4)
    raw[ONSET:END, 4] += 0.1
    raw[5000:, 3] += 0.1
    found = named(raw)
    assert found["gyro_x"][530] == pytest.approx(0.1, rel=0.3)
    assert np.all(found["gyro_x"][:500] == 0.0)


def test_after_a_gyros_fault_the_compass_is_levelled_by_the_navigation() -> None:
    raw = noisy(45.0, 2)
    faulty = raw.copy()
    faulty[ONSET:END, 3] += 0.05
    # the autopilot's attitude is half a radian off from then on
    faulty[:, 6] += 0.05 * np.clip(np.arange(len(raw)) - ONSET, 0, END - ONSET) / truth.SIGNAL_HZ
    headings = []
    for signals in (raw, faulty):
        transform = Strapdown(FIELD, truth.SIGNAL_HZ, truth.RATE_HZ)
        y = transform.run(raw_samples(signals, 0)).samples.y
        headings.append(y[:, transform.outputs.index("heading")])
    apart = headings[1] - headings[0]
    # what is left of the step at the onset is forgotten with the washout, and nothing is added
    kept = np.exp(-1.0 / (30.0 * truth.RATE_HZ))
    assert np.abs(apart[1:] - kept * apart[:-1])[END // 4 + 100 :].max() < 0.01


def test_while_the_compass_is_wrong_the_rotation_lacks_what_a_gyro_always_reads_too_much() -> None:
    raw = noisy(60.0, 9)
    wrong = raw.copy()
    wrong[:, 5] += 0.003
    wrong[ONSET:, MAG.start] += 0.5 * np.hypot(raw[0, MAG.start], raw[0, MAG.start + 1])
    rotations = []
    for signals in (raw, wrong):
        transform = Strapdown(FIELD, truth.SIGNAL_HZ, truth.RATE_HZ)
        y = transform.run(raw_samples(signals, 0)).samples.y
        rotations.append(y[:, transform.outputs.index("rotation_z")])
    # 0.003 rad/s would be 0.09 rad in 40 s of a washout of 30 s
    assert np.abs(rotations[1] - rotations[0])[ONSET // 4 :].max() < 0.03


def bias_told(raw: NDArray[np.float64], axis: str, angle_s: float = 2.0) -> tuple[NDArray[np.float64], Samples]:
    """Return what an observer behind the transform takes the bias of a gyro for, T f^' = f - f^, and its samples."""
    transform = Strapdown({**FIELD, f"bias_angle_{axis}_s": angle_s}, truth.SIGNAL_HZ, truth.RATE_HZ)
    samples = transform.run(raw_samples(raw, 0)).samples
    y = samples.y[:, transform.outputs.index(f"rotation_{axis}")]
    rate = samples.u[:, transform.inputs.index(f"rate_{axis}")]
    dt, told = 1.0 / truth.RATE_HZ, np.zeros(len(y))
    for k, angle in enumerate(unwashed(y)):
        told[k + 1] = told[k] + (rate[k] * dt - angle - told[k] * dt) / angle_s
    return told, samples


def unwashed(y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the changes of an angle that the transform has washed out."""
    dt, washout_s = 1.0 / truth.RATE_HZ, DEFAULTS["washout_s"]
    kept = np.exp(-dt / washout_s)
    return (y[1:] - kept * y[:-1]) * dt / (washout_s * (1.0 - kept))


def test_once_an_accelerometer_is_to_blame_nothing_is_left_of_the_gyro_that_a_misled_attitude_accused() -> None:
    raw = noisy(45.0, 3)
    raw[ONSET:, 0] += 0.6
    # the autopilot levels itself by that accelerometer
    raw[:, 7] += 0.06 * np.clip(np.arange(len(raw)) - ONSET, 0, 300) / 300.0
    told, samples = bias_told(raw, "y")
    [blamed] = np.flatnonzero(~samples.complete)
    assert np.abs(told[ONSET // 4 : blamed]).max() > 0.01
    assert np.abs(told[blamed + 2 :]).max() < 0.001


def test_after_a_gyros_fault_an_attitude_that_heads_elsewhere_accuses_none() -> None:
    raw = noisy(110.0, 4)
    raw[ONSET:END, 5] += 0.1
    # the autopilot has learned that bias: its heading goes on to turn away long after the end
    raw[:, 8] += 0.01 * np.clip(np.arange(len(raw)) - END, 0, None) / truth.SIGNAL_HZ
    told, _ = bias_told(raw, "z")
    assert np.abs(told[END // 4 + 100 :]).max() < 0.002


def test_the_size_of_a_compass_fault_is_within_twice_its_standard_deviation() -> None:
    raw = noisy(50.0, 7)
    R = truth.rotation(300.0 + np.arange(ONSET, len(raw)) / truth.SIGNAL_HZ)
    c, s = np.cos(0.6), np.sin(0.6)
    turned = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    raw[ONSET:, MAG] = np.einsum("nji,jk,nkl,nl->ni", R, turned, R, raw[ONSET:, MAG])
    # by this the heading that gyros tell drifts
    raw[:, 5] += 0.002
    transform = Strapdown(FIELD, truth.SIGNAL_HZ, truth.RATE_HZ)
    given = transform.run(raw_samples(raw, 0))
    changes = unwashed(given.samples.y[:, transform.outputs.index("heading")])
    rate = given.samples.u[:, transform.inputs.index("heading_rate")]
    size, sd = np.cumsum(changes - rate[:-1] / truth.RATE_HZ), given.spread["compass"][1:]
    known = slice(ONSET // 4 + 8, None)
    assert np.all(sd[: ONSET // 4] == 0.0)
    error = np.abs(size[known] - size[ONSET // 4 - 4] - 0.6)
    assert np.mean(error <= 2.0 * sd[known]) > 0.9
    assert 0.02 < sd[known].max() < 0.05
