"""The picture of a run: drawn for every kind of run, and thinned without losing a peak."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib import image
from synthetic_run import LAYOUT, THRESHOLDS, event, trace

from monitor.palette import BLUE, SEVERITY, rgba
from monitor.trace import TraceBuilder
from replay.plot import envelope, plot_png

EVENTS = [event(1020, "raised"), event(1300, "cleared"), event(1400, "raised", id="02J", severity="critical")]


def has_colour(path: Path, colour: str, alpha: float = 1.0) -> bool:
    """Return whether the picture has pixels of a colour laid over white."""
    wanted = 1.0 + alpha * (np.array(rgba(colour)[:3]) / 255.0 - 1.0)
    return bool((np.abs(image.imread(path)[:, :, :3] - wanted).max(axis=2) < 0.01).any())


def test_estimates_and_alarms_are_drawn_in_their_colours(tmp_path: Path) -> None:
    run = trace()
    truth = {"motor1": (run.vehicle_ns / 1e9, np.where(run.vehicle_ns >= 10_000_000_000, -0.03, 0.0))}
    plot_png(tmp_path / "run.png", [run], EVENTS, THRESHOLDS, truth, "a run")
    assert has_colour(tmp_path / "run.png", BLUE)
    assert has_colour(tmp_path / "run.png", SEVERITY["warning"], 0.25)
    assert has_colour(tmp_path / "run.png", SEVERITY["critical"], 0.25)
    plot_png(tmp_path / "calm.png", [run], [], THRESHOLDS)
    assert not has_colour(tmp_path / "calm.png", SEVERITY["critical"], 0.25)


def test_each_observer_adds_its_panels(tmp_path: Path) -> None:
    plot_png(tmp_path / "one.png", [trace(200)], [], {})
    plot_png(tmp_path / "two.png", [trace(200), trace(200)], [], {})
    one, two = (image.imread(tmp_path / name).shape[0] for name in ("one.png", "two.png"))
    assert two > 1.8 * one


def test_runs_with_nothing_to_draw_are_drawn_too(tmp_path: Path) -> None:
    empty = TraceBuilder(LAYOUT).build()
    plot_png(tmp_path / "empty.png", [empty], EVENTS, THRESHOLDS, {})
    plot_png(tmp_path / "nothing.png", [], EVENTS, {})
    run = trace(50)
    run.fault[:], run.residual[:] = np.nan, 0.0
    plot_png(tmp_path / "nan.png", [run], [event(10, "raised")], THRESHOLDS)


def test_no_pyplot_state_is_left_behind(tmp_path: Path) -> None:
    import matplotlib

    before = dict(matplotlib.rcParams)
    plot_png(tmp_path / "run.png", [trace(100)], [], {})
    assert dict(matplotlib.rcParams) == before


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


@pytest.mark.parametrize("index", range(8))
def test_the_palette_gives_bytes(index: int) -> None:
    from monitor.palette import series_colour

    assert all(0 <= part <= 255 for part in rgba(series_colour(index), 0.5))
