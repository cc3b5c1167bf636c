"""The strapdown transform on a trajectory with exact truth."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import strapdown_truth as truth
from hypothesis import given
from hypothesis import strategies as st
from sampled import raw_samples, rows

from adapters.batch import pack
from adapters.errors import TelemetryError
from adapters.message import Message
from adapters.sample import Samples
from adapters.source import MAVLINK
from monitor.core.sampling import VehicleClock, sample_batch
from monitor.estimation.bank import washout_inverse
from monitor.sampling.sampler import Sampler
from monitor.vehicles.inertial.signals import strapdown_channels
from monitor.vehicles.inertial.strapdown import GPS, IMU, LEARNED, LearnedBias, Strapdown

EXAMPLES: dict[str, dict[str, Any]] = {
    "ATTITUDE": {"roll": 0.0, "pitch": 0.0, "yaw": 0.0},
    "HIGHRES_IMU": {
        **dict.fromkeys(("xacc", "yacc", "zacc", "xgyro", "ygyro", "zgyro", "ymag", "zmag"), 0.0),
        "xmag": 0.2,
        "pressure_alt": 500.0,
    },
    "GPS_RAW_INT": {"lat": 474000000, "lon": 85000000, "alt": 1000, "vel": 100, "cog": 9000},
    "SCALED_PRESSURE": {"press_abs": 950.0},
}

BARO = len(IMU + GPS)
MAG = slice(BARO + 1, BARO + 4)


def washed(rate: np.ndarray, tau: float) -> np.ndarray:
    keep = math.exp(-1.0 / (tau * truth.RATE_HZ))
    x = np.zeros(len(rate))
    for k in range(len(rate) - 1):
        x[k + 1] = keep * x[k] + tau * (1.0 - keep) * rate[k]
    return x


def disagreement(transform: Strapdown, samples: list[Any]) -> dict[str, float]:
    """Return the largest difference between each output and the washed-out integral of its input."""
    u = {name: np.array([s.u[i] for s in samples]) for i, name in enumerate(transform.inputs)}
    y = {name: np.array([s.y[i] for s in samples]) for i, name in enumerate(transform.outputs)}
    pairs = {
        "gps_north": ("speed_north", 30.0),
        "gps_east": ("speed_east", 30.0),
        "gps_velocity_north": ("acceleration_north", 10.0),
        "gps_velocity_east": ("acceleration_east", 10.0),
        "rotation_x": ("rate_x", 30.0),
        "rotation_y": ("rate_y", 30.0),
        "rotation_z": ("rate_z", 30.0),
        "heading": ("heading_rate", 30.0),
    }
    return {
        out: float(np.max(np.abs(y[out] - washed(u[source], tau))))
        for out, (source, tau) in pairs.items()
        if out in y and source in u
    }


def test_perfect_sensors_agree_with_the_integrals_of_each_other() -> None:
    errors = disagreement(*truth.transformed(truth.signals(40.0)))
    assert errors["gps_north"] < 0.01
    assert errors["gps_east"] < 0.01
    assert errors["gps_velocity_north"] < 0.01
    assert errors["gps_velocity_east"] < 0.01
    assert max(errors[f"rotation_{axis}"] for axis in "xyz") < 1e-3
    assert errors["heading"] < 1e-3


def test_both_altitudes_are_the_same_change_of_down() -> None:
    transform, samples = truth.transformed(truth.signals(10.0))
    y = np.array([s.y for s in samples])
    gps, baro = transform.outputs.index("gps_down"), transform.outputs.index("baro_down")
    assert y[:, gps] == pytest.approx(y[:, baro], abs=1e-9)
    assert np.ptp(y[:, gps]) > 3.0


def test_sensors_that_are_late_are_matched_by_their_delays() -> None:
    raw = truth.signals(40.0, gps_late_s=0.2, baro_late_s=0.1)
    late = disagreement(*truth.transformed(raw))
    transform, samples = truth.transformed(raw, {"gps_delay_s": 0.2, "baro_delay_s": 0.1})
    matched = disagreement(transform, samples)
    for axis in ("north", "east"):
        assert late[f"gps_velocity_{axis}"] > 0.2
        assert matched[f"gps_velocity_{axis}"] < 0.01
    y = np.array([s.y for s in samples])
    gps, baro = transform.outputs.index("gps_down"), transform.outputs.index("baro_down")
    assert y[:, gps] == pytest.approx(y[:, baro], abs=1e-6)


def test_samples_lie_on_the_slower_grid_and_the_first_is_a_restart() -> None:
    _, samples = truth.transformed(truth.signals(2.0), first=1003)
    assert [s.index for s in samples] == list(range(251, 251 + len(samples)))
    assert all(s.vehicle_time_ns == s.index * 40_000_000 for s in samples)
    assert [s.restart for s in samples] == [True] + [False] * (len(samples) - 1)
    assert not np.any(samples[0].y)


def test_a_mean_over_the_period_hides_no_vibration_as_a_constant() -> None:
    raw = truth.signals(4.0)
    raw[:, 3] += np.tile([1.0, -1.0, 1.0, -1.0], len(raw) // 4)
    clean = [s.u for s in truth.transformed(truth.signals(4.0))[1]]
    transform, shaken = truth.transformed(raw)
    at = transform.inputs.index("rate_x")
    assert [s.u[at] for s in shaken] == pytest.approx([u[at] for u in clean], abs=1e-12)


def test_a_tick_that_was_not_measured_spoils_the_samples_it_is_part_of_and_no_later_ones() -> None:
    transform = Strapdown({"gps_delay_s": 0.1}, truth.SIGNAL_HZ, truth.RATE_HZ)
    samples = truth.fed(transform, truth.signals(3.0), lost=frozenset({101}))
    spoiled = [s.index for s in samples if not s.complete]
    assert spoiled[0] == 25 or spoiled[0] == 24
    assert 1 <= len(spoiled) <= 5
    assert samples[-1].complete


@pytest.mark.parametrize("jump", [0.0, 8.0])
@pytest.mark.parametrize("late_s", [0.0, 0.2])
def test_a_gap_while_the_vehicle_speeds_up_leaves_the_vertical_velocity_as_it_is_and_hides_no_jump(
    jump: float, late_s: float
) -> None:
    raw, first, stop = truth.signals(8.0, gps_late_s=late_s), 200, 300
    raw[first:, BARO] += jump
    raw[first:stop] = np.linspace(raw[first - 1], raw[stop], stop - first)
    transform = Strapdown({"gps_delay_s": late_s}, truth.SIGNAL_HZ, truth.RATE_HZ)
    samples = truth.fed(transform, raw, lost=frozenset(range(first, stop)))
    period = 1.0 / truth.RATE_HZ
    a = np.array([s.u[transform.inputs.index("acceleration_down")] for s in samples])
    t = np.array([s.index for s in samples]) * period - late_s
    gained = -1.4 * (np.cos(0.7 * t) - np.cos(0.7 * t[0]))
    off = np.concatenate([[0.0], np.cumsum(a)[:-1]]) * period - gained
    assert abs(off[t < 1.9]).max() < 0.05
    assert abs(off[t > 4.0]).max() < 0.15
    gps, baro = (np.array([s.y[transform.outputs.index(name)] for s in samples]) for name in ("gps_down", "baro_down"))
    assert abs(baro - gps)[t < 1.9].max() < 0.1
    assert abs(gps - baro - jump)[(t > 3.2) & (t < 3.4)].max() < 0.1 * jump + 0.2


@pytest.mark.parametrize(("moved", "counted"), [(0.2, 0.0), (0.5, 0.5)])
def test_a_way_that_a_gap_may_hide_is_no_jump_of_the_gps(moved: float, counted: float) -> None:
    raw, lost = truth.signals(6.0), frozenset(range(300, 400))
    jumped = raw.copy()
    jumped[400:, 9] += moved / truth.metres_per_degree(truth.HOME[0])[0]
    transform = Strapdown({}, truth.SIGNAL_HZ, truth.RATE_HZ)
    north = transform.outputs.index("gps_north")
    without, found = (
        np.array([sample.y[north] for sample in truth.fed(transform, signals, lost=lost)]) for signals in (raw, jumped)
    )
    assert np.mean(found[110:120] - without[110:120]) == pytest.approx(counted, abs=0.03)


@pytest.mark.parametrize("lost", [range(500, 600), range(500, 2000, 5)])
def test_errors_are_no_larger_for_a_gps_that_was_missing_while_accelerations_were_measured(lost: range) -> None:
    samples = raw_samples(truth.signals(70.0), 0)
    samples.lost[list(lost), len(IMU) : BARO] = True
    beyond = Strapdown({}, truth.SIGNAL_HZ, truth.RATE_HZ).run(samples).beyond
    assert beyond is not None
    assert beyond == pytest.approx(1.0)


def test_accelerations_tell_the_way_between_two_fixes_of_which_some_were_lost() -> None:
    """A vehicle that speeds up by 3.2 m/s² is 0.14 m off the line over 0.6 s."""
    raw = truth.signals(20.0)
    course = np.radians(raw[:, 13])
    raw[:, 12], raw[:, 13] = raw[:, 12] * np.cos(course), raw[:, 12] * np.sin(course)
    lined, lines_ns = raw.copy(), np.zeros(raw.shape, np.int64)
    for first in range(500, 1900, 100):
        lined[first : first + 61, 9:14] = np.linspace(raw[first, 9:14], raw[first + 60, 9:14], 61)
        lines_ns[first + 1 : first + 60, 9:14] = 600_000_000
    found = []
    for signals in (raw, lined):
        north, east = signals[:, 12].copy(), signals[:, 13].copy()
        signals[:, 12], signals[:, 13] = np.hypot(north, east), np.degrees(np.arctan2(east, north)) % 360.0
        samples = replace(raw_samples(signals, 0), lines_ns=lines_ns * (signals is lined))
        transform = Strapdown({"judge_level": 12.1}, truth.SIGNAL_HZ, truth.RATE_HZ)
        found.append(transform.run(samples).samples.y[:, :2])
    assert np.abs(found[1] - found[0]).max() < 0.03


def test_accelerations_that_come_seldom_give_a_missing_gps_no_height_beside_a_barometer() -> None:
    """Accelerometer z reads 3 m/s² too much, 1350 m within the 30 s without the GPS."""
    raw = truth.signals(60.0)
    raw[:, 2] += 3.0
    samples = raw_samples(raw, 0)
    samples.lost[2000:5000, len(IMU) : BARO] = True
    transform = Strapdown({}, truth.SIGNAL_HZ, truth.RATE_HZ)
    y = transform.run(samples).samples.y
    gps, baro = (y[:, transform.outputs.index(name)] for name in ("gps_down", "baro_down"))
    assert abs(gps - baro).max() < 0.2


@pytest.mark.parametrize("jump", [0.0, 12.0])
def test_without_an_imu_a_gap_hides_the_way_between_two_velocities_and_no_jump(jump: float) -> None:
    """The level vehicle's speed changes by 5.7 m/s within the 2 s without the GPS, its way by 6 m."""
    raw = truth.signals(8.0)
    raw[:, : len(IMU)] = [0.0, 0.0, -9.80665, *[0.0] * 6]
    raw[600:, 9] += jump / truth.metres_per_degree(truth.HOME[0])[0]
    samples = raw_samples(raw, 0)
    samples.lost[400:600, len(IMU) : BARO] = True
    transform = Strapdown({}, truth.SIGNAL_HZ, truth.RATE_HZ)
    off = disagreement(transform, rows(transform.run(samples).samples))
    assert off["gps_north"] == pytest.approx(jump, abs=0.5)


def over_gaps(raw: np.ndarray, gaps: np.ndarray, ticks: int) -> Samples:
    """Return raw signals whose IMU and attitude lie on straight lines over so many ticks each."""
    samples = raw_samples(raw.copy(), 0)
    lines_ns = np.zeros(raw.shape, np.int64)
    for first in gaps:
        share = np.arange(1, ticks)[:, None] / ticks
        within, signals = slice(first + 1, first + ticks), slice(0, len(IMU))
        samples.u[within, signals] = (1.0 - share) * raw[first, signals] + share * raw[first + ticks, signals]
        lines_ns[within, signals] = ticks * 10_000_000
    samples.complete[:] = ~lines_ns.any(axis=1)
    return replace(samples, lines_ns=lines_ns)


@pytest.mark.parametrize(("shaken", "ticks"), [(0.3, 20), (1.0, 20), (1.0, 8)])
def test_what_a_line_hides_makes_sizes_larger_by_how_much_this_flight_shakes(shaken: float, ticks: int) -> None:
    raw = truth.signals(60.0)
    raw[:, :2] += np.random.default_rng(1).normal(0.0, shaken, (len(raw), 2))
    gaps = np.arange(500, len(raw) - 100, 50)
    beyond = Strapdown({}, truth.SIGNAL_HZ, truth.RATE_HZ).run(over_gaps(raw, gaps, ticks)).beyond
    assert beyond is not None
    # of white noise: the integral within, and that of both ends over the whole line
    hidden = (0.01 * shaken) ** 2 * (ticks - 1.0 + 0.5 * (ticks - 1.0) ** 2)
    expected = np.sqrt(1.0 + 2.0 * hidden * (1.0 - 1.0 / ticks) / 0.05**2)
    assert beyond[-1] == pytest.approx(expected, rel=0.25)
    assert beyond[100] == pytest.approx(1.0)


def swinging(early_s: float) -> np.ndarray:
    """Return signals of a vehicle that rolls in several swings, whose attitude is ahead of its gyros."""
    raw = truth.signals(40.0)
    t = np.arange(len(raw)) / truth.SIGNAL_HZ
    raw[:, 3:9] = 0.0
    for hertz in (0.4, 1.1, 1.9):
        raw[:, 3] += np.cos(2.0 * np.pi * hertz * t)
        raw[:, 6] += np.sin(2.0 * np.pi * hertz * (t + early_s)) / (2.0 * np.pi * hertz)
    return raw


def test_through_a_gap_the_vehicle_turns_as_its_attitude_says_which_is_earlier_than_gyros() -> None:
    raw = swinging(0.012)
    gaps = np.arange(1000, len(raw) - 100, 67)
    turned, lines = [], over_gaps(raw, gaps, 12)
    for samples in (raw_samples(raw), lines):
        transform = Strapdown({}, truth.SIGNAL_HZ, truth.RATE_HZ)
        turned.append(np.cumsum(transform.run(samples).samples.u[:, transform.inputs.index("rate_x")]) / truth.RATE_HZ)
    by_gyros = np.cumsum(lines.u[:, 3] - raw[:, 3]) / truth.SIGNAL_HZ
    assert np.median(abs(turned[1] - turned[0])) < 0.25 * np.median(abs(by_gyros[1000:]))


def test_a_gap_leaves_the_difference_of_attitude_and_gyros_as_if_all_had_been_measured() -> None:
    raw, share = swinging(0.012), 0.25
    gaps = np.arange(1000, len(raw) - 100, 167)
    apart = []
    for samples in (raw_samples(raw), over_gaps(raw, gaps, 12)):
        transform = Strapdown({"attitude_share": share, "judge_level": 1e9}, truth.SIGNAL_HZ, truth.RATE_HZ)
        given = transform.run(samples).samples
        rate, turned = transform.inputs.index("rate_x"), transform.outputs.index("rotation_x")
        apart.append(given.y[:, turned] - washed(given.u[:, rate], 30.0))
    assert np.std(apart[1] - apart[0]) < 0.1 * np.std(apart[0])


def test_a_restart_forgets_the_past() -> None:
    raw = truth.signals(3.0)
    transform = Strapdown({}, truth.SIGNAL_HZ, truth.RATE_HZ)
    fresh = truth.fed(transform, raw)
    again = truth.fed(transform, raw)
    assert len(fresh) == len(again)
    for a, b in zip(fresh, again, strict=True):
        assert np.array_equal(a.u, b.u)
        assert np.array_equal(a.y, b.y)
        assert a.restart == b.restart


@pytest.mark.parametrize("missing", ["gps", "barometer", "magnetometer"])
def test_a_missing_sensor_leaves_the_others(missing: str) -> None:
    whole = Strapdown({}, 100.0, 25.0)
    raw = truth.signals(20.0)
    transform = Strapdown({missing: 0.0}, 100.0, 25.0)
    keep = [whole.signals.index(name) for name in transform.signals]
    errors = disagreement(transform, truth.fed(transform, raw[:, keep]))
    assert set(transform.outputs) < set(whole.outputs)
    assert errors
    assert max(errors.values()) < 0.01


def test_an_estimator_that_resets_its_attitude_is_no_rotation() -> None:
    raw = truth.signals(10.0)
    raw[500:, 6] += 0.2
    errors = disagreement(*truth.transformed(raw))
    assert errors["rotation_x"] < 0.01


def test_a_compass_agrees_with_the_gyros_after_a_flip_about_any_axis() -> None:
    t = np.arange(1000) / truth.SIGNAL_HZ
    turn = 2.0 * np.pi * np.clip(t - 4.0, 0.0, 1.0)
    for axis in (0, 1):
        raw = np.zeros((len(t), 18))
        raw[:, 2] = -9.8
        raw[:, 3 + axis] = 2.0 * np.pi * ((t >= 4.0) & (t < 5.0))
        over = np.cos(turn) < 0.0 if axis else np.zeros(len(t), np.bool_)
        raw[:, 6] = np.where(over, np.pi, 0.0) if axis else np.arctan2(np.sin(turn), np.cos(turn))
        raw[:, 7] = np.arcsin(np.sin(turn)) if axis else 0.0
        raw[:, 8] = np.where(over, np.pi, 0.0)
        raw[:, 9:11] = truth.HOME
        x, y, z = truth.FIELD
        turned = (np.cos(turn) * x - np.sin(turn) * z, np.full(len(t), y), np.cos(turn) * z + np.sin(turn) * x)
        rolled = (np.full(len(t), x), np.cos(turn) * y + np.sin(turn) * z, np.cos(turn) * z - np.sin(turn) * y)
        raw[:, 15:18] = np.column_stack(turned if axis else rolled)
        assert disagreement(*truth.transformed(raw))["heading"] < 0.05


def test_a_compass_agrees_with_gyros_that_are_late_after_fast_turns_to_both_sides() -> None:
    t, late_s = np.arange(2000) / truth.SIGNAL_HZ, 0.05
    rate = np.where((t > 5.0) & (t < 15.0), 6.0 * np.sign(np.sin(2.0 * t)) + 1.0, 0.0)
    yaw = np.cumsum(rate) / truth.SIGNAL_HZ
    raw = np.zeros((len(t), 18))
    raw[:, 2], raw[:, 5], raw[:, 8], raw[:, 9:11] = -9.8, np.interp(t - late_s, t, rate), yaw, truth.HOME
    # ten fields a second, each read on the line to the next one once
    held = np.interp(np.floor(10.0 * t + 1e-6) / 10.0, t, yaw)
    raw[:, 15:18] = np.column_stack([0.21 * np.cos(held), -0.21 * np.sin(held), np.full(len(t), 0.43)])
    changed = np.flatnonzero(np.diff(raw[:, 15]))
    raw[changed, 15:18] = 0.5 * (raw[changed, 15:18] + raw[changed + 1, 15:18])
    transform, samples = truth.transformed(raw, {"compass_hold_s": 0.3})
    heading = transform.outputs.index("heading")
    u, y = np.array([s.u for s in samples]), np.array([s.y for s in samples])
    off = y[:, heading] - washed(u[:, transform.inputs.index("heading_rate")], 30.0)
    assert abs(off[-1]) < 0.05


def test_a_gyro_bias_is_a_growing_disagreement_of_its_own_axis() -> None:
    raw = truth.signals(10.0)
    raw[500:, 4] += 0.1
    errors = disagreement(*truth.transformed(raw))
    assert errors["rotation_y"] == pytest.approx(0.5, rel=0.1)
    assert errors["rotation_x"] < 1e-3


@pytest.mark.parametrize("biased", [0.0, 0.2])
def test_a_receiver_that_is_stuck_is_off_by_what_the_vehicle_moved_until_it_goes_on(biased: float) -> None:
    raw, stuck = truth.signals(40.0), slice(1000, 2000)
    moved = (raw[1990, 9] - raw[1000, 9]) * truth.metres_per_degree(truth.HOME[0])[0]
    raw[stuck, 9:14] = raw[1000, 9:14]
    # speed and course are put on the grid as a vector, which rounds them
    raw[stuck, 12] *= 1.0 + 2.0**-52 * (np.arange(1000) % 2)
    raw[:, 0] += biased
    transform, samples = truth.transformed(raw, {"gps_hold_s": 1.0})
    north, speed = transform.outputs.index("gps_north"), transform.inputs.index("speed_north")
    assert [k for k, sample in enumerate(samples) if sample.restart] == [0]
    y, u = (np.array([getattr(sample, name)[i] for sample in samples]) for name, i in (("y", north), ("u", speed)))
    off = y - washed(u, 30.0)
    assert np.max(np.abs(off[:250])) < 0.01
    if not biased:
        assert off[498] == pytest.approx(-moved, rel=0.25)
    # a second after it went on, whatever the accelerations had integrated to
    assert np.max(np.abs(washout_inverse(30.0, truth.RATE_HZ, 0.5).run(off)[527:])) == 0.0
    speeds = [("gps_velocity_north", "acceleration_north"), ("gps_velocity_east", "acceleration_east")]
    for output, name in () if biased else speeds:
        velocity = np.array([sample.y[transform.outputs.index(output)] for sample in samples])
        sped = np.array([sample.u[transform.inputs.index(name)] for sample in samples])
        assert np.max(np.abs(np.diff(velocity - washed(sped, 10.0)))[500:]) < 0.01


def test_a_vehicle_that_stands_is_no_receiver_that_is_stuck_although_its_gyros_drift() -> None:
    raw = np.zeros((6000, 18))
    raw[:, 2], raw[:, 3:6], raw[:, 9:11], raw[:, MAG] = -9.80665, 0.004, truth.HOME, truth.FIELD
    parameters = {"gps_hold_s": 1.0, "judge_level": 12.1, "field_noise": 0.01, "field_walk": 0.005}
    errors = disagreement(*truth.transformed(raw, parameters))
    assert max(errors["gps_north"], errors["gps_east"]) < 0.05


def test_a_magnetic_field_that_comes_seldom_is_followed_by_the_gyro_until_it_is_late() -> None:
    raw = truth.signals(20.0)
    raw[:, 15:18] = np.repeat(raw[::50, 15:18], 50, axis=0)
    fitted, faster = (disagreement(*truth.transformed(raw, {"compass_hold_s": hold}))["heading"] for hold in (1.0, 0.0))
    assert fitted < 0.01
    # flights that were fitted had a field with every sample: the first that stays is taken for one that stands still
    assert faster < 0.05
    raw[1000:, 15:18] = raw[1000, 15:18]
    for hold in (0.0, 1.0):
        assert disagreement(*truth.transformed(raw, {"compass_hold_s": hold}))["heading"] > 1.0


def test_a_field_from_before_the_start_is_not_levelled_by_the_attitude_of_now() -> None:
    raw = truth.signals(20.0)
    quick = raw[300:].copy()
    raw[:, 15:18] = np.repeat(raw[::50, 15:18], 50, axis=0)
    held = {"compass_hold_s": 1.0}
    late = [disagreement(*truth.transformed(raw[start:], held))["heading"] for start in range(300, 350, 7)]
    assert max(late) < 0.01
    # a field of each tick is read from the start on
    assert disagreement(*truth.transformed(quick, held))["heading"] < 0.01
    quick[300:, 15] += 0.2
    assert disagreement(*truth.transformed(quick, held))["heading"] > 0.3


def test_a_magnetometer_that_reads_zeros_for_a_while_has_no_direction_and_divides_nothing() -> None:
    raw = truth.signals(10.0)
    raw[200:400, MAG] = 0.0
    assert disagreement(*truth.transformed(raw))["gps_north"] < 0.05


def test_an_imu_whose_values_all_stay_the_same_is_not_measured() -> None:
    raw = truth.signals(8.0)
    raw[300:500, :9] = raw[300, :9]
    for hold_s, spoiled in ((0.0, False), (0.5, True)):
        samples = truth.fed(Strapdown({"imu_hold_s": hold_s}, truth.SIGNAL_HZ, truth.RATE_HZ), raw)
        frozen = [s for s in samples if 360 <= s.index * truth.SIGNAL_HZ / truth.RATE_HZ < 490]
        assert frozen
        assert all(s.complete != spoiled for s in frozen)
        assert samples[-1].complete
        found = Strapdown({"imu_hold_s": hold_s}, truth.SIGNAL_HZ, truth.RATE_HZ).run(raw_samples(raw[:400]))
        assert found.still == (dict.fromkeys(IMU, 3_000_000_000) if spoiled else {})


def test_pressure_becomes_altitude() -> None:
    raw = truth.signals(5.0)
    pressure = raw.copy()
    pressure[:, 14] = 1013.25 * (1.0 - raw[:, 14] / 44_330.77) ** (1.0 / 0.190_263)
    metres = np.array([s.y for s in truth.transformed(raw)[1]])
    hectopascal = np.array([s.y for s in truth.transformed(pressure, {"barometer": 2.0})[1]])
    assert hectopascal == pytest.approx(metres, abs=1e-6)


def test_angles_that_wrap_between_measurements_pass_the_sampler_unharmed() -> None:
    source = strapdown_channels(EXAMPLES)
    transform = Strapdown(source.parameters, 100.0, 25.0)
    raw, direct = truth.signals(30.0), disagreement(*truth.transformed(truth.signals(30.0)))
    assert np.ptp(raw[:, 13]) > 350.0
    sampler = Sampler(source.channels, [], 100.0, VehicleClock())
    telemetry = [message for k, row in enumerate(raw) for message in messages(k, row)]
    taken = sample_batch(sampler.clock, [sampler], pack(telemetry))
    samples = rows(transform.run(taken.samples[0]).samples)
    errors = disagreement(transform, samples)
    assert len(samples) > 650
    assert all(sample.complete for sample in samples)
    assert errors["gps_velocity_north"] < direct["gps_velocity_north"] + 0.1
    assert errors["gps_north"] < 0.1
    assert errors["rotation_z"] < 0.01
    assert errors["heading"] < 0.01


def test_a_roll_that_wraps_between_measurements_passes_the_sampler_unharmed() -> None:
    rolls = [math.remainder(0.3 * k, 2.0 * math.pi) for k in range(100)]
    channel = next(one for one in strapdown_channels(EXAMPLES).channels if one.name == "roll")
    sampler = Sampler([channel], [], 50.0, VehicleClock())
    telemetry = [
        Message(MAVLINK, "ATTITUDE", 40_000_000 * k, {"time_boot_ms": 1000 + 40 * k, "roll": roll}, 1, 1)
        for k, roll in enumerate(rolls)
    ]
    samples = sample_batch(sampler.clock, [sampler], pack(telemetry)).samples[0]
    assert len(samples) > 100
    assert [math.remainder(step, 2.0 * math.pi) for step in np.diff(samples.u[:, 0])] == pytest.approx(
        [0.15] * (len(samples) - 1)
    )


def messages(k: int, row: np.ndarray) -> list[Message]:
    """Return what an autopilot sends at a tick, 4 ms off the grid: fixes at 5 Hz, yaw and course wrapped."""
    time_us = k * 10_000 + 1_004_000
    names = ("xacc", "yacc", "zacc", "xgyro", "ygyro", "zgyro")
    imu = dict(zip(names, row[:6].tolist(), strict=True))
    mag = dict(zip(("xmag", "ymag", "zmag"), row[15:18].tolist(), strict=True))
    yaw = math.remainder(float(row[8]), 2.0 * math.pi)
    fields = [
        ("HIGHRES_IMU", {**imu, **mag, "pressure_alt": float(row[14])}),
        ("ATTITUDE", {"roll": float(row[6]), "pitch": float(row[7]), "yaw": yaw}),
    ]
    if k % 20 == 0:
        lat, lon, alt, vel, cog = row[9:14].tolist()
        gps = {"lat": lat * 1e7, "lon": lon * 1e7, "alt": alt * 1e3, "vel": vel * 1e2, "cog": cog * 1e2}
        fields.append(("GPS_RAW_INT", gps))
    unix = 1_795_251_917_000_000_000 + time_us * 1_000
    return [Message(MAVLINK, name, unix, {"time_usec": time_us, **values}, 1, 1) for name, values in fields]


@pytest.mark.parametrize(
    ("parameters", "rate", "word"),
    [
        ({"washout": 30.0}, 25.0, "washout"),
        ({"washout_s": 0.0}, 25.0, "washout_s"),
        ({"gps_delay_s": math.nan}, 25.0, "gps_delay_s"),
        ({"gps": 0.5}, 25.0, "gps"),
        ({}, 30.0, "samples at 30 Hz"),
    ],
)
def test_parameters_that_cannot_be_are_named(parameters: dict[str, float], rate: float, word: str) -> None:
    with pytest.raises(TelemetryError, match=word):
        Strapdown(parameters, 100.0, rate)


def test_channels_follow_what_the_vehicle_sends() -> None:
    full = strapdown_channels(EXAMPLES)
    assert tuple(channel.name for channel in full.channels) == Strapdown(full.parameters, 100.0, 25.0).signals
    assert full.parameters == {"gps": 1.0, "barometer": 1.0, "magnetometer": 1.0}
    imu = {key: value for key, value in EXAMPLES["HIGHRES_IMU"].items() if key != "pressure_alt"}
    scaled = strapdown_channels({**{k: v for k, v in EXAMPLES.items() if k != "HIGHRES_IMU"}, "SCALED_IMU": imu})
    assert scaled.parameters["barometer"] == 2.0
    assert scaled.channels[0].message == "SCALED_IMU"
    assert scaled.channels[2].value({"zacc": -1000}) == pytest.approx(-9.80665)
    still = strapdown_channels({"ATTITUDE": EXAMPLES["ATTITUDE"], "HIGHRES_IMU": {**imu, "xmag": 0.0}})
    assert still.parameters == {"gps": 0.0, "barometer": 0.0, "magnetometer": 0.0}
    for lacking in ({"ATTITUDE"}, {"HIGHRES_IMU", "GPS_RAW_INT"}):
        with pytest.raises(TelemetryError, match=min(lacking)):
            strapdown_channels({key: value for key, value in EXAMPLES.items() if key not in lacking})


def test_without_an_imu_the_vehicle_hovers_at_its_attitude() -> None:
    attitude = {**EXAMPLES["ATTITUDE"], "rollspeed": 0.1, "pitchspeed": 0.2, "yawspeed": 0.3}
    source = strapdown_channels({**{k: v for k, v in EXAMPLES.items() if k != "HIGHRES_IMU"}, "ATTITUDE": attitude})
    assert not source.imu
    assert source.parameters == {"gps": 1.0, "barometer": 2.0, "magnetometer": 0.0}
    signals = [channel.value(attitude) for channel in source.channels[:6]]
    assert signals == pytest.approx([0.0, 0.0, -9.80665, 0.1, 0.2, 0.3])


def over_a_radio(seconds: float, bias: float, apart: int = 0) -> np.ndarray:
    """Return signals whose gyros come twice a second, rates of the attitude four times, so many samples later."""
    raw = truth.signals(seconds)
    ticks = np.arange(len(raw))
    gyros, rates = raw[ticks // 50 * 50, 3:6], raw[np.maximum((ticks - apart) // 25 * 25 + apart, 0), 3:6]
    raw[:, 3:6] = gyros + np.array([0.0, bias, 0.0])
    return np.hstack([raw, rates])


def test_gyros_that_come_seldom_tell_the_bias_that_the_estimator_has_learned() -> None:
    transform, samples = truth.transformed(over_a_radio(20.0, 0.03), {LEARNED: 10.0})
    y = np.array([one.y for one in samples])
    u = np.array([one.u for one in samples])
    for axis, bias in (("x", 0.0), ("y", 0.03), ("z", 0.0)):
        turned = y[:, transform.outputs.index(f"rotation_{axis}")]
        apart = washed(u[:, transform.inputs.index(f"rate_{axis}")], 30.0) - turned
        assert apart == pytest.approx(washed(np.full(len(samples), bias), 30.0), abs=2e-3)


@given(st.integers(0, 1), st.lists(st.integers(1, 599), max_size=5))
def test_the_learned_bias_is_the_same_however_the_samples_are_cut(apart: int, cuts: list[int]) -> None:
    samples = raw_samples(over_a_radio(6.0, 0.03, apart), 0)
    whole, part = LearnedBias(500), LearnedBias(500)
    edges = [0, *sorted(cuts), len(samples)]
    parts = [part.run(samples.part(*edge)) for edge in pairwise(edges)]
    expected = whole.run(samples)
    assert np.array_equal(np.vstack([one.u for one in parts]), expected.u)
    assert np.array_equal(np.vstack([one.lost for one in parts]), expected.lost)


def test_gyros_and_rates_that_do_not_come_together_are_no_measurement() -> None:
    lost = LearnedBias(100).run(raw_samples(over_a_radio(4.0, 0.03, apart=10), 0)).lost
    assert lost[200:, 3:6].all()
    assert not lost[:, :3].any()


def test_a_receiver_that_knows_no_speed_is_not_used() -> None:
    gps = {**EXAMPLES["GPS_RAW_INT"], "vel": 65_535}
    assert not {channel.name for channel in strapdown_channels({**EXAMPLES, "GPS_RAW_INT": gps}).channels} & set(GPS)


def test_a_number_that_no_float_can_hold_is_no_channel() -> None:
    from monitor.vehicles.inertial.signals import _there

    assert not _there({"IMU": {"xacc": 10**400}}, "IMU", ("xacc",))
    assert not _there({"IMU": {"xacc": float("nan")}}, "IMU", ("xacc",))
    assert _there({"IMU": {"xacc": 3}}, "IMU", ("xacc",))
