"""The picture: tracking, its error, and both faults with what the monitor published of them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from closed_loop import PERIOD_S, Run
from numpy.typing import NDArray

from monitor.views.palette import DARK, LIGHT, Theme
from monitor.views.plot_style import DPI, STYLE, WIDTH_IN

if TYPE_CHECKING:
    from matplotlib.axes import Axes

HEIGHT_IN = 6.0
DASHES = (0, (4, 2))
TITLES = {
    "case1": "case 1: motor, then encoder, for 0.1 s",
    "case2": "case 2: motor 2 N m too strong, then encoder 2 rad off",
    "case3": "case 3: both at once, oscillating",
}
_ERROR_LIMITS = (1e-3, 4.0)
_WINDOW_S = 1.0


def draw(path: Path, cases: Mapping[str, Mapping[str, Run]], *, dark: bool) -> None:
    """Write the runs of some cases as a PNG, one column each."""
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    theme = DARK if dark else LIGHT
    inks = ("text.color", "axes.edgecolor", "axes.labelcolor", "xtick.color", "ytick.color")
    papers = ("figure.facecolor", "axes.facecolor", "savefig.facecolor")
    with rc_context(STYLE | dict.fromkeys(inks, theme.ink) | dict.fromkeys(papers, theme.paper)):
        figure = Figure(figsize=(WIDTH_IN, HEIGHT_IN), dpi=DPI, layout="constrained")
        FigureCanvasAgg(figure)
        rows = figure.subplots(4, len(cases), sharex="col", sharey="row", squeeze=False, height_ratios=(1.5, 1, 1, 1))
        for column, (case, runs) in enumerate(cases.items()):
            _draw_case(list(rows[:, column]), runs, theme)
            rows[0, column].set_title(TITLES[case], loc="left", fontsize=8)
        for panel, label in zip(
            rows[:, 0],
            ("link angle (rad)", "RMS error, 1 s (rad)", "motor fault (N m)", "encoder fault (rad)"),
            strict=True,
        ):
            panel.set_ylabel(label)
        figure.align_ylabels()
        marks = [mark for panel in rows[:3, 0] for mark in panel.get_legend_handles_labels()[0]]
        figure.legend(handles=marks, loc="outside lower center", ncols=4, columnspacing=1.6)
        figure.savefig(path, format="png")


def _draw_case(panels: list[Axes], runs: Mapping[str, Run], theme: Theme) -> None:
    healthy, without, integral, both = (
        runs[name] for name in ("healthy", "nothing", "integral action", "motor and encoder")
    )
    colours = {"nothing": theme.series[5], "integral": theme.series[1], "both": theme.estimate}
    tracking, error, actuator, sensor = panels
    tracking.plot(without.t, without.link, color=colours["nothing"], label="feedback alone")
    tracking.plot(integral.t, integral.link, color=colours["integral"], label="feedback with integral action")
    tracking.plot(both.t, both.link, color=colours["both"], linewidth=1.4, label="published faults taken out")
    tracking.plot(both.t, both.wanted, color=theme.ink, linestyle=DASHES, label="wanted")
    error.plot(healthy.t, _recent(healthy), color=theme.muted, label="no fault")
    error.plot(without.t, _recent(without), color=colours["nothing"])
    error.plot(integral.t, _recent(integral), color=colours["integral"])
    error.plot(both.t, _recent(both), color=colours["both"], linewidth=1.4)
    error.set_yscale("log")
    error.set_ylim(_ERROR_LIMITS)
    error.set_yticks([0.001, 0.01, 0.1, 1.0], ["0.001", "0.01", "0.1", "1"])
    error.minorticks_off()
    for panel, truth, estimate in (
        (actuator, both.actuator, both.actuator_estimate),
        (sensor, both.sensor, both.sensor_estimate),
    ):
        panel.plot(both.t, estimate, color=theme.series[2], linewidth=1.8, label="fault, as published")
        panel.plot(both.t, truth, color=theme.ink, linestyle=DASHES, label="fault, true")
    for panel in (tracking, actuator, sensor):
        panel.axhline(0.0, color=theme.muted, linewidth=0.4, zorder=0)
        panel.locator_params(axis="y", nbins=5)
    for panel in panels[:-1]:
        panel.tick_params(bottom=False)
    sensor.set_xlabel("time (s)")
    sensor.set_xlim(both.t[0], both.t[-1])


def _recent(run: Run) -> NDArray[np.float64]:
    """Return the RMS tracking error of the last second."""
    samples = round(_WINDOW_S / PERIOD_S)
    summed = np.concatenate(([0.0], np.cumsum(run.error**2)))
    first = np.maximum(np.arange(len(run.t)) + 1 - samples, 0)
    count = np.arange(1, len(run.t) + 1) - first
    return np.sqrt((summed[1:] - summed[first]) / count)
