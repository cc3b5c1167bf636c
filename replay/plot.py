"""The picture of a run: fault estimates with truth, thresholds and alarms, residuals, inputs, as one PNG."""

from __future__ import annotations

import os
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from monitor.event import AlarmEvent
from monitor.palette import BLACK, BLUE, GREY, SEVERITY, series_colour
from monitor.trace import AlarmSpan, Trace, alarm_spans

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Truth = Mapping[str, tuple[NDArray[np.float64], NDArray[np.float64]]]

BINS = 1500
WIDTH_IN = 8.0
FAULT_IN = 1.05
LANE_IN = 0.28
INPUT_IN = 1.2
DPI = 160

LANE_DEVIATIONS = 10.0
TRUTH_DASHES = (0, (4, 2))

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


def plot_png(
    path: str | os.PathLike[str],
    traces: Sequence[Trace],
    events: Sequence[AlarmEvent],
    thresholds: Mapping[str, float],
    truth: Truth | None = None,
    title: str = "",
) -> None:
    """Draw a run.

    Per observer: one panel for each fault channel with its estimate, its alarm threshold as dotted lines, the
    truth dashed where it is known, and its alarms as shaded spans; then the residuals in lanes, each over its
    own scatter; then the inputs. Time is the vehicle's own. Where no alarm could be raised, panels are grey.
    Long recordings are drawn as the envelope of their smallest and largest values: no peak is lost.

    Parameters
    ----------
    path : str | PathLike
        PNG to write.
    traces : Sequence[Trace]
        One per observer.
    events : Sequence[AlarmEvent]
        All alarm events of the run.
    thresholds : Mapping[str, float]
        Alarm threshold by fault channel.
    truth : Mapping[str, tuple[NDArray, NDArray]] | None
        By fault channel: times on the vehicle's clock (s) and the true size at them.
    title : str
        Stands above.
    """
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    heights = [height for trace in traces for height in _heights(trace)] or [1.0]
    spans = alarm_spans(events)
    with rc_context(STYLE):
        figure = Figure(figsize=(WIDTH_IN, sum(heights) + 1.0), dpi=DPI, layout="constrained")
        FigureCanvasAgg(figure)
        panels = figure.subplots(len(heights), 1, sharex=True, squeeze=False, height_ratios=heights)[:, 0]
        free = iter(panels)
        observers = {trace.layout.observer for trace in traces}
        for trace in traces:
            # an alarm of no observer, such as lost telemetry, concerns them all
            others = observers - {trace.layout.observer}
            own = [span for span in spans if span.observer not in others]
            _draw_faults(free, trace, own, thresholds, truth or {})
            _draw_residuals(next(free), trace, own)
            _draw_inputs(next(free), trace, own)
        for panel in panels[:-1]:
            panel.tick_params(bottom=False)
        panels[-1].set_xlabel("time on the vehicle's clock (s)")
        times = [trace.vehicle_ns[[0, -1]] / 1e9 for trace in traces if len(trace.vehicle_ns)]
        if times:
            panels[-1].set_xlim(np.min(times), np.max(times))
        figure.align_ylabels()
        _draw_legend(figure, title, bool(thresholds), bool(truth), spans)
        figure.savefig(path)


def _heights(trace: Trace) -> list[float]:
    """Return the heights of an observer's panels: one for each fault, one for residuals, one for inputs."""
    lanes = LANE_IN * max(len(trace.layout.outputs), 2)
    return [FAULT_IN] * len(trace.layout.faults) + [lanes, INPUT_IN]


def _draw_faults(
    free: Iterator[Axes],
    trace: Trace,
    spans: Sequence[AlarmSpan],
    thresholds: Mapping[str, float],
    truth: Truth,
) -> None:
    """Draw one panel for each fault channel; channels of the same unit share their vertical scale."""
    layout = trace.layout
    times = trace.vehicle_ns / 1e9
    limits = {unit: _Limits() for unit in layout.fault_units}
    drawn = []
    for index, (channel, unit) in enumerate(zip(layout.faults, layout.fault_units, strict=True)):
        panel = next(free)
        drawn.append((panel, unit))
        _shade(panel, trace)
        for span in spans:
            if span.channel == channel and len(times):
                end = times[-1] if span.end_vehicle_ns is None else span.end_vehicle_ns / 1e9
                colour = SEVERITY[span.severity]
                panel.axvspan(span.start_vehicle_ns / 1e9, end, color=colour, alpha=0.25, linewidth=0)
                panel.axvline(span.start_vehicle_ns / 1e9, color=colour, linewidth=1.0)
        threshold = thresholds.get(channel)
        if threshold is not None:
            for level in (-threshold, threshold):
                panel.axhline(level, color=BLACK, linestyle=":", linewidth=0.8)
            limits[unit].include(np.array([-threshold, threshold]))
        panel.plot(*envelope(times, trace.isolated[:, index], trace.restart), color=BLUE)
        limits[unit].include(_evidence(trace, trace.isolated[:, index]))
        if channel in truth:
            known, size = truth[channel]
            panel.plot(known, size, color=BLACK, linestyle=TRUTH_DASHES, linewidth=1.0)
            limits[unit].include(size)
        panel.set_ylabel(f"{channel}\n" + "\n".join(textwrap.wrap(f"({unit})", 17)))
    for panel, unit in drawn:
        panel.set_ylim(limits[unit].padded())


def _draw_residuals(panel: Axes, trace: Trace, spans: Sequence[AlarmSpan]) -> None:
    """Draw the residuals one below the other, each lane :data:`LANE_DEVIATIONS` deviations high."""
    times = trace.vehicle_ns / 1e9
    _shade(panel, trace)
    _mark(panel, spans)
    names = trace.layout.outputs
    for index in range(len(names)):
        residual = trace.residual[:, index]
        lane = np.clip(residual / _scatter(_evidence(trace, residual)) / LANE_DEVIATIONS, -0.5, 0.5) - index
        panel.plot(*envelope(times, lane, trace.restart), color=series_colour(index), linewidth=0.6)
    panel.set_yticks([-float(index) for index in range(len(names))], names)
    panel.tick_params(axis="y", length=0)
    panel.set_ylim(0.55 - max(len(names), 1), 0.55)
    panel.set_ylabel(f"residual\n(±{LANE_DEVIATIONS / 2:g} std. dev.\na lane)")


def _draw_inputs(panel: Axes, trace: Trace, spans: Sequence[AlarmSpan]) -> None:
    times = trace.vehicle_ns / 1e9
    _shade(panel, trace)
    _mark(panel, spans)
    for index, name in enumerate(trace.layout.inputs):
        points = envelope(times, trace.u[:, index], trace.restart)
        panel.plot(*points, color=series_colour(index), label=name, linewidth=0.6, alpha=0.85)
    panel.set_ylabel("inputs\n(model's unit)")
    if trace.layout.inputs:
        columns = min(len(trace.layout.inputs), 8)
        panel.legend(loc="lower right", bbox_to_anchor=(1.0, 0.97), ncols=columns, borderpad=0)


def _draw_legend(figure: Figure, title: str, thresholds: bool, truth: bool, spans: Sequence[AlarmSpan]) -> None:
    """Say once, above all panels, what the marks of the fault panels mean."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    marks: list[Any] = [Line2D([], [], color=BLUE, label="fault estimate")]
    if truth:
        marks.append(Line2D([], [], color=BLACK, linestyle=TRUTH_DASHES, label="truth"))
    if thresholds:
        marks.append(Line2D([], [], color=BLACK, linestyle=":", linewidth=0.8, label="alarm threshold"))
    for severity in ("warning", "critical"):
        if any(span.severity == severity for span in spans):
            marks.append(Patch(color=SEVERITY[severity], alpha=0.3, linewidth=0, label=f"{severity} alarm"))
    marks.append(Patch(color=GREY, alpha=0.2, linewidth=0, label="alarms not armed"))
    style = {"size": 9.5, "weight": "bold"}
    figure.legend(
        handles=marks,
        loc="outside upper left",
        ncols=len(marks),
        alignment="left",
        title=title or None,
        title_fontproperties=style,
    )


def _shade(panel: Axes, trace: Trace) -> None:
    """Shade a panel where no alarm could be raised."""
    times = trace.vehicle_ns / 1e9
    edges = np.flatnonzero(np.diff(np.concatenate(([True], trace.armed, [True])).astype(np.int8)))
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        panel.axvspan(times[start], times[min(stop, len(times) - 1)], color=GREY, alpha=0.2, linewidth=0)


def _mark(panel: Axes, spans: Sequence[AlarmSpan]) -> None:
    """Mark where alarms began and ended."""
    for span in spans:
        colour = SEVERITY[span.severity]
        panel.axvline(span.start_vehicle_ns / 1e9, color=colour, linewidth=1.0)
        if span.end_vehicle_ns is not None:
            panel.axvline(span.end_vehicle_ns / 1e9, color=colour, linewidth=1.0, linestyle=":")


def _evidence(trace: Trace, values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the finite values at samples that alarms could be raised from, else of all."""
    used = values[trace.armed] if trace.armed.any() else values
    return used[np.isfinite(used)]


def envelope(
    times: NDArray[np.float64], values: NDArray[np.float64], restart: NDArray[np.bool_], bins: int = BINS
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return fewer points that draw the same line.

    Runs of samples become their smallest and largest value in the order they occurred. The line is broken (by
    NaN) where the observer started afresh.

    Parameters
    ----------
    times, values : NDArray[np.float64]
        The series (N,).
    restart : NDArray[np.bool_]
        Where it starts afresh (N,).
    bins : int
        Number of runs, for the whole series.
    """
    size = -(-len(values) // bins)
    edges = np.union1d(np.flatnonzero(restart), [0, len(values)])
    found: list[NDArray[np.float64]] = []
    for start, stop in pairwise(edges.astype(np.intp)):
        picked = np.arange(start, stop)
        if size > 2 and stop - start > 2 * size:
            picked = _extremes(values[start:stop], size) + start
        found += [np.stack((times[picked], values[picked])), np.full((2, 1), np.nan)]
    joined = np.concatenate(found[:-1], axis=1) if found else np.empty((2, 0))
    return joined[0], joined[1]


def _extremes(values: NDArray[np.float64], size: int) -> NDArray[np.intp]:
    """Return the places of the smallest and the largest value of each run of ``size`` samples, in order."""
    whole = len(values) // size * size
    rest = np.arange(whole, len(values))
    runs = values[:whole].reshape(-1, size)
    runs = np.where(np.isnan(runs), 0.0, runs)
    both = np.sort(np.stack((runs.argmin(axis=1), runs.argmax(axis=1)), axis=1), axis=1)
    picked = (both + np.arange(0, whole, size)[:, None]).ravel()
    if len(rest):
        last = np.where(np.isnan(values[rest]), 0.0, values[rest])
        picked = np.append(picked, whole + np.sort([last.argmin(), last.argmax()]))
    return picked


def _scatter(values: NDArray[np.float64]) -> float:
    """Return the standard deviation that the middle half of the values suggests, 1 where there is none."""
    if not len(values):
        return 1.0
    low, high = np.percentile(values, (25.0, 75.0))
    # a normal distribution's quartiles lie 1.349 standard deviations apart
    return float(high - low) / 1.349 or float(np.max(np.abs(values))) or 1.0


class _Limits:
    """Range of a vertical axis, around zero, that shows all but single outliers."""

    def __init__(self) -> None:
        self._low, self._high = 0.0, 0.0

    def include(self, values: NDArray[np.float64]) -> None:
        values = values[np.isfinite(values)]
        if len(values):
            low, high = np.percentile(values, (0.02, 99.98))
            self._low, self._high = min(self._low, float(low)), max(self._high, float(high))

    def padded(self) -> tuple[float, float]:
        margin = 0.06 * (self._high - self._low) or 1.0
        return self._low - margin, self._high + margin
