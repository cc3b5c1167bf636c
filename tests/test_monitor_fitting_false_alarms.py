"""The rate of false alarms that an alarm promises, against long simulated flights of the same noise."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from monitor.alarms.alarm import AlarmRule, retuned
from monitor.fitting.extremes import local_peaks, return_level
from monitor.fitting.thresholds import Times, calibrated, healthy_levels, plain_only

RATE_HZ = 25.0
FLIGHT_S = 480.0
HOURS = 20.0
BARE = AlarmRule("observer", "channel", "sensor", "m", 0.0, 0.0, 0.0, 0.0, 0.0)


def noise(tail: str, seconds: float, seed: int) -> NDArray[np.float64]:
    """Return sizes: Gaussian, of a strength that varies every ten seconds, or with the tails of Student's t."""
    rng, n = np.random.default_rng(seed), round(seconds * RATE_HZ)
    if tail == "t5":
        return np.abs(rng.standard_t(5, n))
    strength = np.exp(0.5 * np.repeat(rng.normal(size=n // 250 + 1), 250)[:n]) if tail == "varying" else 1.0
    return np.abs(rng.normal(size=n) * strength)


@pytest.mark.parametrize("tail", ["Gaussian", "varying", "t5"])
def test_the_expected_rate_is_right_within_an_order_of_magnitude_and_the_excluded_one_holds(tail: str) -> None:
    peaks = local_peaks(noise(tail, 3600.0 * HOURS, 0), RATE_HZ)
    excluded_per_hour = -math.log(0.05) * 3600.0 / FLIGHT_S
    true, expected = [], []
    for seed in range(1, 13):
        level = return_level([noise(tail, FLIGHT_S, seed)], RATE_HZ, 0.05)
        true.append((peaks >= level.level).sum() / HOURS)
        expected.append(level.per_hour(level.level))
    assert max(true) < excluded_per_hour
    assert 0.1 < np.mean(expected) / max(np.mean(true), 0.02) < 10.0


def test_a_tail_counts_what_it_has_seen_and_falls_with_size() -> None:
    sizes = noise("t5", FLIGHT_S, 5)
    level = return_level([sizes], RATE_HZ, 0.1)
    peaks = local_peaks(sizes, RATE_HZ)
    low = float(np.quantile(peaks, 0.2))
    assert level.per_hour(low) == pytest.approx((peaks >= low).sum() / (FLIGHT_S / 3600.0))
    rates = [level.per_hour(size) for size in np.linspace(0.0, 20.0, 60)]
    assert all(later <= sooner * (1.0 + 1e-9) for sooner, later in pairwise(rates))


def test_a_larger_smallest_size_has_fewer_false_alarms_and_a_removed_path_none() -> None:
    levels = healthy_levels([noise("Gaussian", FLIGHT_S, 3)], RATE_HZ, 0.1, Times())
    fine, coarse = (calibrated(BARE, levels, 1.0, floor=floor, critical=0.0, times=Times()) for floor in (0.0, 9.0))
    rates = [found.rated(FLIGHT_S).false_per_100h for found in (fine, coarse, plain_only(fine))]
    assert rates[0] is not None and rates[1] is not None and rates[2] is not None
    assert rates[1] < 0.1 * rates[0]
    assert rates[2] < rates[0]
    assert fine.rated(FLIGHT_S).excluded_per_100h == pytest.approx(2200.0)


def test_the_rate_of_an_alarm_does_not_outlive_a_change_of_its_sizes() -> None:
    rule = replace(BARE, threshold=1.0, false_per_100h=3.0, excluded_per_100h=2000.0)
    assert retuned(rule, {"threshold": 1.0}).false_per_100h == 3.0
    assert retuned(rule, {"threshold": 2.0}).false_per_100h is None
