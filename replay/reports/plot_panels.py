"""The panels of a run's picture: alarms, a fault channel, quiet channels, residuals, inputs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from adapters.errors import printable
from monitor.fitting.fit_report import MODEL_UNIT
from monitor.trace import AlarmSpan, Trace
from monitor.views.palette import Theme
from monitor.views.panels import RunView, evidence, fault_limits
from replay.reports.recording_facts import GAP_PERIODS, GAP_S

if TYPE_CHECKING:
    from matplotlib.axes import Axes

BINS = 1500
"""Chosen: more than a picture of 8 in at 160 dpi has pixels across."""


def envelope(
    times: NDArray[np.float64], values: NDArray[np.float64], restart: NDArray[np.bool_], bins: int = BINS
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return fewer points that draw the same line as a series (N,).

    ``bins`` runs of samples become their smallest and largest value in the order they occurred. The line is broken (by
    NaN) where the observer started afresh.
    """
    rows = kept_rows(values, restart, bins)
    breaks = np.flatnonzero(restart[rows[1:]] & (np.diff(rows) > 0)) + 1 if len(rows) else rows
    return np.insert(times[rows], breaks, np.nan), np.insert(values[rows], breaks, np.nan)


def kept_rows(values: NDArray[np.float64], restart: NDArray[np.bool_], bins: int = BINS) -> NDArray[np.intp]:
    """Return the samples that draw the same line as all N: of ``bins`` runs the smallest and the largest, in order.

    The first sample after the observer started afresh is kept, too.
    """
    size = -(-len(values) // bins)
    edges = np.union1d(np.flatnonzero(restart), [0, len(values)]).astype(np.intp)
    parts = [np.empty(0, np.intp)]
    for start, stop in pairwise(edges):
        if size > 2 and stop - start > 2 * size:
            parts.append(np.append(start, _extremes(values[start:stop], size) + start))
        else:
            parts.append(np.arange(start, stop))
    return np.unique(np.concatenate(parts))


def band(
    times: NDArray[np.float64], low: NDArray[np.float64], high: NDArray[np.float64], bins: int = BINS
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return fewer points that draw the same band between two series (N,): its ends over runs of samples.

    A run that holds no number keeps none, so that the band is broken there.
    """
    size = -(-len(times) // bins)
    if size < 2:
        return times, low, high
    starts = np.arange(0, len(times), size)
    # fmin and fmax pass over what is no number
    return times[starts], np.fmin.reduceat(low, starts), np.fmax.reduceat(high, starts)


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


# Chosen by eye; a band of two standard deviations holds 95 %.
TRUTH_DASHES = (0, (4, 2))
BAND_ALPHA = 0.22
DOUBT_ALPHA = 0.3
DOUBT_DEVIATIONS = 2.0
# the two differ in lightness too, for those who see no difference in hue
SPAN_ALPHA: dict[str, float] = {"warning": 0.25, "critical": 0.42}
UNWATCHED_ALPHA = 0.6
UNWATCHED_HATCH = "//////"
HELD_S = 0.5
# a wide uncertainty may widen a panel this much of what else it shows, no more
DOUBT_ROOM = 0.5
# where an estimate leaves its panel, at most so many marks say so
BEYOND_MARKS = 80

LANE_PERCENT = 99.5
"""Chosen: the scale of residuals without the jumps of a fault, which would flatten the rest."""
# a residual that is nothing but rounding is zero: the estimates explain its measurement whatever it is
ROUNDING = 1e-9
LANE_THRESHOLDS = 2.6
LONGEST_NAME = 24
# as many whatever the panel's height, else the layout leaves room for other labels than are drawn
TICKS = 4


@dataclass(frozen=True, slots=True)
class Look:
    """How a picture is drawn."""

    theme: Theme
    run: RunView
    origin_ns: int = 0  # zero of the axis of time, vehicle's clock
    end_s: float = 0.0  # its end
    headed: bool = False  # whether a heading above the panels names their observer, so that their titles need not


def draw_alarms(panel: Axes, look: Look, spans: Sequence[AlarmSpan]) -> None:
    """Draw when each channel's alarms were active, a lane for each channel."""
    lanes = alarm_lanes(spans)
    for lane, key in enumerate(lanes):
        for span in spans:
            if (span.observer, span.channel) == key:
                start_s, end_s = _ends_s(look, span)
                colour = look.theme.severity[span.severity]
                height = (-lane - 0.3, 0.6)
                panel.broken_barh(
                    [(start_s, end_s - start_s)], height, facecolor=colour, alpha=SPAN_ALPHA[span.severity], linewidth=0
                )
                panel.plot([start_s] * 2, [-lane - 0.3, -lane + 0.3], color=colour, linewidth=1.4)
    _label_lanes(panel, [_short(f"{observer} / {channel}", 2 * LONGEST_NAME) for observer, channel in lanes])
    panel.set_title("alarms", loc="left", size=8, pad=2.5)


def alarm_lanes(spans: Sequence[AlarmSpan]) -> list[tuple[str, str]]:
    """Return observer and channel of all alarms, in the order of their first."""
    return list(dict.fromkeys((span.observer, span.channel) for span in spans))


def draw_fault(
    panel: Axes,
    look: Look,
    trace: Trace,
    place: int,
    spans: Sequence[AlarmSpan],
    scale: Sequence[int],
) -> None:
    """Draw one fault channel with its alarms, threshold and truth, scaled as the channels at ``scale`` need."""
    layout, theme, run = trace.layout, look.theme, look.run
    channel = layout.faults[place]
    _shade(panel, look, trace)
    _cover(panel, look, [span for span in spans if span.channel == channel])
    threshold = run.thresholds.get((layout.observer, channel))
    # the share of a deflection that is lost is judged by its certainty, not by a level
    if threshold is not None and (layout.observer, channel) not in look.run.without_sd:
        panel.axhspan(-threshold, threshold, color=theme.muted, alpha=BAND_ALPHA, linewidth=0)
        for level in (-threshold, threshold):
            panel.axhline(level, color=theme.ink, linestyle=":", linewidth=0.7)
    limits = _with_doubt(fault_limits(trace, scale, run.thresholds, run.truth), look, trace, scale)
    if (layout.observer, channel) not in look.run.without_sd:
        _shade_doubt(panel, look, trace, place)
    estimate = trace.isolated[:, place]
    if channel in run.truth:
        times_s, sizes = run.truth[channel]
        panel.plot(times_s - look.origin_ns / 1e9, sizes, color=theme.ink, linestyle=TRUTH_DASHES, linewidth=1.6)
    panel.plot(*envelope(_seconds(trace, look), estimate, trace.restart), color=theme.estimate)
    panel.set_ylim(limits)
    _mark_beyond(panel, look, trace, estimate, limits)
    panel.locator_params(axis="y", nbins=TICKS)
    unit = layout.fault_units[place] or MODEL_UNIT
    _name(panel, look, trace, f"{channel} ({unit})")


def draw_quiet(panel: Axes, look: Look, trace: Trace, places: Sequence[int], spans: Sequence[AlarmSpan]) -> None:
    """Draw channels without an alarm one below the other, each over its own threshold, with its peak."""
    layout, theme = trace.layout, look.theme
    _shade(panel, look, trace)
    _mark(panel, look, spans)
    labels = []
    for lane, place in enumerate(places):
        half = 1.0 / LANE_THRESHOLDS
        panel.axhspan(-lane - half, -lane + half, color=theme.muted, alpha=BAND_ALPHA, linewidth=0)
        share = trace.isolated[:, place] / look.run.thresholds[layout.observer, layout.faults[place]]
        height = np.clip(share / LANE_THRESHOLDS, -0.5, 0.5) - lane
        panel.plot(*envelope(_seconds(trace, look), height, trace.restart), color=theme.estimate)
        watched = evidence(trace, share)
        peak = f"  {100.0 * np.max(np.abs(watched)):.0f} %" if len(watched) else ""
        labels.append(_short(layout.faults[place]) + peak)
    _label_lanes(panel, labels)
    _name(panel, look, trace, "quiet channels (band: ± own threshold; right: peak in % of it)")


def draw_residuals(panel: Axes, look: Look, trace: Trace, spans: Sequence[AlarmSpan]) -> None:
    """Draw the residuals one below the other, each lane as high as most of its values while alarms were armed.

    One that is nothing but rounding is left out.
    An alarm that is about no fault channel, such as an unexplained residual, is shaded and named here.
    """
    _shade(panel, look, trace)
    _mark(panel, look, spans)
    elsewhere = [span for span in spans if span.channel not in trace.layout.faults]
    _cover(panel, look, elsewhere)
    labels = []
    for row, (index, half) in enumerate(residual_sizes(trace).items()):
        lane = np.clip(trace.residual[:, index] / half / 2.2, -0.5, 0.5)
        _draw_lane(panel, look, trace, lane - row, look.theme.residual)
        labels.append(f"{_short(trace.layout.outputs[index])}  ±{half:.2g}")
    _label_lanes(panel, labels)
    about = ", ".join(dict.fromkeys(f"{span.channel} alarm" for span in elsewhere))
    what = f"residuals ({MODEL_UNIT}; right: {LANE_PERCENT:g} % lie within)"
    _name(panel, look, trace, f"{what}; shaded: {about}" if about else what)


def residual_sizes(trace: Trace) -> dict[int, float]:
    """Return the size below which most of each residual is, by its index, of those that are more than rounding."""
    halves = [usual_size(evidence(trace, residual)) for residual in trace.residual.T]
    sizes = [usual_size(evidence(trace, measured)) for measured in trace.y.T]
    return {index: half for index, half in enumerate(halves) if half > ROUNDING * sizes[index]}


def draw_inputs(panel: Axes, look: Look, trace: Trace, spans: Sequence[AlarmSpan]) -> None:
    """Draw the inputs one below the other, each lane as high as most of its values while alarms were armed."""
    _shade(panel, look, trace)
    _mark(panel, look, spans)
    labels = []
    for index, name in enumerate(trace.layout.inputs):
        low, high = usual_range(evidence(trace, trace.u[:, index]))
        middle, height = (low + high) / 2.0, (high - low) or 1.0
        lane = np.clip((trace.u[:, index] - middle) / height / 1.15, -0.5, 0.5) - index
        _draw_lane(panel, look, trace, lane, look.theme.ink)
        labels.append(f"{_short(name)}  {low:.2g} … {high:.2g}".replace("-", "\N{MINUS SIGN}"))
    _label_lanes(panel, labels)
    _name(panel, look, trace, f"inputs ({MODEL_UNIT}; right: from … to)")


def draw_heading(panel: Axes, look: Look, text: str) -> None:
    """Write an observer's name over a line across the picture."""
    panel.set_axis_off()
    panel.axhline(0.95, color=look.theme.ink, linewidth=1.0)
    panel.text(0.0, 0.3, printable(text), transform=panel.transAxes, size=9.5, weight="bold", va="center")
    panel.set_ylim(0.0, 1.0)


def _draw_lane(panel: Axes, look: Look, trace: Trace, lane: NDArray[np.float64], colour: str) -> None:
    panel.plot(*envelope(_seconds(trace, look), lane, trace.restart), color=colour, linewidth=0.6)


def _name(panel: Axes, look: Look, trace: Trace, text: str) -> None:
    words = text if look.headed else f"{trace.layout.observer} / {text}"
    panel.set_title(printable(words), loc="left", size=8, pad=2.5)


def _label_lanes(panel: Axes, labels: Sequence[str]) -> None:
    panel.yaxis.tick_right()
    panel.set_yticks([-float(lane) for lane in range(len(labels))], labels)
    panel.tick_params(axis="y", length=0)
    panel.set_ylim(0.55 - max(len(labels), 1), 0.55)


def _short(name: str, longest: int = LONGEST_NAME) -> str:
    """Return a name that cannot squeeze the panels."""
    name = printable(name)
    return name if len(name) <= longest else name[: longest - 1] + "…"


def _seconds(trace: Trace, look: Look) -> NDArray[np.float64]:
    return (trace.vehicle_ns - look.origin_ns) / 1e9


def _shade(panel: Axes, look: Look, trace: Trace) -> None:
    """Hatch a panel where no alarm could be raised: the vehicle was not in flight, or there are no samples."""
    panel.broken_barh(
        [(start_s, stop_s - start_s) for start_s, stop_s in unwatched(trace, look.origin_ns, look.end_s)],
        (0.0, 1.0),
        transform=panel.get_xaxis_transform(),
        facecolor="none",
        edgecolor=look.theme.muted,
        hatch=UNWATCHED_HATCH,
        alpha=UNWATCHED_ALPHA,
        linewidth=0,
    )


def unwatched(trace: Trace, origin_ns: int, end_s: float) -> list[tuple[float, float]]:
    """Return from when to when (s) an observer could raise no alarm, gaps between its samples among it."""
    times_s = (trace.vehicle_ns - origin_ns) / 1e9
    steps_s = np.diff(times_s)
    usual_s = float(np.median(steps_s)) if len(steps_s) else 0.0
    gap = steps_s > max(GAP_S, GAP_PERIODS * usual_s)
    goes_on = trace.armed[:-1] & trace.armed[1:] & ~gap
    first = trace.armed & ~np.append(False, goes_on)
    last = trace.armed & ~np.append(goes_on, False)
    starts_s, stops_s = np.append(0.0, times_s[last]), np.append(times_s[first], end_s)
    return [
        (float(start_s), float(stop_s))
        for start_s, stop_s in zip(starts_s, stops_s, strict=True)
        if stop_s - start_s > 1.5 * usual_s
    ]


def _shade_doubt(panel: Axes, look: Look, trace: Trace, place: int) -> None:
    """Shade standard deviations around an estimate where the channel is held responsible for something."""
    estimate = trace.isolated[:, place]
    sd = np.where(trace.armed & held(trace, estimate), trace.sd[:, place], np.nan)
    if not np.isfinite(sd).any():
        return
    low, high = estimate - DOUBT_DEVIATIONS * sd, estimate + DOUBT_DEVIATIONS * sd
    panel.fill_between(
        *band(_seconds(trace, look), low, high), color=look.theme.estimate, alpha=DOUBT_ALPHA, linewidth=0
    )


def held(trace: Trace, estimate: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return where a channel is held responsible for something, shortly before or after included: no flicker."""
    held_ns = trace.vehicle_ns[estimate != 0.0]
    if not len(held_ns):
        return np.zeros(len(estimate), np.bool_)
    after = np.searchsorted(held_ns, trace.vehicle_ns)
    since_ns = trace.vehicle_ns - held_ns[np.maximum(after - 1, 0)]
    until_ns = held_ns[np.minimum(after, len(held_ns) - 1)] - trace.vehicle_ns
    near_ns = np.minimum(np.abs(since_ns), np.abs(until_ns))
    return np.asarray(near_ns <= 1e9 * HELD_S)


def _with_doubt(limits: tuple[float, float], look: Look, trace: Trace, places: Sequence[int]) -> tuple[float, float]:
    """Return the ends of a vertical axis, widened for standard deviations around its channels' estimates."""
    low, high = limits
    room = DOUBT_ROOM * (high - low)
    for place in places:
        if (trace.layout.observer, trace.layout.faults[place]) in look.run.without_sd:
            continue
        estimate, sd = trace.isolated[:, place], DOUBT_DEVIATIONS * trace.sd[:, place]
        shown = trace.armed & (estimate != 0.0) & np.isfinite(sd)
        if shown.any():
            edges = np.percentile(estimate[shown] - sd[shown], 1.0), np.percentile(estimate[shown] + sd[shown], 99.0)
            low, high = min(low, float(edges[0])), max(high, float(edges[1]))
    return max(low, limits[0] - room), min(high, limits[1] + room)


def _mark_beyond(
    panel: Axes, look: Look, trace: Trace, estimate: NDArray[np.float64], limits: tuple[float, float]
) -> None:
    """Mark at the panel's edge where an estimate that alarms could be raised from lies beyond it."""
    times_s = _seconds(trace, look)
    for beyond, edge, marker in ((estimate < limits[0], 0.0, "v"), (estimate > limits[1], 1.0, "^")):
        times_beyond_s = times_s[trace.armed & beyond]
        width_s = look.end_s / BEYOND_MARKS or 1.0
        places_s = width_s * (np.unique(np.floor(times_beyond_s / width_s)) + 0.5)
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


def _ends_s(look: Look, span: AlarmSpan) -> tuple[float, float]:
    """Return from when to when an alarm was active; one that still is was to the end."""
    start_s = (span.start_vehicle_ns - look.origin_ns) / 1e9
    return start_s, look.end_s if span.end_vehicle_ns is None else (span.end_vehicle_ns - look.origin_ns) / 1e9


def _cover(panel: Axes, look: Look, spans: Sequence[AlarmSpan]) -> None:
    """Shade where alarms were active."""
    for span in spans:
        start_s, end_s = _ends_s(look, span)
        colour = look.theme.severity[span.severity]
        panel.axvspan(start_s, end_s, color=colour, alpha=SPAN_ALPHA[span.severity], linewidth=0)
        panel.axvline(start_s, color=colour, linewidth=1.0)


def _mark(panel: Axes, look: Look, spans: Sequence[AlarmSpan]) -> None:
    """Mark where alarms began and ended."""
    for span in spans:
        colour = look.theme.severity[span.severity]
        start_s, end_s = _ends_s(look, span)
        panel.axvline(start_s, color=colour, linewidth=1.0)
        if span.end_vehicle_ns is not None:
            panel.axvline(end_s, color=colour, linewidth=1.0, linestyle=":")


def usual_size(values: NDArray[np.float64]) -> float:
    """Return the size below which most values are, 0 where there is none."""
    return float(np.percentile(np.abs(values), LANE_PERCENT)) if len(values) else 0.0


def usual_range(values: NDArray[np.float64]) -> tuple[float, float]:
    """Return between what most values are."""
    if not len(values):
        return 0.0, 0.0
    low, high = np.percentile(values, (100.0 - LANE_PERCENT, LANE_PERCENT))
    return float(low), float(high)
