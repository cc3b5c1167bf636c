"""Extreme values: the level exceeded at a stated rate, from minutes of data whose truth is known."""

import numpy as np
import pytest
import scipy
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from monitor.alarms.alarm import Alarm, AlarmRule
from monitor.core.alarms import ChainRows, walk
from monitor.fitting.extremes import local_peaks, return_level, standing

RATE_HZ = 50.0
TRIALS = 40
STEP_NS = 10_000_000


def minutes(number: float) -> int:
    return round(60.0 * number * RATE_HZ)


def gaussian(rng: np.random.Generator, size: int, correlation_s: float) -> NDArray[np.float64]:
    """Return sizes of a stationary Gaussian AR(1) of unit variance."""
    keep = np.exp(-1.0 / (RATE_HZ * correlation_s))
    noise = rng.normal(size=size + 1000)
    return np.abs(scipy.signal.lfilter([np.sqrt(1.0 - keep**2)], [1.0, -keep], noise)[1000:])


def exceeded(alarms_per_hour: float) -> float:
    """Return the probability per independent sample that gives this rate."""
    return alarms_per_hour / (3600.0 * RATE_HZ)


def test_exponential_data_gives_the_exact_level_thousandfold_beyond_it() -> None:
    truth = -np.log(exceeded(0.01))
    levels = [
        return_level([np.random.default_rng(seed).exponential(size=minutes(4))], RATE_HZ, 0.01)
        for seed in range(TRIALS)
    ]
    assert sum(one.low <= truth <= one.high for one in levels) >= 0.85 * TRIALS
    assert np.median([one.level for one in levels]) == pytest.approx(truth, rel=0.15)
    assert max(one.high for one in levels) < 5.0 * truth


@pytest.mark.parametrize("correlation_s", [0.1, 1.0])
def test_correlated_gaussian_data_is_not_judged_too_low(correlation_s: float) -> None:
    rate = 0.5
    rng = np.random.default_rng(7)
    peaks = np.sort(
        np.concatenate([local_peaks(gaussian(rng, minutes(240), correlation_s), RATE_HZ) for _ in "123456"])
    )
    truth = peaks[-round(24 * rate)]
    levels = [
        return_level([gaussian(np.random.default_rng(seed), minutes(6), correlation_s)], RATE_HZ, rate)
        for seed in range(TRIALS)
    ]
    assert sum(one.low <= truth <= one.high for one in levels) >= 0.7 * TRIALS
    assert sum(truth <= one.high for one in levels) >= 0.95 * TRIALS
    assert 0.95 * truth < np.median([one.level for one in levels]) < 1.35 * truth


def test_heavy_tails_are_seen_and_reach_higher_than_light_ones() -> None:
    truth = float(scipy.stats.t.isf(exceeded(1.0) / 2.0, 5))
    levels = [
        return_level([np.abs(np.random.default_rng(seed).standard_t(5, size=minutes(6)))], RATE_HZ, 1.0)
        for seed in range(TRIALS)
    ]
    assert sum(one.low <= truth <= one.high for one in levels) >= 0.7 * TRIALS
    assert 0.65 * truth < np.median([one.level for one in levels]) < 1.2 * truth
    assert max(one.high for one in levels) < 4.0 * truth


@st.composite
def flights(draw: st.DrawFn) -> list[NDArray[np.float64]]:
    """Draw one to three stretches of exponential sizes, some of them mostly zero."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    floor = draw(st.sampled_from([0.0, 2.0, 6.0]))
    lengths = draw(st.lists(st.integers(1, 5000), min_size=1, max_size=3))
    return [np.maximum(rng.exponential(size=length) - floor, 0.0) for length in lengths]


@given(flights(), st.floats(1e-4, 1e4), st.floats(1.0, 1e3))
def test_rarer_alarms_need_higher_levels(series: list[NDArray[np.float64]], rate: float, factor: float) -> None:
    often, seldom = (return_level(series, RATE_HZ, r) for r in (rate * factor, rate))
    assert often.level <= seldom.level
    assert often.high <= seldom.high
    assert often.peaks == seldom.peaks


@given(flights(), st.floats(1e-6, 1e6))
def test_levels_scale_with_the_data(series: list[NDArray[np.float64]], factor: float) -> None:
    one = return_level(series, RATE_HZ, 0.1)
    scaled = return_level([factor * stretch for stretch in series], RATE_HZ, 0.1)
    assert (scaled.level, scaled.low, scaled.high) == pytest.approx(
        (factor * one.level, factor * one.low, factor * one.high), rel=1e-6
    )


@given(flights(), st.floats(1e-4, 1e4), st.floats(0.5, 0.99))
def test_a_level_is_never_below_what_was_seen_and_never_absurd(
    series: list[NDArray[np.float64]], rate: float, confidence: float
) -> None:
    found = return_level(series, RATE_HZ, rate, confidence)
    largest = max(float(stretch.max()) for stretch in series)
    assert found.level >= largest
    assert found.low <= found.level <= found.high
    # From at least one peak in at most 5 minutes: xi and sigma at their limits all along.
    growth = max(1.0, found.peaks / (found.hours * rate))
    assert found.high <= largest * (1.0 + 3.0 * (growth**0.3 - 1.0) / 0.3) + 1e-12
    assert return_level(series, RATE_HZ, rate, confidence) == found


def test_more_confidence_gives_wider_limits() -> None:
    series = [np.random.default_rng(3).exponential(size=minutes(3))]
    narrow, wide = (return_level(series, RATE_HZ, 0.1, confidence) for confidence in (0.5, 0.99))
    assert wide.low < narrow.low < narrow.level < narrow.high < wide.high


def test_more_flight_narrows_the_limits() -> None:
    values = np.random.default_rng(3).exponential(size=minutes(60))
    short, long = return_level([values[: minutes(3)]], RATE_HZ, 0.1), return_level([values], RATE_HZ, 0.1)
    assert long.high - long.low < 0.7 * (short.high - short.low)
    assert long.hours == pytest.approx(1.0)


def test_evidence_that_was_always_zero_gives_zero() -> None:
    found = return_level([np.zeros(1000)], RATE_HZ, 0.01)
    assert (found.level, found.low, found.high, found.peaks) == (0.0, 0.0, 0.0, 0)


def test_evidence_of_one_burst_gives_a_finite_level_above_it() -> None:
    values = np.zeros(minutes(4))
    values[5000:5010] = 0.02
    found = return_level([values], RATE_HZ, 0.01)
    assert found.peaks == 1
    assert 0.02 < found.level < found.high < 100 * 0.02


def test_peaks_that_are_all_equal_give_a_level_above_them() -> None:
    values = np.zeros(minutes(4))
    values[::500] = 0.02
    found = return_level([values], RATE_HZ, 0.01)
    assert 0.02 < found.level < found.high < 100 * 0.02


def test_peaks_are_one_burst_each_and_stretches_do_not_touch() -> None:
    burst = np.zeros(1000)
    burst[[100, 120, 150]] = 1.0, 3.0, 2.0
    burst[600:650] = 2.5
    assert local_peaks(burst, RATE_HZ)[local_peaks(burst, RATE_HZ) > 0.0].tolist() == [3.0, 2.5]
    assert return_level([burst, burst], RATE_HZ, 1.0).peaks == 4


@pytest.mark.parametrize(
    ("series", "rate_hz", "alarms", "confidence"),
    [
        ([], 50.0, 0.1, 0.9),
        ([np.zeros(0)], 50.0, 0.1, 0.9),
        ([np.array([1.0, np.nan])], 50.0, 0.1, 0.9),
        ([np.ones(9)], 0.0, 0.1, 0.9),
        ([np.ones(9)], 50.0, 0.0, 0.9),
        ([np.ones(9)], 50.0, 0.1, 1.0),
    ],
)
def test_what_cannot_be_extrapolated_is_refused(
    series: list[NDArray[np.float64]], rate_hz: float, alarms: float, confidence: float
) -> None:
    with pytest.raises(ValueError, match=r"healthy statistic|must be positive"):
        return_level(series, rate_hz, alarms, confidence)


@given(st.integers(0, 2**32 - 1), st.integers(1, 20), st.floats(0.05, 3.0))
def test_an_alarm_is_raised_first_where_the_standing_size_reaches_its_threshold(
    seed: int, samples: int, threshold: float
) -> None:
    rng = np.random.default_rng(seed)
    values = np.concatenate([[0.0], np.abs(scipy.signal.lfilter([0.3], [1.0, -0.9], rng.normal(size=400)))])
    rule = AlarmRule("motors", "motor1", "actuator", "", threshold, 0.0, 99.0, samples / 100.0, 1.0)
    alarm = Alarm(rule, "copter")
    index, always = np.arange(len(values)), np.ones((len(values), 1), np.bool_)
    rows = ChainRows([alarm.state], index, index * STEP_NS, np.zeros(len(values), np.bool_), values[:, None], always)
    events: list[int] = []
    walk([rows], lambda _observer, row, _alarm, _code: events.append(row))
    raised = events[0] if events else None
    stood = standing(values, samples)
    surely = np.flatnonzero(stood >= 1.011 * threshold)
    possibly = np.flatnonzero(stood >= threshold)
    if raised is None:
        assert not len(surely)
    else:
        assert possibly[0] <= raised
        assert not len(surely) or raised <= surely[0]


def test_standing_sizes_survive_a_dip_that_a_windowed_minimum_does_not() -> None:
    values = np.ones(41)
    values[[0, 20]] = 0.0
    stood = standing(values, 25)
    assert stood.max() == 1.0
    assert np.lib.stride_tricks.sliding_window_view(values, 25).min(axis=-1).max() == 0.0
    assert standing(np.zeros(5), 2).tolist() == [0.0] * 5
    assert standing(np.zeros(0), 2).tolist() == []
