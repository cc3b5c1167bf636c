"""The picture of a run: drawn for every kind of run, on a page."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib import image
from synthetic_run import BOTH_THRESHOLDS, LAYOUT, STANDBY, THRESHOLDS, event, trace

from monitor.trace import TraceBuilder
from monitor.views.palette import BLUE, DARK, GREY, SERIES, SEVERITY, rgba
from monitor.views.panels import RunView
from monitor.views.plot_style import DPI, WIDTH_IN
from replay.reports.plot import BAND_ALPHA, DOUBT_ALPHA, HIGHEST_IN, SPAN_ALPHA, plot_png

EVENTS = [event(1020, "raised"), event(1300, "cleared"), event(1400, "raised", id="02J", severity="critical")]


def has_colour(path: Path, colour: str, alpha: float = 1.0) -> bool:
    """Return whether the picture has pixels of a colour laid over white, more than edges of other lines mix."""
    return pixels(path, colour, alpha) > 50


def pixels(path: Path, colour: str, alpha: float) -> int:
    """Return how many pixels a picture has of a colour laid over white."""
    wanted = 1.0 + alpha * (np.array(rgba(colour)[:3]) / 255.0 - 1.0)
    return int((np.abs(image.imread(path)[:, :, :3] - wanted).max(axis=2) < 0.01).sum())


def test_estimates_and_alarms_are_drawn_in_their_colours(tmp_path: Path) -> None:
    run = trace()
    truth = {"motor1": (run.vehicle_ns / 1e9, np.where(run.vehicle_ns >= 10_000_000_000, -0.03, 0.0))}
    plot_png(tmp_path / "run.png", RunView([run], EVENTS, THRESHOLDS, truth), "a run")
    assert has_colour(tmp_path / "run.png", BLUE)
    assert has_colour(tmp_path / "run.png", SEVERITY["warning"], SPAN_ALPHA["warning"])
    assert has_colour(tmp_path / "run.png", SEVERITY["critical"], SPAN_ALPHA["critical"])
    plot_png(tmp_path / "calm.png", RunView([run], [], THRESHOLDS))
    assert not has_colour(tmp_path / "calm.png", SEVERITY["critical"], SPAN_ALPHA["critical"])


@pytest.mark.long
def test_each_observer_adds_its_panels(tmp_path: Path) -> None:
    plot_png(tmp_path / "one.png", RunView([trace(200)], [], {}))
    plot_png(tmp_path / "two.png", RunView([trace(200), trace(200)], [], {}))
    one, two = (image.imread(tmp_path / name).shape[0] for name in ("one.png", "two.png"))
    assert two > 1.8 * one


@pytest.mark.long
def test_quiet_channels_of_many_share_a_panel_with_a_band(tmp_path: Path) -> None:
    run = trace()
    both = [run, replace(run, layout=STANDBY)]
    plot_png(tmp_path / "few.png", RunView([run], EVENTS, THRESHOLDS))
    plot_png(tmp_path / "many.png", RunView(both, EVENTS, BOTH_THRESHOLDS))
    assert has_colour(tmp_path / "many.png", GREY, BAND_ALPHA)
    few, many = (image.imread(tmp_path / name).shape[0] for name in ("few.png", "many.png"))
    assert many < 2 * few


def test_an_alarm_about_no_fault_channel_is_shaded_too(tmp_path: Path) -> None:
    plot_png(tmp_path / "run.png", RunView([trace()], [event(1020, "raised", channel="unexplained")], THRESHOLDS))
    assert has_colour(tmp_path / "run.png", SEVERITY["warning"], SPAN_ALPHA["warning"])


@pytest.mark.long
def test_a_dozen_alarms_under_long_names_fit_a_page(tmp_path: Path) -> None:
    run = trace(200)
    layout = replace(LAYOUT, inputs=tuple(f"a_very_long_name_of_an_input_{k}" for k in range(4)))
    many = [replace(run, layout=replace(layout, observer=f"observer {k}")) for k in range(3)]
    plot_png(tmp_path / "run.png", RunView(many, [], {}), title="a long title " * 20)
    height, width, _ = image.imread(tmp_path / "run.png").shape
    assert width == WIDTH_IN * DPI
    assert height <= HIGHEST_IN * DPI


@pytest.mark.long
def test_runs_with_nothing_to_draw_are_drawn_too(tmp_path: Path) -> None:
    empty = TraceBuilder(LAYOUT).build()
    plot_png(tmp_path / "empty.png", RunView([empty], EVENTS, THRESHOLDS))
    plot_png(tmp_path / "nothing.png", RunView([], EVENTS, {}))
    run = trace(50)
    run.fault[:], run.residual[:] = np.nan, 0.0
    plot_png(tmp_path / "nan.png", RunView([run], [event(10, "raised")], THRESHOLDS))


def test_no_pyplot_state_is_left_behind(tmp_path: Path) -> None:
    import matplotlib

    before = dict(matplotlib.rcParams)
    plot_png(tmp_path / "run.png", RunView([trace(100)], [], {}))
    assert dict(matplotlib.rcParams) == before


@pytest.mark.long
def test_thresholds_and_standard_deviations_are_shaded_unless_they_belong_to_something_else(tmp_path: Path) -> None:
    run = trace()
    run.sd[:] = 0.01
    plot_png(tmp_path / "with.png", RunView([run], [], THRESHOLDS))
    plot_png(
        tmp_path / "without.png",
        RunView([run], [], THRESHOLDS, without_sd={("motors", name) for name in LAYOUT.faults}),
    )
    run.sd[:] = np.nan
    plot_png(tmp_path / "unknown.png", RunView([run], [], THRESHOLDS))
    bands, none = (pixels(tmp_path / name, GREY, BAND_ALPHA) for name in ("unknown.png", "without.png"))
    # hatching has shades of the same grey
    assert bands > 4 * none
    shaded, bare = (pixels(tmp_path / name, BLUE, DOUBT_ALPHA) for name in ("with.png", "without.png"))
    assert shaded > 10_000
    assert bare < 1_000


@pytest.mark.long
def test_a_dark_picture_is_dark(tmp_path: Path) -> None:
    plot_png(tmp_path / "run.png", RunView([trace()], EVENTS, THRESHOLDS), title="a run", dark=True)
    picture = image.imread(tmp_path / "run.png")[:, :, :3]
    assert has_colour(tmp_path / "run.png", DARK.estimate)
    assert np.median(picture) < 0.2
    assert (picture > 0.99).all(axis=2).mean() < 0.001


@pytest.mark.long
def test_an_observer_without_a_sample_has_no_panels(tmp_path: Path) -> None:
    plot_png(tmp_path / "one.png", RunView([trace(200)], [], THRESHOLDS))
    plot_png(tmp_path / "same.png", RunView([trace(200), TraceBuilder(STANDBY).build()], [], BOTH_THRESHOLDS))
    one, same = (image.imread(tmp_path / name) for name in ("one.png", "same.png"))
    assert one.shape == same.shape


def test_names_from_outside_are_drawn_as_they_are(tmp_path: Path) -> None:
    run = trace(200)
    layout = replace(run.layout, faults=("$\\frac{$", "\x1b[2J", "\ud83d\ude81 \u65e0\u4eba\u673a", "<b>&amp;"))
    plot_png(tmp_path / "run.png", RunView([replace(run, layout=layout)], [], {}), title="$x^")


@pytest.mark.long
def test_many_inputs_have_a_lane_each(tmp_path: Path) -> None:
    run = trace(200)
    wide = replace(run, layout=replace(LAYOUT, inputs=tuple(f"input{k}" for k in range(8))), u=np.tile(run.u, 2))
    plot_png(tmp_path / "few.png", RunView([run], [], {}))
    plot_png(tmp_path / "many.png", RunView([wide], [], {}))
    few, many = (image.imread(tmp_path / name).shape[0] for name in ("few.png", "many.png"))
    assert few < many < 2 * few


@pytest.mark.parametrize("colour", SERIES)
def test_the_palette_gives_bytes(colour: str) -> None:
    assert all(0 <= part <= 255 for part in rgba(colour, 0.5))
