"""The picture of a run: fault estimates with truth, thresholds and alarms, residuals, inputs, as one PNG."""

from __future__ import annotations

import os
import textwrap
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

from adapters.errors import printable
from monitor.bus.alarm_text import utc
from monitor.trace import AlarmSpan, Trace, alarm_spans
from monitor.views.palette import DARK, LIGHT, Theme
from monitor.views.panels import Panels, RunView, choose_panels, in_display_units, same_scale
from monitor.views.plot_style import DPI, STYLE, WIDTH_IN, save_small
from replay.reports.charts import DOUBT_DEVIATIONS, end_s, fault_chart, observer_charts, origin_ns
from replay.reports.plot_panels import (
    BAND_ALPHA,
    DOUBT_ALPHA,
    SPAN_ALPHA,
    TRUTH_DASHES,
    UNWATCHED_ALPHA,
    UNWATCHED_HATCH,
    Look,
    alarm_lanes,
    draw_alarms,
    draw_fault,
    draw_heading,
    draw_lanes,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Heights of rows in inches, ticks and letters of headings: chosen by eye at 8 in wide and 160 dpi.
HIGHEST_IN = 16.0
HEADING_IN = 0.22
FAULT_IN = 1.0
LEAST_FAULT_IN = 0.4
FEW_TICKS_IN = 0.8
FEW_TICKS = 2
LANE_IN = 0.2
LEAST_LANES = 2
TITLE_IN = 0.2
ENDS_IN = 1.0
TITLE_LETTERS = 105
BINS = 6000
"""Bins of a chart's series. Chosen: each of four has more than a picture of 8 in at 160 dpi has pixels across."""
SAME_CLOCK_NS = 1_000_000_000
"""Chosen: logs of one flight agree to milliseconds, two flights are minutes apart."""


@dataclass(frozen=True, slots=True)
class _Row:
    """A panel to come: its height without its title, what draws it, and whether it gives way on a full page."""

    height_in: float
    draw: Callable[[Axes], None]
    shrinks: bool = False


def plot_png(path: str | os.PathLike[str], run: RunView, title: str = "", *, dark: bool = False) -> None:
    """Draw a run as a PNG, 8 inches wide; up to 16 high, panels of faults shrink to 0.4 before it grows beyond.

    Per observer, under its name where there are several: a panel for each fault channel that had an alarm or whose
    truth is known, with its estimate within two standard deviations, its alarm threshold as a dotted band, the truth
    dashed, and its alarms as shaded spans; one panel of lanes for the quiet channels, each over its own threshold; then
    the residuals and the inputs in lanes, each over its own size, where alarms were raised those of their observers
    alone. Where all observers together have few channels, each
    has its panel. Where several channels had alarms, lanes at the top say when. An observer without any sample has no
    panel. Time counts from the first sample; the axis says when that was. Where no alarm could be raised, gaps between
    samples among it, panels are hatched, and what is drawn there sets no scale; an estimate beyond its panel is marked
    at the edge. Long recordings are drawn as the envelope of their smallest and largest values: no peak is lost.
    """
    theme, run = DARK if dark else LIGHT, in_display_units(run)
    with _drawing(_style(theme)):
        save_small(run_figure(run, title, theme), path)


@contextmanager
def _drawing(style: Mapping[str, Any]) -> Iterator[None]:
    from matplotlib import rc_context

    with rc_context(dict(style)), warnings.catch_warnings():
        # a name may be written in letters that the font lacks: it is drawn as boxes
        warnings.filterwarnings("ignore", "Glyph .* missing from", UserWarning)
        yield


def _style(theme: Theme) -> dict[str, Any]:
    inks = ("text.color", "axes.edgecolor", "axes.labelcolor", "xtick.color", "ytick.color")
    papers = ("figure.facecolor", "axes.facecolor", "savefig.facecolor")
    return STYLE | dict.fromkeys(inks, theme.ink) | dict.fromkeys(papers, theme.paper)


def run_figure(run: RunView, title: str, theme: Theme) -> Figure:
    """Return the drawn page of a run in the units that people say."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    spans = alarm_spans(run.events)
    alarmed = {(span.observer, span.channel) for span in spans}
    run = run._replace(traces=[trace for trace in run.traces if len(trace.vehicle_ns)])
    traces, look = run.traces, Look(theme, origin_ns(run.traces), end_s(run.traces))
    chosen = choose_panels([trace.layout for trace in traces], alarmed, run.truth, run.thresholds)
    # beside observers with alarms of others the channels alone: so the alarms are large
    observers = {trace.layout.observer for trace in traces}
    whole = {observer for observer, _ in alarmed} & observers or observers
    rows = [
        row
        for trace, panels in zip(traces, chosen, strict=True)
        for row in _rows(run, trace, panels, look, whole=trace.layout.observer in whole)
    ] or [_Row(FAULT_IN, _draw_nothing)]
    lanes = len(alarm_lanes(spans)) if traces else 0
    if lanes > 1:
        rows.insert(0, _Row(_lanes_in(lanes), partial(draw_alarms, look=look, spans=spans)))
    heights = _heights(rows)
    low = any(row.shrinks and height < FEW_TICKS_IN for row, height in zip(rows, heights, strict=True))
    figure = Figure(figsize=(WIDTH_IN, sum(heights) + TITLE_IN * len(rows) + ENDS_IN), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(len(rows), 1, sharex=True, squeeze=False, height_ratios=heights)[:, 0]
    for row, panel in zip(rows, panels, strict=True):
        row.draw(panel)
        if row.shrinks and low:
            panel.locator_params(axis="y", nbins=FEW_TICKS)
    for panel in panels[:-1]:
        panel.tick_params(bottom=False)
    if traces:
        panels[-1].set_xlabel(_since(traces, look.origin_ns))
        panels[-1].set_xlim(0.0, look.end_s or 1.0)
        _draw_legend(figure, title, theme, run, chosen, spans)
    elif title:
        figure.suptitle(textwrap.fill(printable(title), TITLE_LETTERS), x=0.01, ha="left", size=9.5, weight="bold")
    return figure


def _since(traces: Sequence[Trace], origin_ns: int) -> str:
    """Return the label of the axis of time, which says when its zero was."""
    first = min(traces, key=lambda trace: int(trace.vehicle_ns[0]))
    label = f"time (s) since {utc(int(first.unix_ns[0]))}"
    if abs(int(first.unix_ns[0]) - origin_ns) < SAME_CLOCK_NS:
        return label
    return f"{label}, when the vehicle's clock showed {origin_ns / 1e9:.3f} s"


def _draw_nothing(panel: Axes) -> None:
    panel.set_axis_off()
    panel.text(0.0, 0.5, "no samples, nothing to draw", transform=panel.transAxes, va="center")


def _heights(rows: Sequence[_Row]) -> list[float]:
    """Return the panels' heights; on a full page those of faults give way, lanes would run into each other."""
    faults = sum(row.shrinks for row in rows)
    others = sum(row.height_in for row in rows if not row.shrinks) + TITLE_IN * len(rows) + ENDS_IN
    fault_in = min(max((HIGHEST_IN - others) / max(faults, 1), LEAST_FAULT_IN), FAULT_IN)
    return [fault_in if row.shrinks else row.height_in for row in rows]


def _rows(run: RunView, trace: Trace, panels: Panels, look: Look, *, whole: bool) -> Iterator[_Row]:
    """Return an observer's panels from top to bottom, without residuals and inputs unless it is shown ``whole``."""
    layout = trace.layout
    if len(run.traces) > 1:
        yield _Row(HEADING_IN, partial(draw_heading, look=look, text=layout.observer))
    else:
        look = replace(look, prefix=f"{layout.observer} / ")
    for place in panels.alone:
        chart = fault_chart(run, trace, layout.faults[place], same_scale(layout, panels, place), BINS)
        yield _Row(FAULT_IN, partial(draw_fault, look=look, chart=chart), shrinks=True)
    quiet = [layout.faults[place] for place in panels.together]
    for chart in observer_charts(run, trace, quiet, BINS):
        if whole or chart.title == "channels":
            # an alarm that is about no fault channel, such as an unexplained residual, is shown here
            spans = chart.content["spans"] if chart.title == "residuals" else ()
            covered = [span for span in spans if span["channel"] not in layout.faults]
            draw = partial(draw_lanes, look=look, chart=chart, covered=covered)
            yield _Row(_lanes_in(len(chart.content["series"])), draw)


def _lanes_in(lanes: int) -> float:
    return LANE_IN * max(lanes, LEAST_LANES)


def _draw_legend(
    figure: Figure,
    title: str,
    theme: Theme,
    run: RunView,
    chosen: Sequence[Panels],
    spans: Sequence[AlarmSpan],
) -> None:
    """Say once, above all panels, what the marks of the fault panels mean."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    def area(colour: str, alpha: float, label: str) -> Patch:
        return Patch(color=colour, alpha=alpha, linewidth=0, label=label)

    marks: list[Any] = [Line2D([], [], color=theme.estimate, label="fault estimate")]
    if any(
        (trace.layout.observer, trace.layout.faults[place]) not in run.without_sd
        for trace, rows in zip(run.traces, chosen, strict=True)
        for place in rows.alone
    ):
        marks.append(area(theme.estimate, DOUBT_ALPHA, f"±{DOUBT_DEVIATIONS:g} std. dev."))
    if run.truth:
        marks.append(Line2D([], [], color=theme.ink, linestyle=TRUTH_DASHES, linewidth=1.6, label="truth"))
    if run.thresholds:
        marks.append(area(theme.muted, BAND_ALPHA, "within threshold"))
    for severity in ("warning", "critical"):
        if any(span.severity == severity for span in spans):
            marks.append(area(theme.severity[severity], SPAN_ALPHA[severity], f"{severity} alarm"))
    marks.append(
        Patch(
            facecolor="none",
            edgecolor=theme.muted,
            hatch=UNWATCHED_HATCH,
            alpha=UNWATCHED_ALPHA,
            linewidth=0,
            label="not watched",
        )
    )
    figure.legend(
        handles=marks,
        loc="outside upper left",
        ncols=len(marks),
        columnspacing=1.1,
        handletextpad=0.5,
        alignment="left",
        title=textwrap.fill(printable(title), TITLE_LETTERS) or None,
        title_fontproperties={"size": 9.5, "weight": "bold"},
    )
