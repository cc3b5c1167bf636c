"""The picture of a detectability sweep: delay and miss rate against size, a panel for each channel and kind."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from monitor.display import display_unit
from monitor.views.palette import BLUE, GREY, PURPLE
from monitor.views.plot_style import picture
from replay.sensitivity.detectability import Detectability, Row

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

# panels per line, and heights of delays and misses, inches: readable at the width of a page
COLUMNS = 4
DELAY_IN = 1.3
MISSED_IN = 0.45
_SECOND_LINE = 32
"""Letters that fit below a panel."""


def plot_detectability(path: str | os.PathLike[str], result: Detectability) -> None:
    """Draw a sweep.

    Each kind of fault has a row of panels, one for each channel. A panel shows the delay over the size: as a line the
    delay that half of the trials do not exceed, dashed that of 90 %; below it the share of missed trials, as bars. All
    panels of a row share their axes. The line has no point if fewer than half, or 90 %, were detected.
    """
    lines = list(_lines([_in_display_units(row) for row in result.rows]))
    columns = max((len(line) for line in lines), default=1)
    heights = [DELAY_IN, MISSED_IN] * max(len(lines), 1)
    with picture(path, 1.25 * sum(heights) + 1.0) as figure:
        grid = figure.subplots(len(heights), columns, squeeze=False, height_ratios=heights)
        for number, line in enumerate(lines):
            _draw_line(grid[2 * number], grid[2 * number + 1], line)
        for row in range(len(heights)):
            used = len(lines[row // 2]) if lines else 0
            for column in range(used, columns):
                grid[row][column].set_axis_off()
        _draw_legend(figure, result)


def _in_display_units(row: Row) -> Row:
    factor, unit = display_unit(row.unit)
    return replace(row, size=None if row.size is None else factor * row.size, unit=unit)


def _lines(rows: Sequence[Row]) -> list[list[list[Row]]]:
    """Return the panels of each line: rows of one channel and kind; a line holds one kind and unit."""
    kinds: dict[tuple[str, str], dict[str, list[Row]]] = {}
    for row in rows:
        kinds.setdefault((row.kind, row.unit), {}).setdefault(row.channel, []).append(row)
    lines = []
    for channels in kinds.values():
        panels = list(channels.values())
        lines += [panels[start : start + COLUMNS] for start in range(0, len(panels), COLUMNS)]
    return lines


def _draw_line(delays: Sequence[Axes], missed: Sequence[Axes], line: Sequence[Sequence[Row]]) -> None:
    sizes = [row.size for rows in line for row in rows if row.size is not None]
    ordered = not sizes or min(sizes) <= 0.0
    known = [delay for rows in line for row in rows for delay in (row.delay_median_s, row.delay_90_s) if delay]
    shortest, longest = min(known, default=0.1), max(known, default=1.0)
    for number, (top, bottom, rows) in enumerate(zip(delays, missed, line, strict=False)):
        places = list(range(len(rows))) if ordered else [row.size or 0.0 for row in rows]
        _draw_delays(top, places, rows)
        _draw_missed(bottom, places, rows, ordered)
        top.set_yscale("log")
        top.set_ylim(shortest / 1.5, longest * 1.5)
        _plain_numbers(top.yaxis)
        for panel in (top, bottom):
            _set_sizes(panel, places, rows, ordered)
            panel.set_xlim(*((-0.6, len(rows) - 0.4) if ordered else (min(sizes) / 1.4, max(sizes) * 1.4)))
        top.tick_params(labelbottom=False)
        top.set_title(f"{rows[0].channel}, {rows[0].kind}", size=8, loc="left")
        bottom.set_xlabel(_size_label(rows[0]))
        if number:
            top.tick_params(labelleft=False)
            bottom.tick_params(labelleft=False)
        else:
            top.set_ylabel("delay (s)")
            bottom.set_ylabel("missed")


def _draw_delays(panel: Axes, places: Sequence[float], rows: Sequence[Row]) -> None:
    nothing = float("nan")
    ninety = [nothing if row.delay_90_s is None else row.delay_90_s for row in rows]
    median = [nothing if row.delay_median_s is None else row.delay_median_s for row in rows]
    panel.plot(places, ninety, color=BLUE, linestyle="--", marker="o", markersize=3.5, markerfacecolor="white")
    panel.plot(places, median, color=BLUE, marker="o", markersize=3.0, linewidth=1.2)
    panel.grid(axis="y", color=GREY, alpha=0.25, linewidth=0.5)


def _draw_missed(panel: Axes, places: Sequence[float], rows: Sequence[Row], ordered: bool) -> None:
    shares = [100.0 * row.missed / row.trials if row.trials else 0.0 for row in rows]
    widths = [0.6 if ordered else 0.16 * place for place in places]
    panel.bar(places, shares, width=widths, color=PURPLE, linewidth=0)
    panel.set_ylim(0.0, 100.0)
    panel.set_yticks([0.0, 100.0], ["0 %", "100 %"])


def _set_sizes(panel: Axes, places: Sequence[float], rows: Sequence[Row], ordered: bool) -> None:
    if ordered:
        panel.set_xticks(list(places), ["" if row.size is None else f"{row.size:g}" for row in rows])
        return
    panel.set_xscale("log")
    _plain_numbers(panel.xaxis)


def _plain_numbers(axis: Axis) -> None:
    """Label a logarithmic axis with 1, 2, 5, 10 and so on."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def _size_label(row: Row) -> str:
    if row.size is None:
        return ""
    what = "rate" if row.kind in ("ramp", "spoof") else "size"
    label = f"{what} ({row.unit})" if row.unit else what
    return label if len(label) <= _SECOND_LINE else label.replace(" (", "\n(", 1)


def _draw_legend(figure: Figure, result: Detectability) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    before_s, after_s = result.window_s
    trials = max((row.trials for row in result.rows), default=0)
    marks: list[Any] = [
        Line2D([], [], color=BLUE, marker="o", markersize=3.0, label="half are seen within"),
        Line2D([], [], color=BLUE, linestyle="--", marker="o", markersize=3.5, mfc="white", label="90 % within"),
        Patch(color=PURPLE, linewidth=0, label=f"missed for {after_s:g} s"),
    ]
    figure.legend(
        handles=marks,
        loc="outside upper left",
        ncols=len(marks),
        alignment="left",
        title=f"{result.profile} on {result.log}: {trials} onsets each, after {before_s:g} s of healthy flight",
        title_fontproperties={"size": 9.5, "weight": "bold"},
    )
