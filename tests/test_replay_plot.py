"""The picture of a run: drawn for every kind of run, on a page."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib import image
from synthetic_run import BOTH_THRESHOLDS, LAYOUT, STANDBY, THRESHOLDS, event, trace

from monitor.palette import BLUE, SEVERITY, SKY, rgba
from monitor.trace import TraceBuilder
from replay.plot import DPI, HIGHEST_IN, WIDTH_IN, plot_png

EVENTS = [event(1020, "raised"), event(1300, "cleared"), event(1400, "raised", id="02J", severity="critical")]


def has_colour(path: Path, colour: str, alpha: float = 1.0) -> bool:
    """Return whether the picture has pixels of a colour laid over white, more than edges of other lines mix."""
    wanted = 1.0 + alpha * (np.array(rgba(colour)[:3]) / 255.0 - 1.0)
    return bool((np.abs(image.imread(path)[:, :, :3] - wanted).max(axis=2) < 0.01).sum() > 50)


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


def test_quiet_channels_of_many_share_a_panel_with_a_band(tmp_path: Path) -> None:
    run = trace()
    both = [run, replace(run, layout=STANDBY)]
    plot_png(tmp_path / "few.png", [run], EVENTS, THRESHOLDS)
    plot_png(tmp_path / "many.png", both, EVENTS, BOTH_THRESHOLDS)
    assert not has_colour(tmp_path / "few.png", SKY, 0.22)
    assert has_colour(tmp_path / "many.png", SKY, 0.22)
    few, many = (image.imread(tmp_path / name).shape[0] for name in ("few.png", "many.png"))
    assert many < 2 * few


def test_an_alarm_about_no_fault_channel_is_shaded_too(tmp_path: Path) -> None:
    plot_png(tmp_path / "run.png", [trace()], [event(1020, "raised", channel="unexplained")], THRESHOLDS)
    assert has_colour(tmp_path / "run.png", SEVERITY["warning"], 0.25)


def test_a_dozen_alarms_under_long_names_fit_a_page(tmp_path: Path) -> None:
    run = trace(200)
    layout = replace(LAYOUT, inputs=tuple(f"a_very_long_name_of_an_input_{k}" for k in range(4)))
    many = [replace(run, layout=replace(layout, observer=f"observer {k}")) for k in range(3)]
    plot_png(tmp_path / "run.png", many, [], {}, title="a long title " * 20)
    height, width, _ = image.imread(tmp_path / "run.png").shape
    assert width == WIDTH_IN * DPI
    assert height <= HIGHEST_IN * DPI


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


@pytest.mark.parametrize("index", range(8))
def test_the_palette_gives_bytes(index: int) -> None:
    from monitor.palette import series_colour

    assert all(0 <= part <= 255 for part in rgba(series_colour(index), 0.5))
