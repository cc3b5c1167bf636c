"""The panels of a run's picture: a fault channel, quiet channels, residuals, inputs."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from monitor.bus.alarm_text import printable
from monitor.trace import AlarmSpan, Trace
from monitor.views.palette import Theme
from monitor.views.panels import Thresholds, Truth, evidence, fault_limits, input_limits
from replay.reports.envelope import band, envelope

if TYPE_CHECKING:
    from matplotlib.axes import Axes

TRUTH_DASHES = (0, (4, 2))
BAND_ALPHA = 0.22
DOUBT_ALPHA = 0.3
DOUBT_DEVIATIONS = 2.0
SPAN_ALPHA = 0.25
NOT_ARMED_ALPHA = 0.2

LANE_PERCENT = 99.5
# a residual that is nothing but rounding is zero: the estimates explain its measurement whatever it is
ROUNDING = 1e-9
LANE_THRESHOLDS = 2.6
LONGEST_NAME = 24
FEW_INPUTS = 6
# as many whatever the panel's height, else the layout leaves room for other labels than are drawn
TICKS = 4
# the last two are faint or black; lanes tell series apart without them
LANE_COLOURS = 6


@dataclass(frozen=True, slots=True)
class Look:
    """How a picture is drawn.

    Parameters
    ----------
    theme : Theme
        Its colours.
    bins : int
        Into how many runs a series is thinned.
    without_sd : Collection[tuple[str, str]]
        Channels, by observer and name, whose standard deviation is not drawn.
    """

    theme: Theme
    bins: int
    without_sd: Collection[tuple[str, str]] = ()


def draw_fault(
    panel: Axes,
    look: Look,
    trace: Trace,
    place: int,
    spans: Sequence[AlarmSpan],
    thresholds: Thresholds,
    truth: Truth,
    scale: Sequence[int],
) -> None:
    """Draw one fault channel with its alarms, threshold and truth, scaled as the channels at ``scale`` need."""
    layout, theme = trace.layout, look.theme
    channel = layout.faults[place]
    _shade(panel, look, trace)
    _cover(panel, look, trace, [span for span in spans if span.channel == channel])
    threshold = thresholds.get((layout.observer, channel))
    if threshold is not None:
        panel.axhspan(-threshold, threshold, color=theme.band, alpha=BAND_ALPHA, linewidth=0)
        for level in (-threshold, threshold):
            panel.axhline(level, color=theme.ink, linestyle=":", linewidth=0.7)
    if (layout.observer, channel) not in look.without_sd:
        _shade_doubt(panel, look, trace, place)
    panel.plot(*envelope(_seconds(trace), trace.isolated[:, place], trace.restart, look.bins), color=theme.estimate)
    if channel in truth:
        panel.plot(*truth[channel], color=theme.ink, linestyle=TRUTH_DASHES, linewidth=1.0)
    panel.set_ylim(fault_limits(trace, scale, thresholds, truth))
    panel.locator_params(axis="y", nbins=TICKS)
    unit = layout.fault_units[place]
    _name(panel, trace, f"{channel} ({unit})" if unit else channel)


def draw_quiet(
    panel: Axes, look: Look, trace: Trace, places: Sequence[int], spans: Sequence[AlarmSpan], thresholds: Thresholds
) -> None:
    """Draw channels without an alarm one below the other, each over its own threshold, with its peak."""
    layout, theme = trace.layout, look.theme
    _shade(panel, look, trace)
    _mark(panel, look, spans)
    labels = []
    for lane, place in enumerate(places):
        half = 1.0 / LANE_THRESHOLDS
        panel.axhspan(-lane - half, -lane + half, color=theme.band, alpha=BAND_ALPHA, linewidth=0)
        share = trace.isolated[:, place] / thresholds[layout.observer, layout.faults[place]]
        height = np.clip(share / LANE_THRESHOLDS, -0.5, 0.5) - lane
        panel.plot(*envelope(_seconds(trace), height, trace.restart, look.bins), color=theme.estimate)
        watched = evidence(trace, share)
        peak = f"  {100.0 * np.max(np.abs(watched)):.0f} %" if len(watched) else ""
        labels.append(_short(layout.faults[place]) + peak)
    _label_lanes(panel, labels)
    _name(panel, trace, "quiet channels (band: ± own threshold; right: peak in % of it)")


def draw_residuals(panel: Axes, look: Look, trace: Trace, spans: Sequence[AlarmSpan]) -> None:
    """Draw the residuals one below the other, each lane as high as most of its values while alarms were armed.

    An alarm that is about no fault channel, such as an unexplained residual, is shaded and named here.
    """
    _shade(panel, look, trace)
    _mark(panel, look, spans)
    elsewhere = [span for span in spans if span.channel not in trace.layout.faults]
    _cover(panel, look, trace, elsewhere)
    labels = []
    for index, name in enumerate(trace.layout.outputs):
        residual = trace.residual[:, index]
        half = _most(evidence(trace, residual))
        nothing = half <= ROUNDING * _most(evidence(trace, trace.y[:, index]))
        lane = np.clip(residual / half / 2.2, -0.5, 0.5) if half and not nothing else np.zeros(len(residual))
        _draw_lane(panel, look, trace, lane - index, index)
        labels.append(f"{_short(name)}  ±{0.0 if nothing else half:.2g}")
    _label_lanes(panel, labels)
    about = ", ".join(dict.fromkeys(f"{span.channel} alarm" for span in elsewhere))
    what = f"residuals (model's unit; right: {LANE_PERCENT:g} % lie within)"
    _name(panel, trace, f"{what}; shaded: {about}" if about else what)


def draw_inputs(panel: Axes, look: Look, trace: Trace, spans: Sequence[AlarmSpan]) -> None:
    """Draw few inputs over one axis with their names to its right, more of them one below the other."""
    _shade(panel, look, trace)
    _mark(panel, look, spans)
    if len(trace.layout.inputs) > FEW_INPUTS:
        _draw_many_inputs(panel, look, trace)
        return
    for index, name in enumerate(trace.layout.inputs):
        points = envelope(_seconds(trace), trace.u[:, index], trace.restart, look.bins)
        panel.plot(*points, color=look.theme.series[index], label=_short(name), linewidth=0.6)
    panel.set_ylim(input_limits(trace))
    panel.locator_params(axis="y", nbins=TICKS)
    if trace.layout.inputs:
        legend = panel.legend(
            loc="center left", bbox_to_anchor=(1.0, 0.5), borderpad=0, handlelength=1.0, labelspacing=0.2
        )
        for line in legend.get_lines():
            line.set_linewidth(1.4)
    _name(panel, trace, "inputs (model's unit)")


def draw_heading(panel: Axes, look: Look, text: str) -> None:
    """Write an observer's name over a line across the picture."""
    panel.set_axis_off()
    panel.axhline(0.95, color=look.theme.ink, linewidth=1.0)
    panel.text(0.0, 0.3, printable(text), transform=panel.transAxes, size=9.5, weight="bold", va="center")
    panel.set_ylim(0.0, 1.0)


def _draw_many_inputs(panel: Axes, look: Look, trace: Trace) -> None:
    labels = []
    for index, name in enumerate(trace.layout.inputs):
        low, high = _ends(evidence(trace, trace.u[:, index]))
        middle, height = (low + high) / 2.0, (high - low) or 1.0
        lane = np.clip((trace.u[:, index] - middle) / height / 1.15, -0.5, 0.5) - index
        _draw_lane(panel, look, trace, lane, index)
        labels.append(f"{_short(name)}  {low:.2g} … {high:.2g}".replace("-", "\N{MINUS SIGN}"))
    _label_lanes(panel, labels)
    _name(panel, trace, "inputs (model's unit; right: from … to)")


def _draw_lane(panel: Axes, look: Look, trace: Trace, lane: NDArray[np.float64], index: int) -> None:
    colour = look.theme.series[index % LANE_COLOURS]
    panel.plot(*envelope(_seconds(trace), lane, trace.restart, look.bins), color=colour, linewidth=0.6)


def _name(panel: Axes, trace: Trace, text: str) -> None:
    panel.set_title(printable(f"{trace.layout.observer} / {text}"), loc="left", size=8, pad=2.5)


def _label_lanes(panel: Axes, labels: Sequence[str]) -> None:
    panel.yaxis.tick_right()
    panel.set_yticks([-float(lane) for lane in range(len(labels))], labels)
    panel.tick_params(axis="y", length=0)
    panel.set_ylim(0.55 - max(len(labels), 1), 0.55)


def _short(name: str) -> str:
    """Return a name that cannot squeeze the panels."""
    name = printable(name)
    return name if len(name) <= LONGEST_NAME else name[: LONGEST_NAME - 1] + "…"


def _seconds(trace: Trace) -> NDArray[np.float64]:
    return trace.vehicle_ns / 1e9


def _shade(panel: Axes, look: Look, trace: Trace) -> None:
    """Shade a panel where no alarm could be raised."""
    times = _seconds(trace)
    edges = np.flatnonzero(np.diff(np.concatenate(([True], trace.armed, [True])).astype(np.int8)))
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        end = times[min(stop, len(times) - 1)]
        panel.axvspan(times[start], end, color=look.theme.muted, alpha=NOT_ARMED_ALPHA, linewidth=0)


def _shade_doubt(panel: Axes, look: Look, trace: Trace, place: int) -> None:
    """Shade standard deviations around an estimate where the channel is held responsible for something."""
    estimate = trace.isolated[:, place]
    sd = np.where(trace.armed & (estimate != 0.0), trace.sd[:, place], np.nan)
    if not np.isfinite(sd).any():
        return
    low, high = estimate - DOUBT_DEVIATIONS * sd, estimate + DOUBT_DEVIATIONS * sd
    panel.fill_between(
        *band(_seconds(trace), low, high, look.bins), color=look.theme.estimate, alpha=DOUBT_ALPHA, linewidth=0
    )


def _cover(panel: Axes, look: Look, trace: Trace, spans: Sequence[AlarmSpan]) -> None:
    """Shade where alarms stood."""
    for span in spans:
        end_ns = trace.vehicle_ns[-1] if span.end_vehicle_ns is None else span.end_vehicle_ns
        colour = look.theme.severity[span.severity]
        panel.axvspan(span.start_vehicle_ns / 1e9, end_ns / 1e9, color=colour, alpha=SPAN_ALPHA, linewidth=0)
        panel.axvline(span.start_vehicle_ns / 1e9, color=colour, linewidth=1.0)


def _mark(panel: Axes, look: Look, spans: Sequence[AlarmSpan]) -> None:
    """Mark where alarms began and ended."""
    for span in spans:
        colour = look.theme.severity[span.severity]
        panel.axvline(span.start_vehicle_ns / 1e9, color=colour, linewidth=1.0)
        if span.end_vehicle_ns is not None:
            panel.axvline(span.end_vehicle_ns / 1e9, color=colour, linewidth=1.0, linestyle=":")


def _most(values: NDArray[np.float64]) -> float:
    """Return the size below which most values are, 0 where there is none."""
    return float(np.percentile(np.abs(values), LANE_PERCENT)) if len(values) else 0.0


def _ends(values: NDArray[np.float64]) -> tuple[float, float]:
    """Return between what most values are."""
    if not len(values):
        return 0.0, 0.0
    low, high = np.percentile(values, (100.0 - LANE_PERCENT, LANE_PERCENT))
    return float(low), float(high)
