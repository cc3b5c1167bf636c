"""Sensors that are frozen: one reading that stays for longer than chance allows."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from monitor.core.repeats import Frozen

IMU = 2
HOLD, READING = 60, 20


def watched(baro: NDArray[np.float64], cut: int = 0, lost: slice = slice(0)) -> NDArray[np.bool_]:
    """Return where the barometer is found frozen beside an IMU that never repeats; two batches, cut anywhere."""
    count = len(baro)
    signals = np.column_stack([np.arange(count) * 0.1, np.arange(count) * 0.2, baro])
    missing, restart = np.zeros(signals.shape, np.uint8), np.zeros(count, np.uint8)
    missing[lost, IMU] = 1
    frozen = Frozen([IMU], [1], [HOLD], [READING], IMU)
    parts = (slice(0, cut), slice(cut, count))
    return np.concatenate([frozen.run(signals[part], missing[part], restart[part])[:, 0] for part in parts])


def held(period: int, count: int) -> NDArray[np.float64]:
    """Return ``count`` readings that differ, each for ``period`` ticks."""
    return np.repeat(np.random.default_rng(0).normal(size=count), period)


@given(st.integers(0, 300))
def test_a_reading_that_stays_is_frozen_after_its_time_and_until_it_changes(cut: int) -> None:
    baro = held(10, 30)
    baro[150:240] = baro[150]
    found = watched(baro, cut)
    assert np.flatnonzero(found).tolist() == list(range(150 + HOLD, 240))


@given(st.integers(1, 200))
def test_readings_that_come_less_often_than_in_the_fitted_flights_are_not_frozen(period: int) -> None:
    baro = held(period, 30)
    # two readings in succession may be equal by chance
    baro[10 * period : 12 * period] = baro[10 * period]
    assert not watched(baro).any()


@pytest.mark.parametrize("slower", [1, 3])
def test_slower_readings_are_frozen_in_proportion_later(slower: int) -> None:
    baro = held(READING * slower, 20)
    first = 10 * READING * slower
    baro[first:] = baro[first]
    assert np.flatnonzero(watched(baro))[0] == first + HOLD * slower


def test_what_was_lost_is_not_frozen() -> None:
    baro = held(10, 40)
    baro[150:350] = baro[150]
    found = watched(baro, lost=slice(160, 350))
    assert not found.any()


def test_telemetry_that_stands_still_as_a_whole_is_no_frozen_sensor() -> None:
    signals = np.column_stack([held(10, 30)] * 3)
    signals[100:] = signals[100]
    none = np.zeros(signals.shape, np.uint8)
    assert not Frozen([IMU], [1], [HOLD], [READING], IMU).run(signals, none, none[:, 0].copy()).any()
