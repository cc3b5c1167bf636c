"""The inverse of the washout: steps, ramps, their ends, and what healthy operation leaves."""

from __future__ import annotations

import math

import numpy as np
import pytest
from cuts import cuts, same_bits
from hypothesis import given
from hypothesis import strategies as st

from monitor.estimation.bank import washout_inverse

RATE, TAU, THRESHOLD = 25.0, 30.0, 0.5


def wash(fault: np.ndarray) -> np.ndarray:
    """Return the fault as the transform and an observer show it."""
    keep = math.exp(-1.0 / (TAU * RATE))
    gain = TAU * (1.0 - keep) * RATE
    washed = np.zeros(len(fault))
    for k in range(1, len(fault)):
        washed[k] = keep * washed[k - 1] + gain * (fault[k] - fault[k - 1])
    return washed


def given_back(washed: np.ndarray) -> np.ndarray:
    return washout_inverse(TAU, RATE, THRESHOLD).run(washed)


def seconds(count: float) -> np.ndarray:
    return np.arange(round(count * RATE)) / RATE


def test_a_step_lasts_as_long_as_the_fault_and_ends_with_it() -> None:
    t = seconds(400.0)
    fault = np.where((t > 10.0) & (t < 60.0), 25.0, 0.0)
    estimate = given_back(wash(fault))
    during = (t > 10.5) & (t < 60.0)
    assert estimate[during] == pytest.approx(fault[during], rel=0.01)
    assert np.max(np.abs(estimate[t > 60.5])) <= THRESHOLD


def test_a_ramp_is_followed() -> None:
    t = seconds(150.0)
    fault = np.clip(0.5 * (t - 10.0), 0.0, 30.0)
    estimate = given_back(wash(fault))
    late = t > 14.0
    assert estimate[late] == pytest.approx(fault[late], rel=0.1, abs=0.1)


def test_a_fault_that_is_washed_out_altogether_is_let_go_after_30_s_and_its_end_is_no_other_fault() -> None:
    t = seconds(900.0)
    fault = np.where((t > 10.0) & (t < 400.0), -8.0, 0.0) + np.where(t > 700.0, 3.0, 0.0)
    estimate = given_back(wash(fault))
    # after 30 s ln(8 / 0.25) the washed-out estimate is half of the threshold
    quiet = 10.0 + TAU * math.log(8.0 / 0.25)
    assert estimate[(t > 11.0) & (t < quiet + 29.0)] == pytest.approx(-8.0, rel=0.05)
    assert np.max(np.abs(estimate[(t > quiet + 31.0) & (t < 700.0)])) <= THRESHOLD
    assert estimate[(t > 700.5) & (t < 760.0)] == pytest.approx(3.0, rel=0.1)


def test_what_follows_a_fault_that_was_let_go_is_seen_though_it_goes_the_other_way() -> None:
    t = seconds(400.0)
    fault = np.where(t > 10.0, -2.0, 0.0) + np.where(t > 300.0, 12.0, 0.0)
    estimate = given_back(wash(fault))
    assert estimate[(t > 301.5) & (t < 350.0)] == pytest.approx(12.0, rel=0.1)


@given(
    size=st.floats(0.8, 50.0), lasts=st.floats(5.0, 90.0), smoothing=st.floats(0.05, 0.5), sign=st.sampled_from([-1, 1])
)
def test_no_step_leaves_an_alarm_of_the_other_sign(size: float, lasts: float, smoothing: float, sign: int) -> None:
    t = seconds(200.0)
    washed = wash(np.where((t > 10.0) & (t < 10.0 + lasts), sign * size, 0.0))
    keep = math.exp(-1.0 / (smoothing * RATE))
    for k in range(1, len(washed)):
        washed[k] = keep * washed[k - 1] + (1.0 - keep) * washed[k]
    after = t > 10.0 + lasts + 10.0 * smoothing
    assert np.max(np.abs(given_back(washed)[after])) <= THRESHOLD


def test_errors_of_a_tenth_do_not_outlive_the_fault() -> None:
    t = seconds(200.0)
    fault = np.where((t > 10.0) & (t < 60.0), 25.0, 0.0)
    washed = wash(fault)
    washed[t < 60.0] *= 1.05
    assert np.max(np.abs(given_back(washed)[t > 60.5])) <= THRESHOLD


def test_healthy_operation_passes_unchanged_and_adds_up_to_nothing() -> None:
    t = seconds(600.0)
    washed = 0.24 * np.sin(0.01 * t)
    assert np.array_equal(given_back(washed), washed)


def test_a_brush_with_the_threshold_leaves_nothing_behind() -> None:
    t = seconds(100.0)
    washed = np.where((t > 10.0) & (t < 12.0), 0.45, 0.1)
    estimate = given_back(washed)
    assert np.array_equal(estimate[t > 12.1], washed[t > 12.1])


def test_a_second_fault_after_the_first_is_measured_afresh() -> None:
    t = seconds(500.0)
    fault = np.where((t > 10.0) & (t < 30.0), 5.0, 0.0) + np.where(t > 350.0, 2.0, 0.0)
    estimate = given_back(wash(fault))
    assert estimate[(t > 351.0) & (t < 400.0)] == pytest.approx(2.0, rel=0.1)


def test_the_largest_size_is_kept_while_the_fault_lasts() -> None:
    washout = washout_inverse(TAU, RATE, THRESHOLD)
    washout.run(np.full(200, 5.0))
    assert washout.peak > 5.0


@given(seed=st.integers(0, 10_000), parts=cuts(1_500))
def test_cuts_do_not_change_a_bit(seed: int, parts: list[slice]) -> None:
    rng = np.random.default_rng(seed)
    fault = 3.0 * np.cumsum(rng.choice([0.0, -1.0, 1.0], p=[0.98, 0.01, 0.01], size=1_500))
    washed = wash(fault) + rng.choice([0.0, 0.05, 0.2]) * rng.normal(size=1_500)
    washed[rng.random(1_500) < 0.001] = rng.choice([np.nan, np.inf, -0.0])
    cut = washout_inverse(TAU, RATE, THRESHOLD)
    assert same_bits(np.concatenate([cut.run(washed[part]) for part in parts]), given_back(washed))
