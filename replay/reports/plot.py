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

import numpy as np
from numpy.typing import NDArray

from adapters.errors import printable
from monitor.bus.alarm_text import utc
from monitor.fitting.fit_report import MODEL_UNIT
from monitor.trace import AlarmSpan, Trace, alarm_spans
from monitor.views.palette import DARK, LIGHT, Theme
from monitor.views.panels import Panels, RunView, choose_panels, in_display_units, same_scale
from monitor.views.plot_style import DPI, STYLE, WIDTH_IN, save_small
from replay.reports.charts import DOUBT_DEVIATIONS, USUAL_PERCENT, Chart, end_s, fault_chart, observer_charts, origin_ns

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# Chosen by eye.
TRUTH_DASHES = (0, (4, 2))
BAND_ALPHA = 0.22
DOUBT_ALPHA = 0.3
# the two differ in lightness too, for people who see no difference in hue
SPAN_ALPHA: dict[str, float] = {"warning": 0.25, "critical": 0.42}
UNWATCHED_ALPHA = 0.6
UNWATCHED_HATCH = "//////"
# most marks at a panel's edge for estimates outside the panel
BEYOND_MARKS = 80

# letters of a name that fit into the margin beside a panel
LONGEST_NAME = 24
# ticks of a panel, whatever its height; otherwise the layout leaves room for labels that are not drawn
TICKS = 4

_LANES: Mapping[str, tuple[float, float, str]] = {
    "channels": (-1.3, 1.3, "quiet channels (band: ± own threshold; right: peak in % of it)"),
    "residuals": (-1.1, 1.1, f"residuals ({MODEL_UNIT}; right: {USUAL_PERCENT:g} % lie within)"),
    "inputs": (-0.075, 1.075, f"inputs ({MODEL_UNIT}; right: from … to)"),
}
"""For each chart with lanes: the range of its units that a lane shows, chosen by eye, and its title."""


@dataclass(frozen=True, slots=True)
class Look:
    """Appearance of a picture."""

    theme: Theme
    origin_ns: int  # zero of the axis of time, vehicle's clock
    end_s: float  # its end
    prefix: str = ""  # begin of the panels' titles


def draw_alarms(panel: Axes, look: Look, spans: Sequence[AlarmSpan]) -> None:
    """Draw when each channel's alarms were active, a lane for each channel."""
    lanes = alarm_lanes(spans)
    for span in spans:
        lane = lanes.index((span.observer, span.channel))
        start_s = (span.start_vehicle_ns - look.origin_ns) / 1e9
        end_s = look.end_s if span.end_vehicle_ns is None else (span.end_vehicle_ns - look.origin_ns) / 1e9
        colour, ends = look.theme.severity[span.severity], (-lane - 0.3, -lane + 0.3)
        panel.broken_barh(
            [(start_s, end_s - start_s)], (ends[0], 0.6), facecolor=colour, alpha=SPAN_ALPHA[span.severity], linewidth=0
        )
        panel.plot([start_s] * 2, ends, color=colour, linewidth=1.4)
    _label_lanes(panel, [_short(f"{observer} / {channel}", 2 * LONGEST_NAME) for observer, channel in lanes])
    _name(panel, look, "alarms")


def alarm_lanes(spans: Sequence[AlarmSpan]) -> list[tuple[str, str]]:
    """Return observer and channel of all alarms, in the order of their first alarm."""
    return list(dict.fromkeys((span.observer, span.channel) for span in spans))


def draw_fault(panel: Axes, look: Look, chart: Chart) -> None:
    """Draw one fault channel with its alarms, threshold and truth."""
    content, theme, times_s = chart.content, look.theme, np.array(chart.content["x"])
    series = {one["name"]: _numbers(one) for one in content["series"]}
    _shade(panel, look, chart)
    _cover(panel, look, content["spans"])
    if (threshold := content["threshold"]) is not None:
        panel.axhspan(-threshold, threshold, color=theme.muted, alpha=BAND_ALPHA, linewidth=0)
        for level in (-threshold, threshold):
            panel.axhline(level, color=theme.ink, linestyle=":", linewidth=0.7)
    if "low" in series:
        panel.fill_between(times_s, series["low"], series["high"], color=theme.estimate, alpha=DOUBT_ALPHA, linewidth=0)
    if "truth" in series:
        panel.plot(times_s, series["truth"], color=theme.ink, linestyle=TRUTH_DASHES, linewidth=1.6)
    panel.plot(times_s, series["estimate"], color=theme.estimate)
    panel.set_ylim(content["limits"])
    _mark_beyond(panel, look, chart, series["estimate"])
    panel.locator_params(axis="y", nbins=TICKS)
    _name(panel, look, f"{chart.title} ({content['unit'] or MODEL_UNIT})")


def draw_lanes(panel: Axes, look: Look, chart: Chart, covered: Sequence[Mapping[str, Any]] = ()) -> None:
    """Draw the series of a chart below each other, with the range of each lane, and mark the alarms.

    The alarms among ``covered`` are shaded and named.
    """
    colours = {"channels": look.theme.estimate, "residuals": look.theme.residual}
    low, high, name = _LANES[chart.title]
    times_s = np.array(chart.content["x"])
    _shade(panel, look, chart)
    _cover(panel, look, covered)
    for span in chart.content["spans"]:
        colour = look.theme.severity[span["severity"]]
        panel.axvline(span["from"], color=colour, linewidth=1.0)
        if span["to"] is not None:
            panel.axvline(span["to"], color=colour, linewidth=1.0, linestyle=":")
    labels = []
    for lane, one in enumerate(chart.content["series"]):
        if chart.title == "channels":
            half = 1.0 / (high - low)
            panel.axhspan(-lane - half, -lane + half, color=look.theme.muted, alpha=BAND_ALPHA, linewidth=0)
        height = np.clip((_numbers(one) - (low + high) / 2.0) / (high - low), -0.5, 0.5)
        width = None if chart.title == "channels" else 0.6
        panel.plot(times_s, height - lane, color=colours.get(chart.title, look.theme.ink), linewidth=width)
        labels.append(f"{_short(one['name'])}  {one['of']}")
    _label_lanes(panel, labels)
    about = ", ".join(dict.fromkeys(f"{area['channel']} alarm" for area in covered))
    _name(panel, look, f"{name}; shaded: {about}" if about else name)


def draw_heading(panel: Axes, look: Look, text: str) -> None:
    """Write an observer's name over a line across the picture."""
    panel.set_axis_off()
    panel.axhline(0.95, color=look.theme.ink, linewidth=1.0)
    panel.text(0.0, 0.3, printable(text), transform=panel.transAxes, size=9.5, weight="bold", va="center")
    panel.set_ylim(0.0, 1.0)


def _name(panel: Axes, look: Look, text: str) -> None:
    """Write a panel's title."""
    panel.set_title(printable(look.prefix + text), loc="left", size=8, pad=2.5)


def _cover(panel: Axes, look: Look, areas: Sequence[Mapping[str, Any]]) -> None:
    """Shade the spans in which alarms were active; an alarm that is still active lasts to the end."""
    for area in areas:
        colour, end_s = look.theme.severity[area["severity"]], area["to"]
        end_s = look.end_s if end_s is None else end_s
        panel.axvspan(area["from"], end_s, color=colour, alpha=SPAN_ALPHA[area["severity"]], linewidth=0)
        panel.axvline(area["from"], color=colour, linewidth=1.0)


def _numbers(series: Mapping[str, Any]) -> NDArray[np.float64]:
    """Return a series of a chart, NaN for missing values."""
    return np.array(series["y"], np.float64)


def _label_lanes(panel: Axes, labels: Sequence[str]) -> None:
    panel.yaxis.tick_right()
    panel.set_yticks([-float(lane) for lane in range(len(labels))], labels)
    panel.tick_params(axis="y", length=0)
    panel.set_ylim(0.55 - max(len(labels), 1), 0.55)


def _short(name: str, longest: int = LONGEST_NAME) -> str:
    """Return a name that is short enough to leave the panels their width."""
    name = printable(name)
    return name if len(name) <= longest else name[: longest - 1] + "…"


def _shade(panel: Axes, look: Look, chart: Chart) -> None:
    """Hatch a panel where no alarm could be raised: the vehicle was not in flight, or there are no samples."""
    panel.broken_barh(
        [(start_s, stop_s - start_s) for start_s, stop_s in chart.content["unwatched"]],
        (0.0, 1.0),
        transform=panel.get_xaxis_transform(),
        facecolor="none",
        edgecolor=look.theme.muted,
        hatch=UNWATCHED_HATCH,
        alpha=UNWATCHED_ALPHA,
        linewidth=0,
    )


def _mark_beyond(panel: Axes, look: Look, chart: Chart, estimate: NDArray[np.float64]) -> None:
    """Mark at the panel's edge where an estimate that could raise alarms is outside the panel."""
    times_s, (low, high) = np.array(chart.content["x"]), chart.content["limits"]
    watched = np.ones(len(times_s), np.bool_)
    for start_s, stop_s in chart.content["unwatched"]:
        watched &= (times_s <= start_s) | (times_s >= stop_s)
    for beyond, edge, marker in ((estimate < low, 0.0, "v"), (estimate > high, 1.0, "^")):
        width_s = look.end_s / BEYOND_MARKS or 1.0
        places_s = width_s * (np.unique(np.floor(times_s[watched & beyond] / width_s)) + 0.5)
        [marks] = panel.plot(
            places_s,
            np.full(len(places_s), edge),
            marker,
            color=look.theme.estimate,
            markersize=4.0,
            markeredgewidth=0,
            transform=panel.get_xaxis_transform(),
            clip_on=False,
        )
        marks.set_in_layout(False)


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
"""Largest difference of two equal clocks. Chosen: logs of one flight agree to milliseconds, two flights are minutes
apart."""


@dataclass(frozen=True, slots=True)
class _Row:
    """A panel to draw: its height without its title, its drawing function, and whether it may shrink on a full page."""

    height_in: float
    draw: Callable[[Axes], None]
    shrinks: bool = False


def plot_png(path: str | os.PathLike[str], run: RunView, title: str = "", *, dark: bool = False) -> None:
    """Draw a run as a PNG, 8 inches wide; panels of faults shrink to 0.4 inches before it becomes higher than 16.

    Each observer has, under its name if there are several: a panel for each fault channel that had an alarm or whose
    truth is known, with its estimate within two standard deviations, its alarm threshold as a dotted band, the truth
    dashed, and its alarms as shaded spans; one panel of lanes for the quiet channels, each over its own threshold; then
    the residuals and the inputs in lanes, each over its own size. If alarms were raised, only their observers show
    residuals and inputs. If all observers together have few channels, each channel has its panel. If several channels
    had alarms, lanes at the top show their times. An observer without any sample has no panel. Time counts from the
    first sample, whose time the axis gives. Panels are hatched where no alarm could be raised (also in gaps between
    samples); values there do not affect the scale. An estimate outside its panel is marked at the edge. Long recordings
    are drawn as the envelope of their smallest and largest values: no peak is lost.
    """
    theme, run = DARK if dark else LIGHT, in_display_units(run)
    with _drawing(_style(theme)):
        save_small(run_figure(run, title, theme), path)


@contextmanager
def _drawing(style: Mapping[str, Any]) -> Iterator[None]:
    from matplotlib import rc_context

    with rc_context(dict(style)), warnings.catch_warnings():
        # letters that the font lacks are drawn as boxes
        warnings.filterwarnings("ignore", "Glyph .* missing from", UserWarning)
        yield


def _style(theme: Theme) -> dict[str, Any]:
    inks = ("text.color", "axes.edgecolor", "axes.labelcolor", "xtick.color", "ytick.color")
    papers = ("figure.facecolor", "axes.facecolor", "savefig.facecolor")
    return STYLE | dict.fromkeys(inks, theme.ink) | dict.fromkeys(papers, theme.paper)


def run_figure(run: RunView, title: str, theme: Theme) -> Figure:
    """Return the drawn page of a run, in the units that people use."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    spans = alarm_spans(run.events)
    alarmed = {(span.observer, span.channel) for span in spans}
    run = run._replace(traces=[trace for trace in run.traces if len(trace.vehicle_ns)])
    traces, look = run.traces, Look(theme, origin_ns(run.traces), end_s(run.traces))
    chosen = choose_panels([trace.layout for trace in traces], alarmed, run.truth, run.thresholds)
    # if some observers had alarms, the others show only their channels, so that the panels with alarms are large
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
    """Return the label of the time axis, with the time of its zero."""
    first = min(traces, key=lambda trace: int(trace.vehicle_ns[0]))
    label = f"time (s) since {utc(int(first.unix_ns[0]))}"
    if abs(int(first.unix_ns[0]) - origin_ns) < SAME_CLOCK_NS:
        return label
    return f"{label}, when the vehicle's clock showed {origin_ns / 1e9:.3f} s"


def _draw_nothing(panel: Axes) -> None:
    panel.set_axis_off()
    panel.text(0.0, 0.5, "no samples, nothing to draw", transform=panel.transAxes, va="center")


def _heights(rows: Sequence[_Row]) -> list[float]:
    """Return the panels' heights; on a full page the panels of faults shrink, because lanes would overlap."""
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
            # an alarm without a fault channel, such as an unexplained residual, is shown here
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
    """Draw one legend above all panels, which explains the marks of the fault panels."""
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
