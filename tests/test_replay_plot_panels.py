"""Pictures of runs as a reader checks them: units, nothing clipped or overlapping, gaps, spikes, when zero was."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from loopback import START_NS
from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.transforms import Bbox
from synthetic_run import BOTH_THRESHOLDS, LAYOUT, STANDBY, event, trace

from monitor.bus.alarm_text import utc
from monitor.event import AlarmEvent
from monitor.trace import Trace
from monitor.views.palette import LIGHT
from monitor.views.panels import RunView, TrueSizes
from monitor.views.plot_style import STYLE
from replay.reports.charts import unwatched
from replay.reports.plot import run_figure

ALARMS = [
    *[event(1020 + 9 * k, "raised", id=f"{k}", channel=name) for k, name in enumerate(LAYOUT.faults)],
    *[event(1100, "raised", id=f"s{name}", observer="standby", channel=name) for name in STANDBY.faults],
    event(1200, "raised", id="u", channel="unexplained", severity="critical"),
    event(1250, "raised", id="t", observer="telemetry", channel="HIGHRES_IMU"),
]


def figure(traces: Sequence[Trace], events: Sequence[AlarmEvent] = (), truth: TrueSizes | None = None) -> Figure:
    """Return a run's page."""
    with rc_context(STYLE):
        return run_figure(RunView(traces, events, BOTH_THRESHOLDS, truth or {}), "a run", LIGHT)


def texts(drawn: Figure) -> list[tuple[str, Bbox]]:
    """Return all texts of a page and where they stand."""
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


def test_where_there_are_no_samples_nothing_was_watched() -> None:
    assert unwatched(trace(), 0, 20.0) == [
        pytest.approx((0.0, 1.0)),
        pytest.approx((5.99, 7.0)),
        pytest.approx((14.99, 20.0)),
    ]
    never = trace()
    never.armed[:] = False
    assert unwatched(never, 0, 20.0) == [(0.0, 20.0)]


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
