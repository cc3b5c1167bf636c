"""Thresholds: levels from healthy evidence, floors, and the three paths' sizes in their order."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adapters.logs.recordings import read_batches
from adapters.sample import Given
from monitor.chain import ObserverChain
from monitor.core.sampling import VehicleClock
from monitor.fitting.fitted import bare_rule
from monitor.fitting.flights import flight_samples
from monitor.fitting.thresholds import Times, calibrated, healthy_evidence, healthy_levels, plain_only, weighted_mean
from monitor.profile import Profile

RATE_HZ = 50.0
BARE = bare_rule("motors", "motor1", "actuator", "share")


def noise(seed: int, size: float = 1.0, count: int = 6000) -> np.ndarray:
    return weighted_mean(np.random.default_rng(seed).normal(0.0, size, count), 0.1, RATE_HZ)


@settings(max_examples=10)
@given(seed=st.integers(0, 100), size=st.floats(1e-4, 1e3))
def test_levels_grow_with_the_evidence_and_the_paths_keep_their_order(seed: int, size: float) -> None:
    levels = healthy_levels([noise(seed, size)], RATE_HZ, 0.1, Times())
    again = healthy_levels([noise(seed, 2.0 * size)], RATE_HZ, 0.1, Times())
    rule = calibrated(BARE, levels, 1.0, floor=0.0, critical=0.0, times=Times()).rule
    # The tails are fitted one by one and may cross; the sizes of a rule may not.
    assert rule.slow < rule.threshold < rule.fast
    assert levels.slow.level < levels.plain.level
    assert again.plain.level == pytest.approx(2.0 * levels.plain.level, rel=0.05)
    assert levels.plain.low <= levels.plain.level <= levels.plain.high


def test_a_floor_holds_where_healthy_evidence_is_small() -> None:
    levels = healthy_levels([noise(0, 1e-6)], RATE_HZ, 0.1, Times())
    rule = calibrated(BARE, levels, 1.0, floor=0.5, critical=0.8, times=Times()).rule
    assert (rule.threshold, rule.clear, rule.critical) == (0.5, 0.25, 1.0)
    assert (rule.fast, rule.slow) == (1.0, 0.25)
    assert (rule.observer, rule.channel, rule.unit) == ("motors", "motor1", "share")


def test_the_level_is_taken_back_to_the_channel_it_was_pooled_for() -> None:
    levels = healthy_levels([noise(1)], RATE_HZ, 0.1, Times())
    small = calibrated(BARE, levels, 0.1, floor=0.0, critical=0.0, times=Times()).rule
    large = calibrated(BARE, levels, 1.0, floor=0.0, critical=0.0, times=Times()).rule
    assert large.threshold == pytest.approx(10.0 * small.threshold, rel=1e-3)


def test_rare_steps_are_extrapolated_no_further_than_told() -> None:
    steps = np.zeros(6000)
    steps[[100, 2000, 4000]] = 0.02, 0.03, 0.025
    still = Times(fast_s=0.0, raise_s=0.0)
    assert healthy_levels([steps], RATE_HZ, 0.01, still, most=1.5).plain.level == pytest.approx(0.045, rel=0.05)
    assert healthy_levels([steps], RATE_HZ, 0.01, still).plain.level > 0.05


def test_an_alarm_with_its_plain_path_alone_has_no_other() -> None:
    found = calibrated(BARE, healthy_levels([noise(2)], RATE_HZ, 0.1, Times()), 1.0, floor=0, critical=0, times=Times())
    rule = plain_only(found).rule
    assert (rule.fast, rule.slow, rule.latch_s) == (math.inf, math.inf, 0.0)


def test_a_long_wait_before_the_flight_changes_nothing_that_matters(quad_profile: Profile, data: Path) -> None:
    observer = quad_profile.observers[0]
    batches = read_batches(data / "copter_healthy_square.tlog.xz")
    flight = flight_samples(batches, observer.source, observer.rate_hz, quad_profile.gate)
    start = round(0.8 * len(flight))
    assert start > 32 * observer.rate_hz
    waited = replace(flight, armed=flight.armed & (np.arange(len(flight)) >= start))
    chain = ObserverChain(observer, "", quad_profile.gate, VehicleClock())
    whole = chain.estimate(Given(waited.samples), waited.armed).estimates.isolated[waited.armed]
    found = np.concatenate(healthy_evidence(observer, quad_profile.gate, [waited]))
    assert np.allclose(found[:, :-1], whole, atol=1e-6)


def test_a_recording_that_never_counts_has_no_evidence(quad_profile: Profile, data: Path) -> None:
    observer = quad_profile.observers[0]
    batches = read_batches(data / "copter_5s.tlog.xz")
    flight = flight_samples(batches, observer.source, observer.rate_hz, quad_profile.gate)
    assert healthy_evidence(observer, quad_profile.gate, [replace(flight, armed=np.zeros_like(flight.armed))]) == []
