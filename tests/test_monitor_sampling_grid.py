"""Ticks of a grid."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from monitor.core.sampling import Grid

RATES = st.floats(0.01, 1e6) | st.sampled_from([100.0, 33.3, 29.97, 3.0, 59.94005994])


@given(RATES, st.integers(0, 1 << 60))
def test_the_tick_at_or_after_a_time_is_the_first_one(rate_hz: float, time_ns: int) -> None:
    grid = Grid(rate_hz)
    index = grid.index_at(time_ns)
    assert grid.time_ns(index - 1) < time_ns <= grid.time_ns(index)


@pytest.mark.parametrize("rate_hz", [100.0, 30.0])
def test_ticks_are_whole_multiples_of_the_period_rounded(rate_hz: float) -> None:
    assert [Grid(rate_hz).time_ns(k) for k in range(4)] == [round(k * 1e9 / rate_hz) for k in range(4)]
