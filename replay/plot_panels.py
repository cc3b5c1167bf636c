"""The panels of a run's picture: a fault channel, quiet channels, residuals, inputs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from monitor.palette import BLACK, BLUE, GREY, SERIES, SEVERITY, SKY, series_colour
from monitor.panels import Thresholds, Truth, evidence, fault_limits, input_limits
from monitor.trace import AlarmSpan, Trace
from replay.envelope import envelope

if TYPE_CHECKING:
    from matplotlib.axes import Axes

TRUTH_DASHES = (0, (4, 2))
BAND_ALPHA = 0.22
SPAN_ALPHA = 0.25
NOT_ARMED_ALPHA = 0.2
# an estimate that is that much less sure than at its best was coasted
WIDER = 1.2

LANE_DEVIATIONS = 10.0
LANE_THRESHOLDS = 2.6
LONGEST_NAME = 24
NAMES_BELOW = 10
# as many whatever the panel's height, else the layout leaves room for other labels than are drawn
TICKS = 4
# yellow lines are faint on white; lanes tell series apart without it
LANE_COLOURS = 7


def draw_fault(
    panel: Axes,
    trace: Trace,
    place: int,
    spans: Sequence[AlarmSpan],
    thresholds: Thresholds,
    truth: Truth,
    scale: Sequence[int],
) -> None:
    """Draw one fault channel with its alarms, threshold and truth, scaled as the channels at ``scale`` need."""
    layout = trace.layout
    channel = layout.faults[place]
    _shade(panel, trace)
    _cover(panel, trace, [span for span in spans if span.channel == channel])
    threshold = thresholds.get((layout.observer, channel))
    if threshold is not None:
        for level in (-threshold, threshold):
            panel.axhline(level, color=BLACK, linestyle=":", linewidth=0.8)
    _shade_doubt(panel, trace, place)
    panel.plot(*envelope(_seconds(trace), trace.isolated[:, place], trace.restart), color=BLUE)
    if channel in truth:
        panel.plot(*truth[channel], color=BLACK, linestyle=TRUTH_DASHES, linewidth=1.0)
    panel.set_ylim(fault_limits(trace, scale, thresholds, truth))
    panel.locator_params(axis="y", nbins=TICKS)
    unit = layout.fault_units[place]
    _name(panel, trace, f"{channel} ({unit})" if unit else channel)


def draw_quiet(
    panel: Axes, trace: Trace, places: Sequence[int], spans: Sequence[AlarmSpan], thresholds: Thresholds
) -> None:
    """Draw channels without an alarm one below the other, each over its own threshold, with its peak."""
    layout = trace.layout
    _shade(panel, trace)
    _mark(panel, spans)
    labels = []
    for lane, place in enumerate(places):
        half = 1.0 / LANE_THRESHOLDS
        panel.axhspan(-lane - half, -lane + half, color=SKY, alpha=BAND_ALPHA, linewidth=0)
        share = trace.isolated[:, place] / thresholds[layout.observer, layout.faults[place]]
        height = np.clip(share / LANE_THRESHOLDS, -0.5, 0.5) - lane
        panel.plot(*envelope(_seconds(trace), height, trace.restart), color=BLUE)
        watched = evidence(trace, share)
        peak = f"  {100.0 * np.max(np.abs(watched)):.0f} %" if len(watched) else ""
        labels.append(_short(layout.faults[place]) + peak)
    _label_lanes(panel, labels)
    _name(panel, trace, "quiet channels, band: ± own threshold, right: peak in % of it")


def draw_residuals(panel: Axes, trace: Trace, spans: Sequence[AlarmSpan]) -> None:
    """Draw the residuals one below the other, each lane :data:`LANE_DEVIATIONS` deviations high.

    An alarm that is about no fault channel, such as an unexplained residual, is shaded and named here.
    """
    _shade(panel, trace)
    _mark(panel, spans)
    elsewhere = [span for span in spans if span.channel not in trace.layout.faults]
    _cover(panel, trace, elsewhere)
    for index in range(len(trace.layout.outputs)):
        residual = trace.residual[:, index]
        lane = np.clip(residual / _scatter(evidence(trace, residual)) / LANE_DEVIATIONS, -0.5, 0.5) - index
        colour = series_colour(index % LANE_COLOURS)
        panel.plot(*envelope(_seconds(trace), lane, trace.restart), color=colour, linewidth=0.6)
    _label_lanes(panel, [_short(name) for name in trace.layout.outputs])
    about = ", ".join(dict.fromkeys(f"{span.channel} alarm" for span in elsewhere))
    what = f"residuals, each ±{LANE_DEVIATIONS / 2:g} standard deviations"
    _name(panel, trace, f"{what}; shaded: {about}" if about else what)


def draw_inputs(panel: Axes, trace: Trace, spans: Sequence[AlarmSpan]) -> None:
    """Draw the inputs in one panel with their names to its right."""
    _shade(panel, trace)
    _mark(panel, spans)
    for index, name in enumerate(trace.layout.inputs):
        points = envelope(_seconds(trace), trace.u[:, index], trace.restart)
        # colours repeat after a round, dashes tell the second from the first
        style = "-" if index < len(SERIES) else "--"
        panel.plot(*points, color=series_colour(index), label=_short(name), linestyle=style, linewidth=0.6, alpha=0.85)
    panel.set_ylim(input_limits(trace))
    panel.locator_params(axis="y", nbins=TICKS)
    if trace.layout.inputs:
        columns = -(-len(trace.layout.inputs) // NAMES_BELOW)
        panel.legend(
            loc="center left", bbox_to_anchor=(1.0, 0.5), ncols=columns, borderpad=0, handlelength=1.0, labelspacing=0.2
        )
    _name(panel, trace, "inputs (model's unit)")


def draw_heading(panel: Axes, text: str) -> None:
    """Write an observer's name over a line across the picture."""
    panel.set_axis_off()
    panel.axhline(0.95, color=BLACK, linewidth=1.0)
    panel.text(0.0, 0.3, text, transform=panel.transAxes, size=9.5, weight="bold", va="center")
    panel.set_ylim(0.0, 1.0)


def _name(panel: Axes, trace: Trace, text: str) -> None:
    panel.set_title(f"{trace.layout.observer} / {text}", loc="left", size=8, pad=2.5)


def _label_lanes(panel: Axes, labels: Sequence[str]) -> None:
    panel.yaxis.tick_right()
    panel.set_yticks([-float(lane) for lane in range(len(labels))], labels)
    panel.tick_params(axis="y", length=0)
    panel.set_ylim(0.55 - max(len(labels), 1), 0.55)


def _short(name: str) -> str:
    """Return a name that cannot squeeze the panels."""
    return name if len(name) <= LONGEST_NAME else name[: LONGEST_NAME - 1] + "…"


def _seconds(trace: Trace) -> NDArray[np.float64]:
    return trace.vehicle_ns / 1e9


def _shade(panel: Axes, trace: Trace) -> None:
    """Shade a panel where no alarm could be raised."""
    times = _seconds(trace)
    edges = np.flatnonzero(np.diff(np.concatenate(([True], trace.armed, [True])).astype(np.int8)))
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        end = times[min(stop, len(times) - 1)]
        panel.axvspan(times[start], end, color=GREY, alpha=NOT_ARMED_ALPHA, linewidth=0)


def _shade_doubt(panel: Axes, trace: Trace, place: int) -> None:
    """Shade two standard deviations around an estimate that was coasted, until it is as sure as before."""
    sd = trace.sd[:, place]
    if not np.isfinite(sd).any():
        return
    wide = sd > WIDER * np.nanmin(sd)
    low, high = trace.isolated[:, place] - 2.0 * sd, trace.isolated[:, place] + 2.0 * sd
    panel.fill_between(_seconds(trace), low, high, where=wide, color=BLUE, alpha=BAND_ALPHA, linewidth=0)


def _cover(panel: Axes, trace: Trace, spans: Sequence[AlarmSpan]) -> None:
    """Shade where alarms stood."""
    if not len(trace.vehicle_ns):
        return
    for span in spans:
        end_ns = trace.vehicle_ns[-1] if span.end_vehicle_ns is None else span.end_vehicle_ns
        colour = SEVERITY[span.severity]
        panel.axvspan(span.start_vehicle_ns / 1e9, end_ns / 1e9, color=colour, alpha=SPAN_ALPHA, linewidth=0)
        panel.axvline(span.start_vehicle_ns / 1e9, color=colour, linewidth=1.0)


def _mark(panel: Axes, spans: Sequence[AlarmSpan]) -> None:
    """Mark where alarms began and ended."""
    for span in spans:
        colour = SEVERITY[span.severity]
        panel.axvline(span.start_vehicle_ns / 1e9, color=colour, linewidth=1.0)
        if span.end_vehicle_ns is not None:
            panel.axvline(span.end_vehicle_ns / 1e9, color=colour, linewidth=1.0, linestyle=":")


def _scatter(values: NDArray[np.float64]) -> float:
    """Return the standard deviation that the middle half of the values suggests, 1 where there is none."""
    if not len(values):
        return 1.0
    low, high = np.percentile(values, (25.0, 75.0))
    # a normal distribution's quartiles lie 1.349 standard deviations apart
    return float(high - low) / 1.349 or float(np.max(np.abs(values))) or 1.0
