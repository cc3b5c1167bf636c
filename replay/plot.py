"""The picture of a run: fault estimates with truth, thresholds and alarms, residuals, inputs, as one PNG."""

from __future__ import annotations

import os
import textwrap
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from monitor.event import AlarmEvent
from monitor.palette import BLACK, BLUE, GREY, SEVERITY, SKY
from monitor.panels import Panels, Thresholds, Truth, choose_panels, same_scale
from monitor.trace import AlarmSpan, Trace, alarm_spans
from replay.plot_panels import (
    BAND_ALPHA,
    NAMES_BELOW,
    NOT_ARMED_ALPHA,
    SPAN_ALPHA,
    TRUTH_DASHES,
    draw_fault,
    draw_heading,
    draw_inputs,
    draw_quiet,
    draw_residuals,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH_IN = 8.0
HIGHEST_IN = 16.0
HEADING_IN = 0.22
FAULT_IN = 1.0
LEAST_FAULT_IN = 0.35
LANE_IN = 0.2
LEAST_LANES = 2
INPUT_IN = 1.0
INPUT_NAME_IN = 0.14
TITLE_IN = 0.2
ENDS_IN = 1.0
DPI = 160
TITLE_LETTERS = 105

STYLE: dict[str, Any] = {
    "font.size": 8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.6,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "lines.linewidth": 0.8,
    "lines.solid_joinstyle": "round",
    "legend.frameon": False,
    "legend.handlelength": 1.8,
    "figure.constrained_layout.h_pad": 0.03,
    "figure.constrained_layout.w_pad": 0.08,
}


@dataclass(frozen=True, slots=True)
class _Row:
    """A panel to come: its height without its title, what draws it, and whether it gives way on a full page."""

    height_in: float
    draw: Callable[[Axes], None]
    shrinks: bool = False


def plot_png(
    path: str | os.PathLike[str],
    traces: Sequence[Trace],
    events: Sequence[AlarmEvent],
    thresholds: Thresholds,
    truth: Truth | None = None,
    title: str = "",
) -> None:
    """Draw a run.

    Per observer, under its name where there are several: a panel for each fault channel that had an alarm or whose
    truth is known, with its estimate, its alarm threshold as dotted lines, the truth dashed, and its alarms as shaded
    spans; one panel of lanes for the quiet channels, each over its own threshold; then the residuals in lanes, each
    over its own scatter; then the inputs. Where all observers together have few channels, each has its panel. Time is
    the vehicle's own. Where no alarm could be raised, panels are grey, and what is drawn there sets no scale.
    Long recordings are drawn as the envelope of their smallest and largest values: no peak is lost.

    Parameters
    ----------
    path : str | PathLike
        PNG to write, 8 inches wide; up to 16 high, panels of faults shrink to a third before it grows beyond.
    traces : Sequence[Trace]
        One per observer.
    events : Sequence[AlarmEvent]
        All alarm events of the run.
    thresholds : Mapping[tuple[str, str], float]
        Alarm threshold by observer and fault channel.
    truth : Mapping[str, tuple[NDArray, NDArray]] | None
        By fault channel: times on the vehicle's clock (s) and the true size at them.
    title : str
        Stands above.
    """
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    truth = truth or {}
    spans = alarm_spans(events)
    alarmed = {(span.observer, span.channel) for span in spans}
    chosen = choose_panels([trace.layout for trace in traces], alarmed, truth, thresholds)
    rows = [
        row
        for trace, panels in zip(traces, chosen, strict=True)
        for row in _rows(trace, panels, _concerning(trace, traces, spans), thresholds, truth, heading=len(traces) > 1)
    ] or [_Row(FAULT_IN, lambda _: None)]
    heights = _heights(rows)
    height_in = sum(heights) + TITLE_IN * len(rows) + ENDS_IN
    with rc_context(STYLE):
        figure = Figure(figsize=(WIDTH_IN, height_in), dpi=DPI, layout="constrained")
        FigureCanvasAgg(figure)
        panels = figure.subplots(len(rows), 1, sharex=True, squeeze=False, height_ratios=heights)[:, 0]
        for row, panel in zip(rows, panels, strict=True):
            row.draw(panel)
        for panel in panels[:-1]:
            panel.tick_params(bottom=False)
        panels[-1].set_xlabel("time on the vehicle's clock (s)")
        times = [trace.vehicle_ns[[0, -1]] / 1e9 for trace in traces if len(trace.vehicle_ns)]
        if times:
            panels[-1].set_xlim(np.min(times), np.max(times))
        dotted = bool(thresholds) and any(one.alone for one in chosen)
        _draw_legend(figure, title, dotted, bool(truth), any(one.together for one in chosen), spans)
        figure.savefig(path)


def _heights(rows: Sequence[_Row]) -> list[float]:
    """Return the panels' heights; on a full page those of faults give way, lanes would run into each other."""
    faults = sum(row.shrinks for row in rows)
    others = sum(row.height_in for row in rows if not row.shrinks) + TITLE_IN * len(rows) + ENDS_IN
    fault_in = min(max((HIGHEST_IN - others) / max(faults, 1), LEAST_FAULT_IN), FAULT_IN)
    return [fault_in if row.shrinks else row.height_in for row in rows]


def _concerning(trace: Trace, traces: Sequence[Trace], spans: Sequence[AlarmSpan]) -> list[AlarmSpan]:
    """Return the alarms of an observer, and those of no observer, such as lost telemetry, which concern them all."""
    others = {other.layout.observer for other in traces} - {trace.layout.observer}
    return [span for span in spans if span.observer not in others]


def _rows(
    trace: Trace,
    panels: Panels,
    spans: Sequence[AlarmSpan],
    thresholds: Thresholds,
    truth: Truth,
    *,
    heading: bool,
) -> Iterator[_Row]:
    """Return an observer's panels from top to bottom."""
    layout = trace.layout
    if heading:
        yield _Row(HEADING_IN, partial(draw_heading, text=layout.observer))
    for place in panels.alone:
        scale = same_scale(layout, panels, place)
        draw = partial(
            draw_fault, trace=trace, place=place, spans=spans, thresholds=thresholds, truth=truth, scale=scale
        )
        yield _Row(FAULT_IN, draw, shrinks=True)
    if panels.together:
        yield _Row(
            LANE_IN * max(len(panels.together), LEAST_LANES),
            partial(draw_quiet, trace=trace, places=panels.together, spans=spans, thresholds=thresholds),
        )
    yield _Row(LANE_IN * max(len(layout.outputs), LEAST_LANES), partial(draw_residuals, trace=trace, spans=spans))
    height_in = max(INPUT_IN, INPUT_NAME_IN * min(len(layout.inputs), NAMES_BELOW))
    yield _Row(height_in, partial(draw_inputs, trace=trace, spans=spans))


def _draw_legend(
    figure: Figure, title: str, thresholds: bool, truth: bool, quiet: bool, spans: Sequence[AlarmSpan]
) -> None:
    """Say once, above all panels, what the marks of the fault panels mean."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    marks: list[Any] = [Line2D([], [], color=BLUE, label="fault estimate")]
    if truth:
        marks.append(Line2D([], [], color=BLACK, linestyle=TRUTH_DASHES, label="truth"))
    if thresholds:
        marks.append(Line2D([], [], color=BLACK, linestyle=":", linewidth=0.8, label="alarm threshold"))
    if quiet:
        marks.append(Patch(color=SKY, alpha=BAND_ALPHA, linewidth=0, label="within threshold"))
    for severity in ("warning", "critical"):
        if any(span.severity == severity for span in spans):
            marks.append(Patch(color=SEVERITY[severity], alpha=SPAN_ALPHA, linewidth=0, label=f"{severity} alarm"))
    marks.append(Patch(color=GREY, alpha=NOT_ARMED_ALPHA, linewidth=0, label="alarms not armed"))
    figure.legend(
        handles=marks,
        loc="outside upper left",
        ncols=len(marks),
        alignment="left",
        title=textwrap.fill(title, TITLE_LETTERS) or None,
        title_fontproperties={"size": 9.5, "weight": "bold"},
    )
