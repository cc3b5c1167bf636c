"""Frames, and the trim of a multirotor whose motor commands come slowly: known truth from a simulated rate loop."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from functools import cache, partial

import numpy as np
import pytest
from numpy.typing import NDArray

from adapters.errors import ModelError
from gains.identification.segment import Segment
from monitor.alarms.alarm import AlarmRule
from monitor.estimation.excitation import ExcitationRule
from monitor.fitting.thresholds import Calibrated
from monitor.vehicles.multirotor.fit import _check_watched, _lines, _smallest
from monitor.vehicles.multirotor.frames import Frame, frame_of, lifting_outputs, standard_frames
from monitor.vehicles.multirotor.identify import USUAL, MultirotorFit, multirotor_plant
from monitor.vehicles.multirotor.trim import TRIM_HZ, choose_frame, identify_trim, slow_times, smallest_loss

STEP_S = 0.01
AUTHORITY = np.array([300.0, 250.0, 20.0])
"""rad/s^2 that a torque of one gives."""
DAMPING = np.array([0.8, 0.8, 0.5])
"""Rates decay with, 1/s."""
LAG_S = 0.05
HOVER = 0.5
QUAD = next(iter(standard_frames(4)))
LONG = pytest.mark.long
FRAMES = [frame for motors in (4, 6, 8) for frame in standard_frames(motors)]


def fly(
    frame: Frame,
    seconds: float,
    *,
    turns: float = 0.6,
    lost: Sequence[float] = (),
    seed: int = 1,
    noise: float = 0.0,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return commands (N, s) and body rates (N, 3) every 10 ms of a rate loop that follows demanded rates in gusts.

    The loop feels its gyros' noise (rad/s).
    """
    random = np.random.default_rng(seed)
    count, motors = round(seconds / STEP_S), frame.effects.shape[1]
    mixer = np.linalg.pinv(frame.effects / motors)
    kept = 1.0 - np.array(lost) if len(lost) else np.ones(motors)
    rate, integral, gust, thrust = np.zeros(3), np.zeros(3), np.zeros(3), np.full(motors, HOVER)
    u, y = np.empty((count, motors)), np.empty((count, 3))
    demand = np.zeros(3)
    for k in range(count):
        if k % 70 == 0:
            demand = turns * random.uniform(-1.0, 1.0, 3)
        y[k] = rate + noise * random.standard_normal(3)
        error = demand - y[k]
        integral += error * STEP_S
        u[k] = HOVER + mixer @ ((8.0 * error + 6.0 * integral) / AUTHORITY)
        thrust += (u[k] * kept - thrust) * STEP_S / LAG_S
        gust += -gust * STEP_S + 0.002 * random.standard_normal(3) * np.sqrt(STEP_S)
        torque = frame.effects @ thrust / motors + gust
        rate = rate + (AUTHORITY * torque - DAMPING * rate) * STEP_S
    return u, y


flight = cache(partial(fly, QUAD))
"""What a quadrotor's flight gives, flown once for all tests."""


def slow(u: NDArray[np.float64], y: NDArray[np.float64], hz: float, commands_hz: float) -> Segment:
    """Return ticks with the mean of the commands that were sent until the next one."""
    t, at = np.arange(len(u)) * STEP_S, np.arange(0.0, len(u) * STEP_S - STEP_S, 1.0 / commands_hz)
    ticks = np.arange(1.0, at[-1] - 1.0 / hz, 1.0 / hz)
    whole = np.concatenate([[0.0], np.cumsum(np.diff(at))])
    means = []
    for column in u.T:
        sent = np.interp(at, t, column)
        area = np.concatenate([[0.0], np.cumsum((sent[1:] + sent[:-1]) / 2.0 * np.diff(whole))])
        fine = np.interp(np.append(ticks, ticks[-1] + 1.0 / hz), at, area)
        means.append(np.diff(fine) * hz)
    return Segment(np.stack(means, axis=1), np.stack([np.interp(ticks, t, column) for column in y.T], axis=1))


@pytest.mark.parametrize("frame", FRAMES, ids=lambda frame: frame.name)
def test_no_motor_of_a_standard_frame_turns_it_as_another_does(frame: Frame) -> None:
    distinct = np.unique(frame.effects.round(9), axis=1).shape[1]
    assert distinct == frame.effects.shape[1]
    assert np.allclose(frame.effects.sum(axis=1), 0.0)
    assert np.allclose(np.abs(frame.effects).max(axis=1), 1.0)


def test_parameters_of_ardupilot_name_the_frame_and_the_order_of_its_outputs() -> None:
    plain = frame_of({"FRAME_CLASS": 1, "FRAME_TYPE": 1}, (1, 2, 3, 4))
    assert plain is not None and plain.name == "quad x"
    assert plain.effects.tolist() == [[-1, 1, 1, -1], [1, -1, 1, -1], [1, 1, -1, -1]]
    swapped = {"SERVO1_FUNCTION": 34, "SERVO2_FUNCTION": 33, "SERVO3_FUNCTION": 35, "SERVO4_FUNCTION": 36}
    other = frame_of({"FRAME_CLASS": 1, "FRAME_TYPE": 1} | swapped, (1, 2, 3, 4))
    assert other is not None
    assert other.effects.tolist() == [[1, -1, 1, -1], [-1, 1, 1, -1], [1, 1, -1, -1]]


def test_parameters_of_old_copters_say_the_shape_of_quads_alone() -> None:
    old = frame_of({"FRAME": 1.0}, (1, 2, 3, 4))
    assert old is not None and old.name == "quad x"
    assert frame_of({"FRAME": 1.0}, (1, 2, 3, 4, 5, 6)) is None


def test_parameters_of_px4_place_the_rotors() -> None:
    places = [(1, 1, 0.05), (-1, -1, 0.05), (1, -1, -0.05), (-1, 1, -0.05)]
    parameters = {
        f"CA_ROTOR{i}_{key}": value
        for i, place in enumerate(places)
        for key, value in zip(("PX", "PY", "KM"), place, strict=True)
    }
    frame = frame_of({"CA_ROTOR_COUNT": 4.0, **parameters}, (1, 2, 3, 4))
    assert frame is not None
    assert frame.effects.tolist() == [[-1, 1, 1, -1], [1, -1, 1, -1], [1, 1, -1, -1]]


QUADPLANE = {"Q_ENABLE": 1.0, "Q_FRAME_CLASS": 1.0, "Q_FRAME_TYPE": 1.0} | {
    f"SERVO{n}_FUNCTION": float(function) for n, function in enumerate((4, 19, 70, 21, 33, 34, 35, 36), 1)
}
PX4_VTOL = {"CA_ROTOR_COUNT": 5.0, "CA_ROTOR4_PX": -0.3, "CA_ROTOR4_AX": 1.0, "CA_ROTOR4_AZ": 0.0} | {
    f"PWM_MAIN_FUNC{n}": float(function) for n, function in enumerate((101, 102, 103, 104, 201, 202, 203, 105), 1)
}
TRI = {"FRAME_CLASS": 7.0, "SERVO1_FUNCTION": 33.0, "SERVO2_FUNCTION": 34.0, "SERVO4_FUNCTION": 36.0}


@pytest.mark.parametrize(
    ("parameters", "outputs"),
    [
        (QUADPLANE, {5, 6, 7, 8}),
        (PX4_VTOL, {1, 2, 3, 4}),
        (TRI | {"SERVO7_FUNCTION": 39.0}, {1, 2, 4}),
        ({}, set()),
        ({"FRAME_CLASS": 6.0} | {f"SERVO{n}_FUNCTION": 32.0 + n for n in range(1, 5)}, set()),
        ({"SERVO1_FUNCTION": 4.0, "SERVO2_FUNCTION": 19.0, "SERVO3_FUNCTION": 70.0}, set()),
    ],
)
def test_surfaces_a_forward_motor_and_a_tails_servo_do_not_lift(
    parameters: dict[str, float], outputs: set[int]
) -> None:
    assert lifting_outputs(parameters) == outputs


def test_the_motors_of_a_plane_that_hovers_have_their_frame_behind_its_surfaces() -> None:
    frame = frame_of(QUADPLANE, (5, 6, 7, 8))
    assert frame is not None and frame.name == "quad x"
    assert frame.effects.tolist() == [[-1, 1, 1, -1], [1, -1, 1, -1], [1, 1, -1, -1]]


def test_two_motors_on_an_arm_that_turn_alike_have_a_fault_together_and_others_one_each() -> None:
    outputs = range(1, 9)
    for shape, together in ((20, {(1, 6), (2, 5), (3, 8), (4, 7)}), (1, {(n,) for n in outputs})):
        frame = frame_of({"FRAME_CLASS": 4.0, "FRAME_TYPE": shape}, outputs)
        assert frame is not None
        fit = MultirotorFit(
            rate_hz=100.0,
            a=np.full(3, 0.99),
            B=frame.effects * (np.array(USUAL) / 800.0)[:, None],
            c=np.zeros(3),
            taps=np.ones(1),
            square=0.0,
            bends=np.zeros((3, 8, 2)),
            residual_std=np.full(3, 0.01),
            samples=1000,
        )
        faults = multirotor_plant(fit, "it", [f"motor{n}" for n in outputs], gyros=False).faults
        assert {fault.name for fault in faults} == {"_or_".join(f"motor{n}" for n in pair) for pair in together}
        assert all(fault.input == fault.name.partition("_or_")[0] for fault in faults)


def test_motors_of_a_tricopter_turn_it_about_roll_and_pitch_alone() -> None:
    frame = frame_of(TRI, (1, 2, 4))
    assert frame is not None and np.allclose(frame.effects, [[-1, 1, 0], [0.5, 0.5, -1], [0, 0, 0]])
    assert lifting_outputs({}, tricopter=True) == {1, 2, 4}
    u, y = fly(frame, 60.0)
    fit = identify_trim([Segment(u[::20], y[::20])], 1.0 / STEP_S / 20, frame)
    assert fit.B.shape == (2, 3)


def test_motors_that_tilt_to_turn_a_plane_do_not_turn_it_by_their_drag() -> None:
    frame = frame_of(QUADPLANE | {"Q_TILT_ENABLE": 1.0, "Q_TILT_TYPE": 2.0}, (5, 6, 7, 8))
    assert frame is not None and not frame.effects[2].any()


@pytest.mark.parametrize(
    "parameters",
    [{}, {"FRAME_CLASS": 77.0}, {"CA_ROTOR_COUNT": 2.0}, {"FRAME_CLASS": 1, "FRAME_TYPE": 1, "SERVO1_FUNCTION": 34}],
)
def test_parameters_that_do_not_describe_these_motors_give_no_frame(parameters: dict[str, float]) -> None:
    assert frame_of(parameters, (1, 2, 3, 4)) is None


@pytest.mark.parametrize(
    "frame",
    [
        pytest.param(frame, id=frame.name, marks=() if frame.name in ("quad x", "quad +", "hexa x", "y6") else LONG)
        for frame in (*standard_frames(4), *standard_frames(6))
    ],
)
def test_the_motion_tells_the_frame(frame: Frame) -> None:
    u, y = fly(frame, 60.0)
    every = 10
    chosen = choose_frame([Segment(np.repeat(u[::20], 2, axis=0)[: len(y[::every])], y[::every])], 1.0 / STEP_S / every)
    assert chosen is not None and chosen.name == frame.name


def test_motion_that_follows_no_frame_tells_none() -> None:
    random = np.random.default_rng(3)
    assert choose_frame([Segment(random.normal(size=(600, 4)), random.normal(size=(600, 3)))], 10.0) is None
    assert choose_frame([], 10.0) is None


@pytest.mark.parametrize(("commands_hz", "hz"), [(10.0, 5.0), (10.0, 3.33), (2.0, 1.0)])
def test_the_trim_shows_how_large_a_lost_share_is(commands_hz: float, hz: float) -> None:
    fit = identify_trim([slow(*flight(120.0), hz, commands_hz)], hz, QUAD)
    faulty = slow(*flight(40.0, lost=(0.0, 0.15, 0.0, 0.0), seed=2), hz, commands_hz)
    v = fit.taps[0] * faulty.u[1:-1] + (1.0 - fit.taps[0]) * faulty.u[:-2]
    missing = faulty.y[2:, :2] - fit.a[:2] * faulty.y[1:-1, :2] - v @ fit.B[:2].T - fit.c[:2]
    lost = np.linalg.lstsq(-fit.B[:2, [1]], missing.mean(axis=0), rcond=None)[0][0]
    assert lost == pytest.approx(0.15 * faulty.u[:, 1].mean(), rel=0.15)


def test_a_seconds_mean_shows_a_lost_share_through_noise_that_hides_it_from_a_fifth_of_a_seconds() -> None:
    def scatter(hz: float) -> float:
        flown = slow(*flight(240.0, noise=0.3), hz, 100.0)
        fit = identify_trim([flown], hz, QUAD)
        v = fit.taps[0] * flown.u[1:-1] + (1.0 - fit.taps[0]) * flown.u[:-2]
        missing = flown.y[2:, :2] - fit.a[:2] * flown.y[1:-1, :2] - v @ fit.B[:2].T - fit.c[:2]
        lost = np.linalg.lstsq(-fit.B[:2, [1]], missing.T, rcond=None)[0][0]
        return float(lost.std())

    assert scatter(TRIM_HZ) < 0.35 * scatter(5.0)


def test_the_torque_of_a_turn_is_learned_where_one_was_flown() -> None:
    fit = identify_trim([slow(*flight(120.0), 5.0, 10.0)], 5.0, QUAD)
    assert fit.B[2, 0] * 4.0 * 5.0 == pytest.approx(AUTHORITY[2], rel=0.1)
    assert fit.a[2] == pytest.approx(np.exp(-DAMPING[2] / 5.0), abs=0.05)


def test_hovering_without_a_turn_leaves_yaw_out() -> None:
    fit = identify_trim([slow(*flight(120.0, turns=0.0), 5.0, 10.0)], 5.0, QUAD)
    assert fit.B.shape == (2, 4) and len(fit.a) == 2


def test_too_short_a_flight_is_refused() -> None:
    with pytest.raises(ModelError, match=r"only 1. s of healthy flight"):
        identify_trim([slow(*flight(15.0), 5.0, 10.0)], 5.0, QUAD)


def test_the_slower_the_commands_the_larger_the_smallest_loss_and_the_longer_evidence_has_to_last() -> None:
    brisk, hover = (slow(*flight(60.0, turns=turns), 5.0, 10.0) for turns in (1.5, 0.0))
    assert smallest_loss([brisk], 5.0) < smallest_loss([hover], 5.0) < smallest_loss([hover], 1.0)
    assert slow_times(0.5).raise_s == 10 * slow_times(5.0).raise_s


def test_commands_that_are_further_apart_than_what_happens_between_them_tell_as_much_each() -> None:
    hover = slow(*flight(60.0), 5.0, 10.0)
    assert smallest_loss([hover], 0.2) == smallest_loss([hover], 1.0) == pytest.approx(0.1)


@pytest.mark.parametrize(("at_rest", "refused"), [(4.0, False), (36.0, True)])
def test_motors_of_which_not_even_a_total_loss_would_stand_out_are_refused(at_rest: float, refused: bool) -> None:
    rule = AlarmRule("motors", "motor1", "actuator", "fraction of full command", 0.1, 0.05, 0.5, 0.1, 0.1)
    errors = ExcitationRule(("roll_rate",), at_rest, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0)
    smallest = _smallest({"motor1": 0.5}, [Calibrated(rule, None)], errors)
    assert smallest["motor1"][0] == pytest.approx(0.1 * np.sqrt(at_rest))
    with pytest.raises(ModelError, match="above 120 % of its command") if refused else nullcontext():
        _check_watched({"motor1": 0.5}, smallest)


def test_the_size_of_a_sudden_loss_is_said_beside_that_of_a_slow_one() -> None:
    rule = AlarmRule("motors", "motor1", "actuator", "fraction of full command", 0.01, 0.005, 0.5, 0.1, 0.1, least=0.01)
    said = [
        _lines({"motor1": 0.5}, {"motor1": (size, rule.unit)}, [Calibrated(rule, None)])[0] for size in (0.01, 0.03)
    ]
    assert said == [
        "motor1 alarm from 2 % of thrust (hovers at 0.50)",
        "motor1 alarm from 6 % of thrust, 2 % of thrust where it comes at once (hovers at 0.50)",
    ]
