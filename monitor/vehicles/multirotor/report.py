"""What the motors' model is worth on flight that it was not fitted on: body rates, predicted and measured."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from adapters.errors import ModelError
from gains.identification.residuals import residual_statistics
from gains.identification.segment import Segment
from gains.identification.shooting import split_segments
from monitor.fitting.fit_report import Comparison, liveliest
from monitor.vehicles.multirotor.identify import RATE_AXES, MultirotorFit, identify_multirotor
from monitor.vehicles.multirotor.validation import explained_change, predict_rates

HORIZON_S = 0.2
"""Prediction horizon, seconds: about the time in which an alarm has to be raised."""
SHOWN_S = 10.0
"""Seconds drawn: as many as show single manoeuvres over the width of a page."""


def compare_kept_back(flights: Sequence[Sequence[Segment]], rate_hz: float) -> tuple[Comparison | None, int | None]:
    """Fit on most of the recordings and compare with the rest: the last of three or more, else the last quarter.

    Returns
    -------
    comparison : Comparison | None
        The liveliest seconds of the rest and statistics of all of it; None where what is left to fit on is too short
        or excites too little, or nothing long enough is left to compare with.
    taps : int | None
        Number of taps of the model's lag that was found, None without a fit.
    """
    training, rest = split_segments(flights)
    try:
        fit = identify_multirotor(training, rate_hz)
    except ModelError:
        return None, None
    usable = [segment for segment in rest if len(segment.u) > (HORIZON_S + 1.0) * rate_hz + len(fit.taps)]
    return (_compared(fit, usable) if usable else None), len(fit.taps)


def _compared(fit: MultirotorFit, segments: Sequence[Segment]) -> Comparison:
    horizon = max(2, round(HORIZON_S * fit.rate_hz))
    one, several = predict_rates(fit, segments, 1), predict_rates(fit, segments, horizon)
    longest = max(range(len(several)), key=lambda i: len(several[i].measured))
    measured, predicted = several[longest].measured, several[longest].predicted
    residual = (one[longest].measured - one[longest].predicted)[horizon - 1 :]
    shown = liveliest(measured, round(SHOWN_S * fit.rate_hz))
    horizon_s = horizon / fit.rate_hz
    return Comparison(
        names=RATE_AXES,
        units=("rad/s",) * len(RATE_AXES),
        times=np.arange(len(measured))[shown] / fit.rate_hz,
        measured=measured[shown],
        predicted=predicted[shown],
        residuals=residual[shown],
        explained={"one step ahead": explained_change(one), f"{horizon_s:g} s ahead": explained_change(several)},
        statistics=residual_statistics(RATE_AXES, [found.measured - found.predicted for found in one]),
        about=f"body rates (rad/s) predicted {horizon_s:g} s ahead, data kept back; residual one step ahead",
    )
