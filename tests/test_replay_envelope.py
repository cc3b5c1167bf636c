"""A long series is thinned without losing a peak."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from replay.reports.plot_panels import band, envelope


@given(
    values=st.lists(st.floats(-1e6, 1e6) | st.just(float("nan")), max_size=400),
    restarts=st.sets(st.integers(0, 399)),
    bins=st.integers(1, 50),
)
def test_an_envelope_keeps_every_peak_in_order_and_breaks_at_restarts(
    values: list[float], restarts: set[int], bins: int
) -> None:
    series = np.array(values)
    times = np.arange(len(values), dtype=float)
    restart = np.array([index in restarts for index in range(len(values))], dtype=bool)
    drawn_times, drawn = envelope(times, series, restart, bins)
    broken = np.isnan(drawn_times)
    if not len(values):
        assert drawn.size == 0
        return
    assert broken.sum() == np.count_nonzero(restart[1:])
    assert (np.diff(drawn_times[~broken]) >= 0).all()
    np.testing.assert_array_equal(series[drawn_times[~broken].astype(int)], drawn[~broken])
    if not np.isnan(series).all() and not np.isnan(series).any():
        assert np.nanmax(drawn) == series.max()
        assert np.nanmin(drawn) == series.min()


def test_a_long_recording_is_drawn_with_few_points() -> None:
    values = np.random.default_rng(1).normal(size=1_000_000)
    values[123_456] = 50.0
    times, drawn = envelope(np.arange(1e6), values, np.zeros(1_000_000, bool))
    assert times.size < 3100
    assert drawn.max() == 50.0
    assert times[drawn.argmax()] == 123_456


def test_a_band_keeps_its_ends_and_is_broken_where_there_is_nothing() -> None:
    times = np.arange(1000.0)
    low, high = -np.ones(1000), np.ones(1000)
    low[500], high[77] = -9.0, 9.0
    low[200:300] = high[200:300] = np.nan
    thinned, below, above = band(times, low, high, 100)
    assert len(thinned) == 100
    assert (np.nanmin(below), np.nanmax(above)) == (-9.0, 9.0)
    assert np.isnan(below[20:30]).all()
    assert np.isfinite(np.delete(above, np.arange(20, 30))).all()
    assert band(times, low, high, 5000)[0] is times
