"""What the motors' model is worth on flight that it was not fitted on: body rates, predicted and measured."""

from __future__ import annotations

from collections.abc import Sequence

from adapters.errors import ModelError
from gains.identification.segment import Segment
from gains.identification.shooting import split_segments
from monitor.fitting.fit_report import Comparison
from monitor.fitting.predictions import HORIZON_S, compared, horizon_samples
from monitor.vehicles.multirotor.identify import RATE_AXES, identify_multirotor
from monitor.vehicles.multirotor.validation import predict_rates

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
    if not usable:
        return None, len(fit.taps)
    one_step, ahead = predict_rates(fit, usable, 1), predict_rates(fit, usable, horizon_samples(rate_hz))
    comparison = compared(RATE_AXES, "body rates (rad/s)", one_step, ahead, rate_hz, SHOWN_S)
    return comparison, len(fit.taps)
