"""Sudden losses on simulated flights of exact truth: seen within samples, named right, never in coloured noise."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from simulated_multirotor import within

import replay
from adapters.logs.recordings import read_batches
from adapters.sample import Samples
from adapters.toml_tables import parse_toml, toml_value
from monitor import chain
from monitor.core.changes import ChangeTest
from monitor.estimation.changes import CLIP, ChangeRule, ChangeRun, ChangeStage, changes_table, predictor, read_changes
from monitor.event import AlarmEvent
from monitor.fitting.changes import fit_changes, healthy_nats
from monitor.fitting.flights import Flight
from monitor.profile import FaultChannel, read_profile
from monitor.vehicles.inertial.identify import inertial_plant
from monitor.vehicles.inertial.sensor_fit import InertialFit, Washouts
from monitor.vehicles.multirotor.identify import RATE_AXES, MultirotorFit, multirotor_plant
from replay.player import interests, play_batches

HZ = 100.0
MOTORS = ("motor1", "motor2", "motor3", "motor4")
FIT = MultirotorFit(
    rate_hz=HZ,
    a=np.array([0.97, 0.97, 0.98]),
    B=np.array([[-0.8, 0.8, 0.8, -0.8], [0.8, -0.8, 0.8, -0.8], [0.03, 0.03, -0.03, -0.03], [-4.0, -4.0, -4.0, -4.0]]),
    c=np.zeros(4),
    taps=np.array([0.3, 0.5, 0.2]),
    square=0.3,
    bends=np.zeros((4, 4, 2)),
    residual_std=np.array([2e-3, 2e-3, 5e-4, 0.3]),
    samples=10_000,
)
HOVER = 0.5
MOTOR_CHANNELS = [FaultChannel(motor, "actuator", "", place) for place, motor in enumerate(MOTORS)]


PLANT = multirotor_plant(FIT, "quad", MOTORS)


def thrust(u: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return what commands deliver, as a share of full thrust."""
    return (1.0 - FIT.square) * u + FIT.square * u**2


def flight(
    rng: np.random.Generator,
    seconds: float,
    *,
    loss: float = 0.0,
    motor: int = 0,
    at_s: float = 0.0,
    turn: float = 0.0,
    jump: float = 0.0,
    growth: float = 0.0,
    broken: bool = False,
    coupling: float = 0.0,
) -> Flight:
    """Return a hovering flight in gusts, steadied by a controller, with a loss of a motor or a jump of gyro x.

    ``turn`` is the amplitude of rates that the pilot asks for, rad/s. ``at_s`` may lie between samples; the loss grows
    by ``growth`` a second, and is behind the motor's lag where its propeller is ``broken``. ``coupling`` is what the
    product of two body rates adds to the third, which the model does not know.
    """
    n, lag = round(seconds * HZ), len(FIT.taps)
    u, y = np.full((n, 4), HOVER), np.zeros((n, 4))
    share, rate, gust = np.ones(4), np.zeros(3), np.zeros(3)
    delivered = np.tile(thrust(np.full(4, HOVER)), (n + lag, 1))
    B, lift = FIT.B[:3], FIT.B[3]
    mixer, trim = np.linalg.pinv(B), B @ delivered[0]
    turns_hz, gusts = np.array([0.7, 0.5, 0.3]), np.array([4e-4, 4e-4, 1e-4])
    for k in range(n):
        wanted = turn * np.sin(2 * np.pi * k / HZ * turns_hz)
        u[k] = within(HOVER + mixer @ (0.15 * (wanted - rate)), 0.0, 1.0)
        since = k + 1.0 - at_s * HZ
        share[motor] = 1.0 - loss * min(max(since, 0.0), 1.0) - growth * max(since, 0.0) / HZ
        delivered[k + lag] = (1.0 if broken else share) * thrust(u[k])
        gust = 0.9 * gust + rng.normal(size=3) * gusts
        y[k, :3] = rate + rng.normal(size=3) * 1e-4
        y[k, 0] += jump if k >= at_s * HZ else 0.0
        v = (share if broken else 1.0) * (FIT.taps @ delivered[k + lag : k : -1])
        y[k, 3] = lift @ v + rng.normal() * 0.3
        rate = FIT.a * rate + B @ v - trim + gust + coupling * np.roll(rate, 1) * np.roll(rate, 2)
    times = np.arange(n, dtype=np.int64) * round(1e9 / HZ)
    always = np.ones(n, np.bool_)
    nothing = np.zeros((n, 8), np.bool_)
    samples = Samples(np.arange(n), times, times, u, y, always & (np.arange(n) == 0), always, times, always, nothing)
    return Flight(samples, times >= 1_000_000_000)


@pytest.fixture(scope="module")
def rule() -> ChangeRule:
    rng = np.random.default_rng(1)
    found = fit_changes(PLANT, HZ, RATE_AXES, [flight(rng, 60.0, turn=turn) for turn in (0.0, 0.4)])
    assert found is not None
    return found


def stage(rule: ChangeRule) -> ChangeStage:
    return ChangeStage(PLANT, HZ, dict(zip(MOTORS, range(len(MOTORS)), strict=True)), rule)


def seen(rule: ChangeRule, flown: Flight, nats: float) -> NDArray[np.intp]:
    """Return the rows at which a loss of one per cent and more is named with so many nats."""
    run = stage(rule).run(flown.samples, flown.armed, np.zeros((len(flown), 4)))
    return np.flatnonzero((run.nats >= nats) & (run.size < -0.01))


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 2**16), st.integers(0, 3), st.floats(0.05, 0.4), st.sampled_from([0.0, 0.4]))
def test_a_sudden_loss_is_named_within_a_tenth_of_a_second(
    rule: ChangeRule, seed: int, motor: int, loss: float, turn: float
) -> None:
    flown = flight(np.random.default_rng(seed), 6.0, loss=loss, motor=motor, at_s=4.0, turn=turn)
    run = stage(rule).run(flown.samples, flown.armed, np.zeros((len(flown), 4)))
    rows = np.flatnonzero((run.nats >= 0.5 * CLIP**2) & (run.size < -0.01))
    assert 400 <= rows[0] <= 410
    assert set(run.named[rows]) == {motor}


def test_the_size_and_the_onset_are_right_after_half_a_second(rule: ChangeRule) -> None:
    flown = flight(np.random.default_rng(3), 6.0, loss=0.2, motor=2, at_s=4.0)
    run = stage(rule).run(flown.samples, flown.armed, np.zeros((len(flown), 4)))
    assert run.size[450] == pytest.approx(-0.2, rel=0.02)
    assert run.onset_ns[450] / 1e9 == pytest.approx(4.0, abs=0.03)


@settings(max_examples=6, deadline=None)
@given(st.integers(0, 2**16), st.floats(0.03, 0.3), st.floats(0.0, 1.0), st.booleans())
def test_the_size_is_right_within_its_deviation_from_the_first_naming_on(
    rule: ChangeRule, seed: int, loss: float, between: float, broken: bool
) -> None:
    at_s = 4.0 + between / HZ
    flown = flight(np.random.default_rng(seed), 5.0, loss=loss, motor=1, at_s=at_s, turn=0.4, broken=broken)
    run = stage(rule).run(flown.samples, flown.armed, np.zeros((len(flown), 4)))
    rows = np.flatnonzero((run.nats >= 1.05 * CLIP**2) & (run.named == 1))
    # of 120 random flights all are within two deviations
    assert abs(run.size[rows[0]] + loss) < 3.0 * run.sd[rows[0]]
    # the smallest are off by up to 19 %
    assert run.size[rows[0]] == pytest.approx(-loss, rel=0.25)


@settings(max_examples=5, deadline=None)
@given(st.integers(0, 2**16), st.integers(0, 3), st.floats(0.02, 0.06))
@example(5183, 3, 0.02)
@example(4591, 1, 0.0234375)
def test_a_motor_that_fades_is_named_with_its_growth(rule: ChangeRule, seed: int, motor: int, growth: float) -> None:
    flown = flight(np.random.default_rng(seed), 7.0, motor=motor, at_s=4.0, growth=growth)
    run = stage(rule).run(flown.samples, flown.armed, np.zeros((len(flown), 4)))
    rows = np.flatnonzero((run.nats >= 1.05 * CLIP**2) & (run.growth < 0.0))
    assert rows[0] < 600
    assert set(run.named[rows]) == {motor}
    assert run.growth[rows[0]] == pytest.approx(-growth, rel=0.3)
    # of 250 random flights all are within 1.4 deviations and 17 %
    assert run.size[rows[0]] == pytest.approx(-growth * (rows[0] / HZ - 4.0), rel=0.2)
    assert abs(run.size[rows[0]] + growth * (rows[0] / HZ - 4.0)) < 2.0 * run.sd[rows[0]]


@pytest.mark.parametrize("motor", range(4))
def test_a_neighbour_that_is_named_for_a_motor_that_delivers_more_comes_with_that_motor(
    rule: ChangeRule, motor: int
) -> None:
    for loss in (-0.1, 0.1):
        flown = flight(np.random.default_rng(5), 4.3, loss=loss, motor=motor, at_s=4.0)
        run = stage(rule).run(flown.samples, flown.armed, np.zeros((len(flown), 4)))
        rows = np.flatnonzero(run.nats >= 0.5 * CLIP**2)
        assert len(rows) > 10
        wrong = rows[run.named[rows] != motor]
        assert (run.instead[wrong] == motor).all()
        assert len(wrong) == 0 or loss < 0.0


def test_gusts_and_manoeuvres_reach_no_alarm(rule: ChangeRule) -> None:
    for seed, turn in enumerate((0.0, 0.4, 0.8)):
        assert not len(seen(rule, flight(np.random.default_rng(50 + seed), 40.0, turn=turn), 0.5 * CLIP**2))


def test_a_body_that_turns_about_several_axes_is_no_motor() -> None:
    gentle = [flight(np.random.default_rng(1), 60.0, turn=turn, coupling=4e-3) for turn in (0.0, 0.4, 0.8)]
    wild = flight(np.random.default_rng(2), 40.0, turn=2.5, coupling=4e-3)
    rule = fit_changes(PLANT, HZ, RATE_AXES, gentle)
    assert rule is not None
    assert not len(seen(rule, wild, 0.5 * CLIP**2))
    assert len(seen(replace(rule, variance=rule.variance * [1.0, 1.0, 1.0, 0.0]), wild, 0.5 * CLIP**2))


def test_innovations_know_the_bend_of_an_axis() -> None:
    flown = flight(np.random.default_rng(3), 10.0, turn=0.8)
    bends = np.zeros((4, 4, 2))
    bends[2] = np.outer(FIT.B[2], [-0.4, 0.5])
    bent = replace(PLANT, bends=bends)
    rule = ChangeRule(RATE_AXES, np.zeros((1, 3, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (3, 1)))
    straight, curved = (ChangeStage(plant, HZ, {}, rule).innovations(flown.samples)[0] for plant in (PLANT, bent))
    v = thrust(flown.samples.u)
    known = np.convolve((v * bends[2, :, 0] + v**2 * bends[2, :, 1]).sum(axis=1), FIT.taps)[: len(v) - 1]
    assert (straight - curved)[10:, 2] == pytest.approx(known[9:], abs=1e-12)
    assert np.array_equal(straight[:, :2], curved[:, :2])


def test_a_jump_of_a_gyro_is_no_motor(rule: ChangeRule) -> None:
    flown = flight(np.random.default_rng(5), 6.0, jump=0.05, at_s=4.0)
    assert not len(seen(rule, flown, 0.5 * CLIP**2))


def test_one_damaged_sample_is_no_loss(rule: ChangeRule) -> None:
    flown = flight(np.random.default_rng(6), 6.0)
    flown.samples.y[400, :3] += [40.0, -80.0, 3.0]
    assert not len(seen(rule, flown, 1.05 * 0.5 * CLIP**2))


def test_the_end_of_a_loss_that_is_believed_is_no_motor_that_delivers_more_or_less(rule: ChangeRule) -> None:
    ill = flight(np.random.default_rng(7), 8.0, loss=0.15, motor=1, at_s=0.0)
    well = flight(np.random.default_rng(7), 8.0)
    both = Flight(ill.samples, ill.armed)
    both.samples.y[400:] = well.samples.y[400:]
    both.samples.u[400:] = well.samples.u[400:]
    believed = np.zeros((len(both), 4))
    believed[:420, 1] = -0.15 * HOVER
    run = stage(rule).run(both.samples, both.armed, believed)
    assert set(run.named[405:420]) <= {-1, 1}


def test_it_does_not_matter_how_samples_are_cut(rule: ChangeRule) -> None:
    flown = flight(np.random.default_rng(8), 4.0, loss=0.1, at_s=3.0)
    whole = stage(rule).run(flown.samples, flown.armed, np.zeros((400, 4)))
    cut = stage(rule)
    parts = [
        cut.run(flown.samples.part(k, k + 7), flown.armed[k : k + 7], np.zeros((len(flown.armed[k : k + 7]), 4)))
        for k in range(0, 400, 7)
    ]
    for one, other in zip(whole, zip(*parts, strict=True), strict=True):
        np.testing.assert_array_equal(one, np.concatenate(other))


@settings(max_examples=6, deadline=None)
@given(st.integers(0, 2**16), st.floats(0.0, 0.2), st.floats(0.0, 0.05), st.booleans())
def test_samples_name_what_has_the_nats_they_ask_for_and_nothing_else(
    rule: ChangeRule, seed: int, loss: float, growth: float, broken: bool
) -> None:
    rng = np.random.default_rng(seed)
    flown = flight(rng, 8.0, loss=loss, motor=seed % 4, at_s=4.0, turn=0.4, growth=growth, broken=broken)
    asked = np.where(rng.random(len(flown)) < 0.1, 0.0, rng.choice([20.0, 100.0, 400.0]))
    nobody = np.zeros((len(flown), 4))
    everything = stage(rule).run(flown.samples, flown.armed, nobody)
    run = stage(rule).run(flown.samples, flown.armed, nobody, asked)
    wanted = (everything.named >= 0) & (everything.nats >= asked)
    for one, other, nothing in zip(
        (*run[:-2], run.instead),
        (*everything[:-2], everything.instead),
        (-1, 0.0, 0.0, 0.0, 0.0, flown.samples.vehicle_time_ns, -1),
        strict=True,
    ):
        np.testing.assert_array_equal(one, np.where(wanted, other, nothing))
    np.testing.assert_array_equal(run.noise, everything.noise)


def test_what_alarms_do_not_ask_of_sudden_changes_makes_no_difference_to_them(monkeypatch: pytest.MonkeyPatch) -> None:
    data = Path(replay.__file__).parent / "data"
    profile = read_profile(data / "quad")

    def events() -> tuple[AlarmEvent, ...]:
        return play_batches(profile, read_batches(data / "copter_motor1.tlog.xz", interests(profile))).events

    found = events()
    assert any(event.state == "raised" for event in found)
    monkeypatch.setattr(chain, "nats_asked", lambda alarms, evidence, *_: np.zeros(len(evidence)))
    assert events() == found


@pytest.mark.parametrize("first", [1e-7, 1e-9, 1e-15])
def test_a_lag_that_lets_next_to_nothing_through_at_first_explains_what_one_that_lets_nothing_does(
    first: float,
) -> None:
    rng, n = np.random.default_rng(0), 1_000
    u, noise = 0.5 + 0.1 * rng.normal(size=n), 0.01 * rng.normal(size=n)
    acting = np.convolve(u, [0.0, 0.0, 0.7, 0.3])[:n]
    y = np.convolve(noise - 0.5 * acting, 0.9 ** np.arange(200))[:n]
    flags, nobody = np.ones(n, np.uint8), np.zeros((n, 1))

    def nats(taps: list[float]) -> NDArray[np.float64]:
        additions, none, only = np.zeros((6, 0, 1)), np.zeros(0, np.intp), np.zeros(1, np.intp)
        test = ChangeTest(
            np.array([[0.9, -0.5, 0.0]]), np.ones((1, 1)), np.zeros((0, 1, 1)), np.array(taps), only, only, additions,
            additions[:, :, 0], none, none, only, False, 2.0, HZ, np.zeros((1, 1, 1)),
            np.array([[1e-4, 0.0, 0.0, 0.0]]), 5, 200, CLIP, 1_000.0,
        )  # fmt: skip
        times_ns = np.arange(n) * 10_000_000
        return test.run(
            u[:, None], y[:, None], flags[:, None], np.eye(1, n, dtype=np.uint8)[0], times_ns, flags, nobody
        )[1]

    assert nats([first, 0.7, 0.3]) == pytest.approx(nats([0.0, 0.7, 0.3]), abs=1.0)


def test_samples_that_are_not_evidence_or_incomplete_name_nothing(rule: ChangeRule) -> None:
    flown = flight(np.random.default_rng(9), 5.0, loss=0.3, at_s=3.0)
    flown.samples.complete[300:] = False
    assert not len(seen(rule, flown, 1.0))
    flown = flight(np.random.default_rng(9), 5.0, loss=0.3, at_s=3.0)
    flown.armed[300:] = False
    assert not len(seen(rule, flown, 1.0))


def test_the_fitted_variance_grows_with_what_excites_the_noise() -> None:
    rng = np.random.default_rng(11)
    flown = [flight(rng, 60.0, turn=0.6) for _ in range(2)]
    for one in flown:
        one.samples.y[:, :3] *= 1.0 + rng.normal(size=(len(one), 3)) * 0.01
    rule = fit_changes(PLANT, HZ, RATE_AXES, flown)
    assert rule is not None
    assert rule.variance[0, 1] == pytest.approx(0.01**2 / 2, rel=0.9)


def test_the_nats_of_an_alarm_are_nearly_all_that_two_rows_can_have(rule: ChangeRule) -> None:
    flown = [flight(np.random.default_rng(12), 60.0)]
    assert 1.5 < healthy_nats(PLANT, HZ, MOTOR_CHANNELS, rule, flown, 0.02).level / (0.5 * CLIP**2) < 2.0


def test_too_short_flights_have_no_test() -> None:
    assert fit_changes(PLANT, HZ, RATE_AXES, [flight(np.random.default_rng(0), 3.0)]) is None


def test_the_rule_reads_back_as_it_was_written(rule: ChangeRule) -> None:
    text = "\n".join(f"{key} = {toml_value(value)}" for key, value in changes_table(rule).items())
    read = read_changes(parse_toml("p.toml", text.encode(), ValueError).root, RATE_AXES)
    assert read.outputs == rule.outputs
    np.testing.assert_array_equal(read.whitening, rule.whitening)
    np.testing.assert_array_equal(read.variance, rule.variance)


INERTIAL_HZ = 25.0
INPUTS = ("speed_north", "speed_east", "acceleration_north", "acceleration_east", "acceleration_down")
OUTPUTS = ("gps_north", "gps_east", "gps_velocity_north", "gps_velocity_east", "gps_down", "baro_down")
INERTIAL = inertial_plant(
    InertialFit(
        rate_hz=INERTIAL_HZ,
        washouts=Washouts(30.0, 10.0, 3.0),
        inputs=(*INPUTS, "rate_x", "rate_y", "rate_z"),
        outputs=(*OUTPUTS, "rotation_x", "rotation_y", "rotation_z"),
        speed_scale={},
        noise=dict.fromkeys((*OUTPUTS, "rotation_x", "rotation_y", "rotation_z"), 0.01),
        disturbance={
            **dict.fromkeys(("position_north", "position_east", "velocity_north", "velocity_east"), 1e-3),
            **dict.fromkeys(("down", "velocity_down", "rotation_x", "rotation_y", "rotation_z"), 1e-4),
        },
        seconds=100.0,
    ),
    "any",
)
SENSORS = {fault.name: None for fault in INERTIAL.faults}
LASTS_S = {"gps_north": 0.2, "gps_east": 0.2, "gps_down": 0.2, "baro": 0.04}


def course(name: str, size: float, ramp: bool, at: int, n: int) -> NDArray[np.float64]:
    """Return what a fault adds to the outputs: fixes of a GPS come on straight lines of five samples."""
    rows = np.arange(n) - at + 1.0
    lines = max(1.0, INERTIAL_HZ * LASTS_S.get(name, 0.0))
    sizes = size * np.clip(rows / INERTIAL_HZ if ramp else np.clip(rows / lines, 0.0, 1.0), 0.0, None)
    fault = INERTIAL.faults[list(SENSORS).index(name)]
    if fault.kind == "sensor":
        return sizes[:, None] * fault.column
    state, added = np.zeros(len(INERTIAL.states)), []
    for one in sizes:
        added.append(INERTIAL.C @ state)
        state = INERTIAL.A @ state + fault.column * one
    return np.array(added)


def travel(rng: np.random.Generator, seconds: float, noise: float = 0.01) -> Flight:
    """Return a flight with gusts and manoeuvres; the noise of all measurements has heavy tails."""
    n = round(seconds * INERTIAL_HZ)
    u = np.cumsum(rng.normal(size=(n, len(INERTIAL.inputs))), axis=0)
    u -= 0.98 * np.vstack([np.zeros(u.shape[1]), u[:-1]])
    y, state = np.zeros((n, len(INERTIAL.outputs))), np.zeros(len(INERTIAL.states))
    for k in range(n):
        y[k] = INERTIAL.C @ state + noise * rng.standard_t(4, size=len(INERTIAL.outputs))
        state = INERTIAL.A @ state + INERTIAL.B @ u[k] + 0.1 * noise * rng.normal(size=len(state))
    times = np.arange(n, dtype=np.int64) * round(1e9 / INERTIAL_HZ)
    always = np.ones(n, np.bool_)
    nothing = np.zeros((n, u.shape[1] + y.shape[1]), np.bool_)
    samples = Samples(np.arange(n), times, times, u, y, always & (np.arange(n) == 0), always, times, always, nothing)
    return Flight(samples, times >= 1_000_000_000)


@pytest.fixture(scope="module")
def sensors() -> tuple[ChangeRule, float]:
    """Return the rule of the sensors' faults, and the nats that raise an alarm."""
    flown = [travel(np.random.default_rng(seed), 60.0) for seed in (20, 21)]
    found = fit_changes(INERTIAL, INERTIAL_HZ, INERTIAL.outputs, flown, LASTS_S)
    assert found is not None
    channels = [FaultChannel(name, "sensor", "", None) for name in SENSORS]
    return found, healthy_nats(INERTIAL, INERTIAL_HZ, channels, found, flown, 0.02).level


def judged(rule: ChangeRule, flown: Flight) -> ChangeRun:
    nobody = np.zeros((len(flown), len(SENSORS)))
    return ChangeStage(INERTIAL, INERTIAL_HZ, SENSORS, rule).run(flown.samples, flown.armed, nobody)


def test_an_output_is_predicted_from_those_before_it_without_error() -> None:
    flown = travel(np.random.default_rng(22), 4.0, noise=0.0)
    for output in range(len(OUTPUTS)):
        found = predictor(INERTIAL, output)
        lags = range(1, len(found.y) + 1)
        for k in range(10, 90):
            guess = sum(found.y[lag - 1] * flown.samples.y[k - lag, output] for lag in lags)
            guess += sum(found.u[lag - 1] @ flown.samples.u[k - lag] for lag in lags)
            assert flown.samples.y[k, output] == pytest.approx(guess, abs=1e-9)


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 2**16), st.sampled_from(sorted(LASTS_S)), st.sampled_from([-1.0, 1.0]), st.booleans())
def test_a_sensor_that_jumps_or_walks_is_named_alone(
    sensors: tuple[ChangeRule, float], seed: int, name: str, sign: float, ramp: bool
) -> None:
    rule, nats = sensors
    flown = travel(np.random.default_rng(seed), 7.0)
    flown.samples.y[:] += course(name, sign * (4.0 if ramp else 2.0), ramp, 125, len(flown))
    run = judged(rule, flown)
    rows = np.flatnonzero(run.nats >= nats)
    assert 125 <= rows[0] <= (150 if ramp else 131)
    assert {list(SENSORS)[fault] for fault in run.named[rows]} == {name}
    assert run.size[rows[0]] * sign > 0.0
    if name == "baro" and not ramp:
        # a fix that is on its way along its line may as well walk as jump
        assert abs(run.size[rows[0]] - 2.0 * sign) < 3.0 * run.sd[rows[0]]


def test_what_a_jump_leaves_behind_is_no_second_jump_when_it_leaves_the_window(
    sensors: tuple[ChangeRule, float],
) -> None:
    rule, nats = sensors
    flown = travel(np.random.default_rng(29), 9.0)
    # A filter passes the last third of the jump within half a second.
    late = np.clip(np.arange(len(flown)) - 124.0, 0.0, None) / (0.2 * INERTIAL_HZ)
    flown.samples.y[:] += course("baro", 10.0, False, 125, len(flown)) * (1.0 - np.exp(-late)[:, None] / 3.0)
    run = judged(rule, flown)
    rows = run.nats >= nats
    assert rows.any()
    assert run.size[rows].min() > 5.0


@pytest.mark.parametrize("output", ["baro_down", "gps_north", "gps_down"])
def test_one_wrong_value_of_a_sensor_is_nobodys_fault(sensors: tuple[ChangeRule, float], output: str) -> None:
    rule, nats = sensors
    flown = travel(np.random.default_rng(27), 7.0)
    flown.samples.y[125, OUTPUTS.index(output)] += 50.0
    assert not (judged(rule, flown).nats >= nats).any()


def test_a_sample_whose_outputs_are_known_before_its_inputs_is_judged_a_sample_sooner(
    sensors: tuple[ChangeRule, float],
) -> None:
    rule, nats = sensors
    flown = travel(np.random.default_rng(28), 7.0)
    flown.samples.y[:] += course("baro", 2.0, False, 125, len(flown))
    nobody, ahead = np.zeros((len(flown), len(SENSORS))), np.vstack([flown.samples.y[1:], flown.samples.y[-1:]])
    waited = judged(rule, flown)
    run = ChangeStage(INERTIAL, INERTIAL_HZ, SENSORS, rule).run(flown.samples, flown.armed, nobody, ahead=ahead)
    first, sooner = (int(np.flatnonzero(one.nats >= nats)[0]) for one in (waited, run))
    assert (first, sooner) == (126, 125)
    assert run.named[sooner] == waited.named[first]
    assert run.onset_ns[sooner] == waited.onset_ns[first]


@pytest.mark.parametrize("name", ["accel_z", "gyro_x", "motion_north", "gps_velocity_east"])
def test_a_fault_of_another_sensor_gets_none_of_their_names(sensors: tuple[ChangeRule, float], name: str) -> None:
    rule, nats = sensors
    flown = travel(np.random.default_rng(23), 7.0)
    flown.samples.y[:] += course(name, 8.0, False, 125, len(flown))
    assert not (judged(rule, flown).nats >= nats).any()


@pytest.mark.parametrize("noise", [0.05, 0.2, 1.0])
def test_another_stream_of_a_sensor_with_any_noise_is_no_fault_of_it(
    sensors: tuple[ChangeRule, float], noise: float
) -> None:
    rule, nats = sensors
    flown = travel(np.random.default_rng(25), 30.0)
    # evidence begins as long after the samples as an observer takes to settle
    flown.armed[: round(15.0 * INERTIAL_HZ)] = False
    held = np.repeat(np.random.default_rng(26).normal(size=len(flown) // 3), 3)
    flown.samples.y[:, OUTPUTS.index("baro_down")] += noise * held
    assert not (judged(rule, flown).nats >= nats).any()
    flown.samples.y[:] += course("gps_north", 2.0, False, 500, len(flown))
    run = judged(rule, flown)
    rows = np.flatnonzero(run.nats >= nats)
    assert rows[0] <= 506
    assert {list(SENSORS)[fault] for fault in run.named[rows]} == {"gps_north"}


def test_the_noise_of_a_sensor_is_followed_and_no_fault_raises_it(sensors: tuple[ChangeRule, float]) -> None:
    column = sensors[0].outputs.index("gps_north")
    flown = travel(np.random.default_rng(29), 30.0)
    healthy = judged(sensors[0], flown).noise[500:, column]
    assert healthy.max() < 2.5
    for ramp in (False, True):
        faulty = travel(np.random.default_rng(29), 30.0)
        faulty.samples.y[:] += course("gps_north", 4.0, ramp, 500, len(flown))
        # a jump is on its way through the dozen rows of the whitening
        assert judged(sensors[0], faulty).noise[500:, column].max() < 5.0
    flown.samples.y[500:, OUTPUTS.index("gps_north")] += 0.06 * np.random.default_rng(30).normal(size=len(flown) - 500)
    assert judged(sensors[0], flown).noise[600:, column].min() > 8.0


def test_heavy_tails_raise_no_more_alarms_than_promised(sensors: tuple[ChangeRule, float]) -> None:
    rule, nats = sensors
    for seed in range(30, 34):
        assert not (judged(rule, travel(np.random.default_rng(seed), 120.0)).nats >= nats).any()


def test_a_sensors_rule_reads_back_as_it_was_written(sensors: tuple[ChangeRule, float]) -> None:
    rule, _ = sensors
    table = changes_table(rule)
    text = "\n".join(f"{key} = {toml_value(value)}" for key, value in table.items() if key != "lasts_s")
    text += "\n[lasts_s]\n" + "\n".join(f"{key} = {toml_value(value)}" for key, value in rule.lasts_s.items())
    read = read_changes(parse_toml("p.toml", text.encode(), ValueError).root, INERTIAL.outputs)
    assert read.lasts_s == rule.lasts_s
    np.testing.assert_array_equal(read.whitening, rule.whitening)


def test_it_does_not_matter_how_samples_of_sensors_are_cut(sensors: tuple[ChangeRule, float]) -> None:
    flown = travel(np.random.default_rng(24), 6.0)
    flown.samples.y[:] += course("baro", 2.0, False, 125, len(flown))
    nobody = np.zeros((len(flown), len(SENSORS)))
    whole = judged(sensors[0], flown)
    cut = ChangeStage(INERTIAL, INERTIAL_HZ, SENSORS, sensors[0])
    parts = [cut.run(flown.samples.part(k, k + 7), flown.armed[k : k + 7], nobody[k : k + 7]) for k in range(0, 150, 7)]
    for one, other in zip(whole, zip(*parts, strict=True), strict=True):
        np.testing.assert_array_equal(one, np.concatenate(other))
