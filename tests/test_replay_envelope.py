"""A long series is thinned without losing a peak."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from replay.reports.charts import kept_rows


@given(
    values=st.lists(st.floats(-1e6, 1e6) | st.just(float("nan")), max_size=400),
    restarts=st.sets(st.integers(0, 399)),
    bins=st.integers(1, 50),
)
def test_what_is_kept_has_every_peak_in_order_and_each_restart(
    values: list[float], restarts: set[int], bins: int
) -> None:
    series = np.array(values)
    restart = np.array([index in restarts for index in range(len(values))], dtype=bool)
    rows = kept_rows(series, restart, bins)
    assert (np.diff(rows) > 0).all()
    assert set(np.flatnonzero(restart)) <= set(rows.tolist())
    if len(values) and not np.isnan(series).any():
        assert series[rows].max() == series.max()
        assert series[rows].min() == series.min()


def test_a_long_recording_is_drawn_with_few_points() -> None:
    values = np.random.default_rng(1).normal(size=1_000_000)
    values[123_456] = 50.0
    rows = kept_rows(values, np.zeros(1_000_000, bool), 1500)
    assert len(rows) < 3100
    assert rows[values[rows].argmax()] == 123_456
