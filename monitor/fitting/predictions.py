"""Predictions of measured outputs some samples ahead, on data that a model was not fitted on, as a comparison."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gains.identification.residuals import residual_statistics
from monitor.fitting.fit_report import Comparison, liveliest

HORIZON_S = 0.2
"""Prediction horizon, seconds. Chosen: about the time in which an alarm has to be raised."""


class Prediction(NamedTuple):
    """One stretch of outputs beside their predictions: measured when predicted, then, and as predicted (N, p) each."""

    before: NDArray[np.float64]
    measured: NDArray[np.float64]
    predicted: NDArray[np.float64]


def horizon_samples(rate_hz: float) -> int:
    """Return :data:`HORIZON_S` in samples, at least two."""
    return max(2, round(HORIZON_S * rate_hz))


def explained_change(predictions: Sequence[Prediction]) -> NDArray[np.float64]:
    """Return the share of the outputs' changes over the predictions' horizon that these explain (p,)."""
    missed = np.vstack([prediction.measured - prediction.predicted for prediction in predictions])
    change = np.vstack([prediction.measured - prediction.before for prediction in predictions])
    return np.asarray(1.0 - (missed**2).mean(axis=0) / np.maximum((change**2).mean(axis=0), 1e-300))


def compared(
    names: tuple[str, ...],
    what: str,
    one_step: Sequence[Prediction],
    ahead: Sequence[Prediction],
    rate_hz: float,
    shown_s: float,
) -> Comparison:
    """Return the liveliest seconds of the longest prediction, and statistics of all of them.

    The ``names`` are those of the outputs (p,), ``what`` is predicted, for the title. ``one_step`` and ``ahead`` are
    predictions of the same stretches, one sample and :func:`horizon_samples` ahead; ``shown_s`` are drawn.
    """
    longest = max(range(len(ahead)), key=lambda i: len(ahead[i].measured))
    _, measured, predicted = ahead[longest]
    residual = (one_step[longest].measured - one_step[longest].predicted)[horizon_samples(rate_hz) - 1 :]
    shown = liveliest(measured, round(shown_s * rate_hz))
    horizon_s = horizon_samples(rate_hz) / rate_hz
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
