"""The uncertainty that is shown is that of the estimates: it grows while coasting and shrinks when measured again."""

import numpy as np
import pytest
from cuts import cuts
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from test_monitor_coasting import plant

from gains.synthesis.certificate import certify
from gains.synthesis.compilation import compile_gains
from gains.synthesis.convex import design_convex
from gains.synthesis.gains_file import Gains
from monitor.estimation.affine import AffineObserver
from monitor.estimation.uncertainty import LAG_S, PRIOR_S, Uncertainty

NAMES = ("motor", "sensor")
RUNS = 250


@pytest.fixture(scope="module")
def gains() -> Gains:
    whole = plant()
    design = design_convex(whole)
    return compile_gains(whole, design, certify(whole, design))


def uncertainty(gains: Gains) -> Uncertainty:
    return Uncertainty(AffineObserver([gains]), plant(), NAMES)


def test_it_is_the_scatter_of_the_estimates_measured_coasted_and_resumed(gains: Gains) -> None:
    whole, rng = plant(), np.random.default_rng(1)
    measured = np.array([True] * 60 + [False] * 8 + [True] * 6 + [False] * 2 + [True] * 4)
    count = len(measured)
    errors = np.zeros((count, RUNS, 2))
    for run in range(RUNS):
        x, f, y = np.zeros(2), np.zeros((count, 2)), np.empty((count, 2))
        f[1:] = np.cumsum(0.01 * rng.normal(size=(count - 1, 2)), axis=0)
        for k in range(count):
            y[k] = x + [0.0, f[k, 1]] + 0.001 * rng.normal(size=2) * (k > 0)
            x = whole.A @ x + whole.E_f[:, 0] * f[k, 0] + 0.001 * rng.normal(size=2)
        errors[:, run] = AffineObserver([gains]).run(np.zeros((count, 1)), y, measured).fault - f
    shown = uncertainty(gains).run(measured, np.zeros(count, np.bool_))
    scatter = np.sqrt(np.mean(errors**2, axis=1))
    assert scatter[50:] == pytest.approx(shown[50:], rel=0.2)


def test_two_standard_deviations_hold_the_size_of_a_fault_19_times_of_20(gains: Gains) -> None:
    whole, rng, count, onset = plant(), np.random.default_rng(3), 80, 20

    def estimated(f: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the estimates of the runs' faults (RUNS * count, 2), which begin at the onset."""
        x, y = np.zeros((RUNS, 2)), np.empty((count, RUNS, 2))
        for k in range(count):
            fault = f * (k >= onset)
            y[k] = x + fault * [0.0, 1.0] + 0.001 * rng.normal(size=x.shape)
            x = x @ whole.A.T + np.outer(fault[:, 0], whole.E_f[:, 0]) + 0.001 * rng.normal(size=x.shape)
        restart = np.arange(count * RUNS) % count == 0
        series = y.swapaxes(0, 1).reshape(-1, 2)
        return AffineObserver([gains]).run(np.zeros((count * RUNS, 1)), series, restart=restart).fault

    # as a fit does: the errors of health give the scale; within LAG_S of its onset a step is still on its way
    health = estimated(np.zeros((RUNS, 2))).reshape(RUNS, count, 2)[:, onset:]
    begin, noise = onset + round(1.2 * LAG_S * gains.rate_hz), np.tile(health.std(axis=(0, 1)), (RUNS * count, 1))
    truth = 0.05 + 0.1 * rng.random((RUNS, 2))
    sizes = estimated(truth)
    sd = uncertainty(gains).of_sizes(noise, sizes, noise, np.ones_like(sizes))
    within = np.abs(sizes - np.repeat(truth, count, axis=0)) <= 2.0 * sd
    inside = within.reshape(RUNS, count, 2)[:, begin:].mean(axis=(0, 1))
    assert ((inside >= 0.90) & (inside <= 0.98)).all()


def test_it_grows_with_every_coasted_sample_and_comes_back_to_where_it_was(gains: Gains) -> None:
    measured = np.arange(2_011) > 10
    measured[0] = True
    sd = uncertainty(gains).run(measured, np.zeros(2_011, np.bool_))
    assert np.all(np.diff(sd[:11], axis=0) > 0.0)
    assert np.array_equal(sd[-1], sd[0])


def test_a_restart_begins_with_more_than_is_left_later(gains: Gains) -> None:
    sd = uncertainty(gains).run(np.ones(2, np.bool_), np.array([False, True]))
    assert sd[1, 0] > 2.0 * sd[0, 0]


def test_without_a_model_it_is_not_known(gains: Gains) -> None:
    shown = Uncertainty(AffineObserver([gains]), None, NAMES)
    assert np.isnan(shown.run(np.array([True, False, True]), np.array([True, False, False]))).all()


@given(
    parts=cuts(400),
    restarts=st.lists(st.integers(0, 399), max_size=3),
    lost=st.lists(st.tuples(st.integers(0, 399), st.integers(1, 4)), max_size=3),
)
def test_cuts_do_not_change_a_bit(
    gains: Gains, parts: list[slice], restarts: list[int], lost: list[tuple[int, int]]
) -> None:
    measured, restart = np.ones(400, np.bool_), np.zeros(400, np.bool_)
    for start, length in lost:
        measured[start : start + length] = False
    restart[restarts] = True
    whole, cut = uncertainty(gains).run(measured, restart), uncertainty(gains)
    assert np.concatenate([cut.run(measured[part], restart[part]) for part in parts]).tobytes() == whole.tobytes()


@given(parts=cuts(60))
def test_cuts_do_not_change_a_bit_of_what_sizes_add(gains: Gains, parts: list[slice]) -> None:
    sizes, sd = np.random.default_rng(2).normal(size=(60, 2)), np.full((60, 2), 0.1)
    columns = sd, sizes, sd, np.ones((60, 2))
    whole, cut = uncertainty(gains).of_sizes(*columns), uncertainty(gains)
    assert np.concatenate([cut.of_sizes(*(q[part] for q in columns)) for part in parts]).tobytes() == whole.tobytes()


@pytest.mark.parametrize("larger", [0.4, 1.0, 2.0])
def test_a_flight_tells_how_large_its_errors_are_and_a_fault_does_not_count(gains: Gains, larger: float) -> None:
    rng, flown_s = np.random.default_rng(5), 30.0
    count = round(flown_s * gains.rate_hz)
    sd, healthy = np.full((2 * count, 2), 0.1), np.arange(2 * count) < count
    fault = larger * sd * rng.normal(size=sd.shape) + 10.0 * ~healthy[:, None]
    factor = uncertainty(gains).of_flight(sd, fault, np.ones(2 * count), healthy)
    known = np.sqrt((PRIOR_S + larger**2 * flown_s) / (PRIOR_S + flown_s))
    assert factor[0] == pytest.approx(1.0)
    assert factor[count:] == pytest.approx(np.full((count, 2), known), rel=0.05)
    # gusts that the residuals show, too, are no error of the whole flight
    gusts = uncertainty(gains).of_flight(sd, fault, np.full(2 * count, larger**2), healthy)
    assert gusts[-1] == pytest.approx(min(known, 1.0) if larger < 1.0 else larger, rel=0.05)


@given(parts=cuts(60))
def test_cuts_do_not_change_a_bit_of_what_a_flight_tells(gains: Gains, parts: list[slice]) -> None:
    fault, sd = np.random.default_rng(6).normal(size=(60, 2)), np.full((60, 2), 0.7)
    columns = sd, fault, np.full(60, 1.2), np.arange(60) % 7 > 0
    whole, cut = uncertainty(gains).of_flight(*columns), uncertainty(gains)
    assert np.concatenate([cut.of_flight(*(q[part] for q in columns)) for part in parts]).tobytes() == whole.tobytes()


def lag_s(gains: Gains) -> float:
    (system,) = AffineObserver([gains]).error_systems(plant()) or ()
    return float(system.lag_s[0])


def test_a_size_is_uncertain_by_what_is_missing_of_a_ramp_and_at_least_by_that_of_a_step(gains: Gains) -> None:
    seconds = np.arange(2_000) / gains.rate_hz
    delay_s = LAG_S / np.log(2.0) + lag_s(gains)
    sizes = np.column_stack([20.0 * -np.expm1(-seconds / delay_s), seconds])
    noise = np.full((2_000, 2), 1e-6)
    sd = uncertainty(gains).of_sizes(noise, sizes, noise, np.ones_like(noise))
    missing = 20.0 - sizes[:, 0]
    begun = (seconds > LAG_S) & (missing > 1e-3)
    share = sd[begun, 0] / missing[begun]
    assert (share > 1.0).all() and (share < 1.5).all()
    assert sd[-1, 1] == pytest.approx(LAG_S / np.log(2.0), rel=0.05)


def test_a_slow_ramp_is_missed_by_its_lag_where_health_is_known_to_wander_slower_than_white_noise(gains: Gains) -> None:
    sizes, noise = 0.2 * np.arange(800)[:, None] / gains.rate_hz * [0.0, 1.0], np.full((800, 2), 0.1)
    still = {"sensor": 0.01}
    white, slow, on_lines = (
        Uncertainty(AffineObserver([gains]), plant(), NAMES, moves=moves, lines_s=lines_s).of_sizes(
            noise, sizes, noise, np.ones_like(noise)
        )[-1, 1]
        for moves, lines_s in (({}, {}), (still, {}), (still, {"sensor": 1.2}))
    )
    assert white == pytest.approx(0.1)
    assert slow == pytest.approx(np.hypot(0.1, 0.2 * LAG_S / np.log(2.0)), rel=0.05)
    assert on_lines == pytest.approx(np.hypot(0.1, 0.2 * (LAG_S / np.log(2.0) + 1.0)), rel=0.05)


def test_a_constant_share_of_a_command_does_not_move(gains: Gains) -> None:
    full = np.column_stack([1.0 + 0.5 * np.sin(np.arange(200.0)), np.ones(200)])
    noise = np.full((200, 2), 0.001)
    sd = uncertainty(gains).of_sizes(noise, -0.1 * full, noise, full)
    assert sd[50:] == pytest.approx(noise[50:])
