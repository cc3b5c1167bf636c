"""The picture of a run, drawn for every kind of run: units, nothing clipped or overlapping, gaps, spikes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from loopback import START_NS
from numpy.typing import NDArray
from synthetic_run import BOTH_THRESHOLDS, LAYOUT, STANDBY, THRESHOLDS, event, trace

from monitor.bus.alarm_text import utc
from monitor.event import AlarmEvent
from monitor.trace import Trace, TraceBuilder
from monitor.views.palette import BLUE, DARK, GREY, LIGHT, SERIES, SEVERITY, rgba
from monitor.views.panels import RunView, TrueSizes
from monitor.views.plot_style import DPI, STYLE, WIDTH_IN
from replay.reports.plot import BAND_ALPHA, DOUBT_ALPHA, HIGHEST_IN, SPAN_ALPHA, plot_png, run_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from matplotlib.transforms import Bbox

EVENTS = [event(1020, "raised"), event(1300, "cleared"), event(1400, "raised", id="02J", severity="critical")]
ALARMS = [
    *[event(1020 + 9 * k, "raised", id=f"{k}", channel=name) for k, name in enumerate(LAYOUT.faults)],
    *[event(1100, "raised", id=f"s{name}", observer="standby", channel=name) for name in STANDBY.faults],
    event(1200, "raised", id="u", channel="unexplained", severity="critical"),
    event(1250, "raised", id="t", observer="telemetry", channel="HIGHRES_IMU"),
]


def has_colour(path: Path, colour: str, alpha: float = 1.0) -> bool:
    """Return whether the picture has pixels of a colour laid over white, more than edges of other lines mix."""
    return pixels(path, colour, alpha) > 50


def pixels(path: Path, colour: str, alpha: float) -> int:
    """Return how many pixels a picture has of a colour laid over white."""
    wanted = 1.0 + alpha * (np.array(rgba(colour)[:3]) / 255.0 - 1.0)
    return int((np.abs(picture(path)[:, :, :3] - wanted).max(axis=2) < 0.01).sum())


def picture(path: Path) -> NDArray[np.float64]:
    from matplotlib import image

    return np.asarray(image.imread(path))


def test_estimates_and_alarms_are_drawn_in_their_colours(tmp_path: Path) -> None:
    run = trace()
    truth = {"motor1": (run.vehicle_ns / 1e9, np.where(run.vehicle_ns >= 10_000_000_000, -0.03, 0.0))}
    plot_png(tmp_path / "run.png", RunView([run], EVENTS, THRESHOLDS, truth), "a run")
    assert has_colour(tmp_path / "run.png", BLUE)
    assert has_colour(tmp_path / "run.png", SEVERITY["warning"], SPAN_ALPHA["warning"])
    assert has_colour(tmp_path / "run.png", SEVERITY["critical"], SPAN_ALPHA["critical"])
    about_no_channel = [event(1020, "raised", channel="unexplained")]
    plot_png(tmp_path / "calmer.png", RunView([run], about_no_channel, THRESHOLDS))
    assert has_colour(tmp_path / "calmer.png", SEVERITY["warning"], SPAN_ALPHA["warning"])
    assert not has_colour(tmp_path / "calmer.png", SEVERITY["critical"], SPAN_ALPHA["critical"])


@pytest.mark.long
def test_each_observer_adds_its_panels(tmp_path: Path) -> None:
    plot_png(tmp_path / "one.png", RunView([trace(200)], [], {}))
    plot_png(tmp_path / "two.png", RunView([trace(200), trace(200)], [], {}))
    one, two = (picture(tmp_path / name).shape[0] for name in ("one.png", "two.png"))
    assert two > 1.8 * one


@pytest.mark.long
def test_quiet_channels_of_many_share_a_panel_with_a_band(tmp_path: Path) -> None:
    run = trace()
    both = [run, replace(run, layout=STANDBY)]
    plot_png(tmp_path / "few.png", RunView([run], EVENTS, THRESHOLDS))
    plot_png(tmp_path / "many.png", RunView(both, EVENTS, BOTH_THRESHOLDS))
    assert has_colour(tmp_path / "many.png", GREY, BAND_ALPHA)
    few, many = (picture(tmp_path / name).shape[0] for name in ("few.png", "many.png"))
    assert many < 2 * few


@pytest.mark.long
def test_a_dozen_alarms_under_long_names_fit_a_page(tmp_path: Path) -> None:
    run = trace(200)
    layout = replace(LAYOUT, inputs=tuple(f"a_very_long_name_of_an_input_{k}" for k in range(4)))
    many = [replace(run, layout=replace(layout, observer=f"observer {k}")) for k in range(3)]
    plot_png(tmp_path / "run.png", RunView(many, [], {}), title="a long title " * 20)
    height, width, _ = picture(tmp_path / "run.png").shape
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
    drawn = picture(tmp_path / "run.png")[:, :, :3]
    assert has_colour(tmp_path / "run.png", DARK.estimate)
    assert np.median(drawn) < 0.2
    assert (drawn > 0.99).all(axis=2).mean() < 0.001


@pytest.mark.long
def test_an_observer_without_a_sample_has_no_panels(tmp_path: Path) -> None:
    plot_png(tmp_path / "one.png", RunView([trace(200)], [], THRESHOLDS))
    plot_png(tmp_path / "same.png", RunView([trace(200), TraceBuilder(STANDBY).build()], [], BOTH_THRESHOLDS))
    one, same = (picture(tmp_path / name) for name in ("one.png", "same.png"))
    assert one.shape == same.shape


def test_names_from_outside_are_drawn_as_they_are_and_no_pyplot_state_is_left_behind(tmp_path: Path) -> None:
    import matplotlib

    before = dict(matplotlib.rcParams)
    run = trace(200)
    layout = replace(run.layout, faults=("$\\frac{$", "\x1b[2J", "\ud83d\ude81 \u65e0\u4eba\u673a", "<b>&amp;"))
    plot_png(tmp_path / "run.png", RunView([replace(run, layout=layout)], [], {}), title="$x^")
    assert dict(matplotlib.rcParams) == before


@pytest.mark.long
def test_many_inputs_have_a_lane_each(tmp_path: Path) -> None:
    run = trace(200)
    wide = replace(run, layout=replace(LAYOUT, inputs=tuple(f"input{k}" for k in range(8))), u=np.tile(run.u, 2))
    plot_png(tmp_path / "few.png", RunView([run], [], {}))
    plot_png(tmp_path / "many.png", RunView([wide], [], {}))
    few, many = (picture(tmp_path / name).shape[0] for name in ("few.png", "many.png"))
    assert few < many < 2 * few


@pytest.mark.parametrize("colour", SERIES)
def test_the_palette_gives_bytes(colour: str) -> None:
    assert all(0 <= part <= 255 for part in rgba(colour, 0.5))


def figure(traces: Sequence[Trace], events: Sequence[AlarmEvent] = (), truth: TrueSizes | None = None) -> Figure:
    """Return a run's page."""
    from matplotlib import rc_context

    with rc_context(STYLE):
        return run_figure(RunView(traces, events, BOTH_THRESHOLDS, truth or {}), "a run", LIGHT)


def texts(drawn: Figure) -> list[tuple[str, Bbox]]:
    """Return all texts of a page and where they stand."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.text import Text

    canvas = drawn.canvas
    assert isinstance(canvas, FigureCanvasAgg)
    found = [text for text in drawn.findobj(Text) if isinstance(text, Text) and text.get_visible() and text.get_text()]
    hidden = {label for axes in drawn.axes[:-1] for label in axes.get_xticklabels()}
    for axes in drawn.axes:
        for axis, (low, high) in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
            beyond = [tick for tick in axis.get_major_ticks() if not low <= tick.get_loc() <= high]
            hidden |= {label for tick in beyond for label in (tick.label1, tick.label2)}
    return [(text.get_text(), text.get_window_extent(canvas.get_renderer())) for text in found if text not in hidden]


def everything() -> Figure:
    """Return a page with all there can be on it: two observers, alarms of every kind, truth."""
    run = trace()
    truth = {"motor1": (run.vehicle_ns / 1e9, np.full(len(run.vehicle_ns), -0.03))}
    return figure([run, replace(run, layout=STANDBY)], ALARMS, truth)


@pytest.mark.long
def test_no_text_overlaps_another_or_leaves_the_page() -> None:
    from matplotlib import rc_context

    drawn = everything()
    with rc_context(STYLE):
        drawn.canvas.draw()
    page = drawn.bbox
    for words, place in texts(drawn):
        assert page.x0 <= place.x0, words
        assert place.x1 <= page.x1, words
        assert page.y0 <= place.y0, words
        assert place.y1 <= page.y1, words
    for (one, here), (other, there) in combinations(texts(drawn), 2):
        # descenders and leading may touch
        apart = here.x1 <= there.x0 + 1 or there.x1 <= here.x0 + 1 or here.y1 <= there.y0 + 4 or there.y1 <= here.y0 + 4
        assert apart, (one, other)


def test_every_axis_says_its_unit() -> None:
    drawn = everything()
    titles = [axes.get_title(loc="left") for axes in drawn.axes if axes.axison]
    assert "alarms" in titles
    assert all("unit" in title or "fraction of full command" in title or "%" in title for title in titles[1:]), titles
    assert drawn.axes[-1].get_xlabel().startswith("time (s) since ")


def test_time_counts_from_the_first_sample_and_the_axis_says_when_that_was() -> None:
    run = trace()
    late = replace(run, vehicle_ns=run.vehicle_ns + 2_500_000_000)
    axes = figure([late]).axes[-1]
    assert axes.get_xlabel() == f"time (s) since {utc(START_NS)}, when the vehicle's clock showed 2.500 s"
    assert axes.get_xlim() == pytest.approx((0.0, 14.99))
    same = replace(run, vehicle_ns=run.vehicle_ns + START_NS)
    assert "clock" not in figure([same]).axes[-1].get_xlabel()


def marks_beyond(drawn: Figure) -> list[str]:
    """Return the marks at edges of a page's panels."""
    return [
        str(line.get_marker())
        for axes in drawn.axes
        for line in axes.get_lines()
        if line.get_marker() in ("v", "^") and len(np.asarray(line.get_xdata()))
    ]


@pytest.mark.long
def test_an_estimate_that_spikes_beyond_its_panel_is_marked_there() -> None:
    run = trace(8000)
    assert marks_beyond(figure([run])) == []
    run.isolated[1500, 0] = 1e6
    drawn = figure([run])
    assert marks_beyond(drawn) == ["^"]
    assert drawn.axes[0].get_ylim()[1] < 1.0


def test_a_wide_uncertainty_does_not_flatten_the_estimate() -> None:
    run = trace()
    run.sd[:] = 50.0
    low, high = figure([run]).axes[0].get_ylim()
    # all four panels reach from the 0.06 that motor1 lacks to motor3's threshold of 0.02, and a little beyond
    assert -0.09 < low < -0.06
    assert 0.02 < high < 0.04


def test_alarms_of_several_channels_have_a_lane_each_with_their_names() -> None:
    drawn = figure([trace()], ALARMS[:2])
    labels = [label.get_text() for label in drawn.axes[0].get_yticklabels()]
    assert labels == ["motors / motor1", "motors / motor2"]
    assert figure([trace()], ALARMS[:1]).axes[0].get_title(loc="left") != "alarms"
