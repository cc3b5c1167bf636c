"""The picture of wear: each channel's levels over hours of flight, the line through them, and when service is due."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import numpy as np

from monitor.alarms.alarm import LOG_TIMES
from monitor.views.palette import BLUE, GREY, VERMILION
from monitor.views.plot_style import picture
from replay.wear.trend import AHEAD, Trend, Wear, hours_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# panels per line, and their height, inches: readable at the width of a page
COLUMNS = 3
PANEL_IN = 1.5
TITLE_IN = 0.6
_PARTS = 100
"""Points of a line's curved band. Chosen: one for every three pixels."""


def plot_trends(path: str | os.PathLike[str], wear: Wear) -> None:
    """Draw a panel for each channel as a PNG.

    A panel shows the levels with two standard deviations within the flight; for channels with enough flights the line
    with its 95 % band, as far as it is extrapolated; and dashed the level that raises an alarm. Channels that are named
    come first.
    """
    columns = min(COLUMNS, max(1, len(wear.trends)))
    rows = max(1, -(-len(wear.trends) // columns))
    with picture(path, rows * PANEL_IN + TITLE_IN) as figure:
        panels = list(figure.subplots(rows, columns, squeeze=False).flat)
        for panel in panels:
            panel.set_axis_off()
        for panel, trend in zip(panels, wear.trends, strict=False):
            panel.set_axis_on()
            _draw(panel, trend, (1.0 + AHEAD) * wear.hours)
        figure.suptitle(
            f"{len(wear.flights)} flights, {hours_text(wear.hours)}", size=9.5, weight="bold", x=0.01, ha="left"
        )
        figure.supxlabel("hours of flight", size=8)


def _draw(panel: Axes, trend: Trend, end: float) -> None:
    named = trend.state in ("due", "worn")
    colour = VERMILION if named else BLUE
    x, y, sd = (np.array([getattr(point, name) for point in trend.points]) for name in ("hours", "value", "sd"))
    panel.errorbar(x, y, 2.0 * sd, fmt="o", color=colour, markersize=2.5, elinewidth=0.7)
    panel.axhline(trend.limit, color=GREY, linestyle="--", linewidth=0.8)
    panel.axhline(0.0, color=GREY, linewidth=0.5)
    if trend.line is not None:
        along = np.linspace(0.0, end if named else 0.5 * end, _PARTS)
        line, error = trend.line.at(along)
        half = trend.line.quantile() * error
        panel.plot(along, line, color=colour)
        panel.fill_between(along, line - half, line + half, color=colour, alpha=0.15, linewidth=0)
    # a band that grows beyond the measured values does not affect the scale
    shown = np.concatenate([y - 2.0 * sd, y + 2.0 * sd, [0.0, trend.limit]])
    room = 0.1 * float(np.ptp(shown))
    panel.set_ylim(float(shown.min()) - room, float(shown.max()) + room)
    panel.set_xlim(0.0, end)
    unit = "log times" if trend.of.unit == LOG_TIMES else trend.of.unit
    said = {"due": ": service now", "worn": ": wears", "few": ": too few flights"}.get(trend.state, "")
    panel.set_title(f"{trend.of.observer}/{trend.of.channel}{said}", size=8, loc="left")
    panel.set_ylabel(unit)
