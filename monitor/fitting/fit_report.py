"""The quality of a fit for any kind of vehicle: prediction against measurement, residuals, as text and as one PNG."""

from __future__ import annotations

import os
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gains.identification.excitation import ExcitationVerdict
from gains.identification.residuals import ResidualStatistics, residual_statistics
from gains.identification.segment import Segment
from monitor.views.palette import GREY, LIGHT
from monitor.views.plot_style import picture

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.gridspec import GridSpec

# Height of an output in the figure, inches.
OUTPUT_IN = 1.7
MODEL_UNIT = "model's unit"
HORIZON_S = 0.2
"""Prediction horizon, seconds. Chosen: about the time in which an alarm has to be raised."""


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """A stretch of data that was kept out of the fit, and the model's prediction of it."""

    names: tuple[str, ...]  # names of the outputs (p,)
    times: NDArray[np.float64]  # seconds (N,)
    # (N, p); NaN breaks the lines. The residuals are those of the statistics: they may be one-step errors while the
    # prediction is a simulation.
    measured: NDArray[np.float64]
    predicted: NDArray[np.float64]
    residuals: NDArray[np.float64]
    explained: dict[str, NDArray[np.float64]]  # by explanation: share explained of each output (p,)
    statistics: tuple[ResidualStatistics, ...]  # statistics of each output's residual
    about: str = "prediction against measurement, data kept back"  # kind of the comparison, for the title
    units: tuple[str, ...] = ()  # units of the outputs (p,); empty if the model does not state them


def parameter_lines(verdicts: Sequence[ExcitationVerdict]) -> list[str]:
    """Return one line for each parameter: value, standard error, and any doubt about it."""
    width = max((len(verdict.name) for verdict in verdicts), default=0)
    lines = []
    for verdict in verdicts:
        sure = "" if verdict.determined else "NOT DETERMINED: "
        note = f"  {sure}{verdict.note}" if verdict.note or sure else ""
        lines.append(f"{verdict.name:<{width}}  {verdict.value:.6g} +- {verdict.standard_error:.2g}{note}")
    return lines


def comparison_lines(comparison: Comparison) -> list[str]:
    """Return one line for each output: shares explained, and the statistics of its residual."""
    width = max(len(name) for name in comparison.names)
    lines = []
    for i, (name, statistics) in enumerate(zip(comparison.names, comparison.statistics, strict=True)):
        shares = ", ".join(f"{what} {100.0 * share[i]:.1f} %" for what, share in comparison.explained.items())
        lines.append(f"{name:<{width}}  {shares}; residual {statistics.rms:.3g} rms, {statistics.note}")
    return lines


def comparison_json(comparison: Comparison) -> dict[str, Any]:
    """Return shares explained and the residuals' statistics as a JSON object."""
    return {
        "explained": {
            what: dict(zip(comparison.names, share.tolist(), strict=True))
            for what, share in comparison.explained.items()
        },
        "residual": {
            statistics.name: {
                "rms": statistics.rms,
                "ljung_box_p": statistics.ljung_box_p,
                "skewness": statistics.skewness,
                "excess_kurtosis": statistics.excess_kurtosis,
                "autocorrelation": statistics.autocorrelation.tolist(),
                "note": statistics.note,
            }
            for statistics in comparison.statistics
        },
    }


def draw_comparison(path: str | os.PathLike[str], comparison: Comparison, title: str) -> None:
    """Draw prediction against measurement, residual and its autocorrelation, one row for each output."""
    count = len(comparison.names)
    with picture(path, OUTPUT_IN * count + 0.9) as figure:
        grid = figure.add_gridspec(2 * count, 2, width_ratios=[3.2, 1.0], height_ratios=[2.0, 1.0] * count)
        series: list[Axes] = []
        for i in range(count):
            series += _draw_series(figure, grid, comparison, i, series[0] if series else None)
            _draw_correlation(figure.add_subplot(grid[2 * i : 2 * i + 2, 1]), comparison, i)
        for panel in series[:-1]:
            panel.tick_params(labelbottom=False)
        series[-1].set_xlabel("time (s)")
        figure.align_ylabels(series)
        handles, labels = series[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper left", ncols=len(labels), title=title, alignment="left")


def _draw_series(figure: Any, grid: GridSpec, comparison: Comparison, i: int, shared: Axes | None) -> tuple[Axes, Axes]:
    upper = figure.add_subplot(grid[2 * i, 0], sharex=shared)
    lower = figure.add_subplot(grid[2 * i + 1, 0], sharex=shared or upper)
    unit = comparison.units[i] if comparison.units else MODEL_UNIT
    upper.plot(comparison.times, comparison.measured[:, i], color=LIGHT.ink, label="measured")
    upper.plot(comparison.times, comparison.predicted[:, i], color=LIGHT.estimate, label="predicted")
    upper.set_ylabel("\n".join([*textwrap.wrap(comparison.names[i].replace("_", " "), 14), f"({unit})"]))
    [line] = lower.plot(comparison.times, comparison.residuals[:, i], color=LIGHT.residual, linewidth=0.6)
    line.set_label("residual" if i == 0 else "")
    lower.axhline(0.0, color=GREY, linewidth=0.5)
    # in the same unit; the short name fits
    lower.set_ylabel(f"residual\n({unit})" if comparison.units else "residual")
    lower.locator_params(axis="y", nbins=3)
    return upper, lower


def _draw_correlation(panel: Axes, comparison: Comparison, i: int) -> None:
    statistics = comparison.statistics[i]
    lags = np.arange(1, len(statistics.autocorrelation) + 1)
    panel.axhspan(-statistics.bound, statistics.bound, color=GREY, alpha=0.3, linewidth=0)
    panel.vlines(lags, 0.0, statistics.autocorrelation, color=LIGHT.residual, linewidth=1.2)
    panel.axhline(0.0, color=GREY, linewidth=0.5)
    panel.set_ylim(-1.05, 1.05)
    panel.set_yticks([-1.0, 0.0, 1.0])
    if i == 0:
        panel.set_title("autocorrelation of the residual\n(of white noise: within grey)", fontsize=8)
    if i == len(comparison.names) - 1:
        panel.set_xlabel("lag (samples)")


def liveliest(values: NDArray[np.float64], samples: int) -> slice:
    """Return the stretch of at most ``samples`` where all columns together move most, each in units of its spread."""
    if len(values) <= samples:
        return slice(0, len(values))
    power = np.sum((values / np.maximum(values.std(axis=0), 1e-12)) ** 2, axis=1)
    start = int(np.argmax(np.convolve(power, np.ones(samples), "valid")))
    return slice(start, start + samples)


class Prediction(NamedTuple):
    """One stretch of outputs beside their predictions: measured when predicted, then, and as predicted (N, p) each."""

    before: NDArray[np.float64]
    measured: NDArray[np.float64]
    predicted: NDArray[np.float64]


LinearModel = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]
"""A, B and c of a model x+ = A x + B u + c whose outputs are its states."""


def predict_ahead(model: LinearModel, segment: Segment, steps: int) -> Prediction:
    """Return outputs at the time of the prediction, ``steps`` samples later, and as predicted (N - steps, p) each."""
    A, B, c = model
    x = segment.y[:-steps]
    for step in range(steps):
        x = x @ A.T + segment.u[step : len(x) + step] @ B.T + c
    return Prediction(segment.y[:-steps], segment.y[steps:], x)


def explained_change(predictions: Sequence[Prediction]) -> NDArray[np.float64]:
    """Return the share of the outputs' changes over the prediction horizon that the predictions explain (p,)."""
    missed = np.vstack([prediction.measured - prediction.predicted for prediction in predictions])
    change = np.vstack([prediction.measured - prediction.before for prediction in predictions])
    return np.asarray(1.0 - (missed**2).mean(axis=0) / np.maximum((change**2).mean(axis=0), 1e-300))


def compared(
    names: tuple[str, ...], what: str, model: LinearModel, segments: Sequence[Segment], rate_hz: float, shown_s: float
) -> Comparison | None:
    """Return the liveliest seconds of the longest prediction, and statistics of all of them.

    The ``names`` are those of the outputs (p,), ``what`` is what is predicted, for the title. Predictions are made over
    ``segments`` that are a second longer than the horizon, one sample and :data:`HORIZON_S` (at least two samples)
    ahead; None if there is none. ``shown_s`` are drawn.
    """
    horizon = max(2, round(HORIZON_S * rate_hz))
    usable = [segment for segment in segments if len(segment.u) > horizon + rate_hz]
    if not usable:
        return None
    one_step, ahead = ([predict_ahead(model, segment, steps) for segment in usable] for steps in (1, horizon))
    longest = max(range(len(ahead)), key=lambda i: len(ahead[i].measured))
    _, measured, predicted = ahead[longest]
    residual = (one_step[longest].measured - one_step[longest].predicted)[horizon - 1 :]
    shown = liveliest(measured, round(shown_s * rate_hz))
    horizon_s = horizon / rate_hz
    return Comparison(
        names=names,
        units=tuple("m/s²" if name.endswith("acceleration") else "rad/s" for name in names),
        times=np.arange(len(measured))[shown] / rate_hz,
        measured=measured[shown],
        predicted=predicted[shown],
        residuals=residual[shown],
        explained={"one step ahead": explained_change(one_step), f"{horizon_s:g} s ahead": explained_change(ahead)},
        statistics=residual_statistics(names, [prediction.measured - prediction.predicted for prediction in one_step]),
        about=f"{what} predicted {horizon_s:g} s ahead, data kept back; residual one step ahead",
    )
