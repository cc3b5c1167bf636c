"""Taps say what delay, lag and filter do to a sampled input."""

import numpy as np
import pytest
import scipy
from hypothesis import given
from hypothesis import strategies as st

from gains.identification.lag import followed, lag_taps, shortened

RATE_HZ = 100.0

times = st.tuples(st.floats(-0.01, 0.1), st.floats(0.0, 0.15), st.floats(0.0, 0.05))


@given(times)
def test_taps_add_up_to_one_and_come_as_late_as_delay_lag_and_filter_say(times_s: tuple[float, float, float]) -> None:
    taps = lag_taps(np.array(times_s), RATE_HZ)
    assert taps.sum() == pytest.approx(1.0)
    # over the step after a sample an input acts half a step later than at it; what comes earlier counts as at it
    late_s = float(taps @ np.arange(len(taps))) / RATE_HZ + 0.5 / RATE_HZ
    assert sum(times_s) - 1e-3 < late_s < max(sum(times_s), 0.5 / RATE_HZ) + 0.0035


def test_a_slow_input_after_lag_and_delay_is_followed_within_a_thousandth() -> None:
    fine = 100
    t = np.arange(0.0, 20.0, 1.0 / RATE_HZ / fine)
    u = np.sin(2 * np.pi * 1.5 * t) + 0.3 * np.cos(2 * np.pi * 4.0 * t)
    keep = np.exp(-1.0 / (RATE_HZ * fine * 0.05))
    lagged = scipy.signal.lfilter([1.0 - keep], [1.0, -keep], np.concatenate([np.zeros(2 * fine), u[: -2 * fine]]))
    means = np.asarray(lagged).reshape(-1, fine).mean(axis=1)
    taps = lag_taps(np.array([0.02, 0.05, 0.0]), RATE_HZ)
    mean = scipy.signal.lfilter(taps, [1.0], u[::fine])
    assert np.abs(np.asarray(mean) - means)[200:].max() < 2e-3


def test_a_running_model_has_the_fewest_taps_that_hold_the_response() -> None:
    whole = lag_taps(np.array([0.0, 0.05, 0.0]), RATE_HZ)
    few = shortened(whole)
    assert len(few) < 0.7 * len(whole)
    assert few.sum() == pytest.approx(1.0)
    assert few == pytest.approx(whole[: len(few)], rel=6e-3)


def test_a_first_order_recursion_goes_on_from_its_start_in_each_row() -> None:
    drive = np.random.default_rng(1).normal(size=(3, 50))
    x = followed(drive, 0.9, 2.0)
    assert x[:, 0] == pytest.approx(2.0)
    assert x[:, 1:] == pytest.approx(0.9 * x[:, :-1] + drive)
    assert followed(drive[1], 0.9, 2.0) == pytest.approx(x[1])
