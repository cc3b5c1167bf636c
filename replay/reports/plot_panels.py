"""Charts of a run drawn by Matplotlib, panel by panel: alarms, a fault channel, lanes of series."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from adapters.errors import printable
from monitor.fitting.fit_report import MODEL_UNIT
from monitor.trace import AlarmSpan
from monitor.views.palette import Theme
from replay.reports.charts import USUAL_PERCENT, Chart

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Chosen by eye.
TRUTH_DASHES = (0, (4, 2))
BAND_ALPHA = 0.22
DOUBT_ALPHA = 0.3
# the two differ in lightness too, for those who see no difference in hue
SPAN_ALPHA: dict[str, float] = {"warning": 0.25, "critical": 0.42}
UNWATCHED_ALPHA = 0.6
UNWATCHED_HATCH = "//////"
# where an estimate leaves its panel, at most so many marks say so
BEYOND_MARKS = 80

# letters of a name that the margin beside a panel holds
LONGEST_NAME = 24
# as many whatever the panel's height, else the layout leaves room for other labels than are drawn
TICKS = 4

_LANES: Mapping[str, tuple[float, float, str]] = {
    "channels": (-1.3, 1.3, "quiet channels (band: ± own threshold; right: peak in % of it)"),
    "residuals": (-1.1, 1.1, f"residuals ({MODEL_UNIT}; right: {USUAL_PERCENT:g} % lie within)"),
    "inputs": (-0.075, 1.075, f"inputs ({MODEL_UNIT}; right: from … to)"),
}
"""Of a chart whose series have a lane each: what of its units a lane shows, chosen by eye, and what it is called."""


@dataclass(frozen=True, slots=True)
class Look:
    """How a picture is drawn."""

    theme: Theme
    origin_ns: int  # zero of the axis of time, vehicle's clock
    end_s: float  # its end
    prefix: str = ""  # what the panels' titles begin with


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
    """Return observer and channel of all alarms, in the order of their first."""
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
    """Draw the series of a chart one below the other, with what each one's lane shows, and where alarms were.

    Those among ``covered`` are shaded and named.
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
    """Write over a panel what it shows."""
    panel.set_title(printable(look.prefix + text), loc="left", size=8, pad=2.5)


def _cover(panel: Axes, look: Look, areas: Sequence[Mapping[str, Any]]) -> None:
    """Shade where alarms were active; one that still is was to the end."""
    for area in areas:
        colour, end_s = look.theme.severity[area["severity"]], area["to"]
        end_s = look.end_s if end_s is None else end_s
        panel.axvspan(area["from"], end_s, color=colour, alpha=SPAN_ALPHA[area["severity"]], linewidth=0)
        panel.axvline(area["from"], color=colour, linewidth=1.0)


def _numbers(series: Mapping[str, Any]) -> NDArray[np.float64]:
    """Return a series of a chart, NaN where there is nothing."""
    return np.array(series["y"], np.float64)


def _label_lanes(panel: Axes, labels: Sequence[str]) -> None:
    panel.yaxis.tick_right()
    panel.set_yticks([-float(lane) for lane in range(len(labels))], labels)
    panel.tick_params(axis="y", length=0)
    panel.set_ylim(0.55 - max(len(labels), 1), 0.55)


def _short(name: str, longest: int = LONGEST_NAME) -> str:
    """Return a name that cannot squeeze the panels."""
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
    """Mark at the panel's edge where an estimate that alarms could be raised from lies beyond it."""
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
