"""What a plane's or a rover's model is worth on data that it was not fitted on: each output, predicted and measured."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from adapters.errors import ModelError
from gains.identification.segment import Segment
from gains.identification.shooting import split_segments
from gains.plants.plant import Plant
from monitor.fitting.fit_report import Comparison
from monitor.fitting.predictions import Prediction, compared, horizon_samples

SHOWN_S = 20.0
"""Seconds drawn: as many as show single manoeuvres over the width of a page."""


def compare_effects(
    learn: Callable[[Sequence[Segment]], tuple[Mapping[str, float], Plant]],
    segments: Callable[[Mapping[str, float]], Sequence[Sequence[Segment]]],
    rate_hz: float,
) -> Comparison | None:
    """Fit on most of the recordings and compare with the rest: the last of three or more, else the last quarter.

    Parameters
    ----------
    learn : Callable[[Sequence[Segment]], tuple[Mapping[str, float], Plant]]
        From training segments to the lags and delays of the actuators, and a discrete plant that measures all its
        states and takes its inputs so delayed.
    segments : Callable[[Mapping[str, float]], Sequence[Sequence[Segment]]]
        Healthy segments of each recording, their inputs delayed by such parameters.
    rate_hz : float
        Samples per second.

    Returns
    -------
    Comparison | None
        The liveliest seconds of the rest and statistics of all of it; None where what is left to fit on excites too
        little, or nothing long enough is left to compare with.
    """
    training, _ = split_segments(segments({}))
    try:
        parameters, plant = learn(training)
    except ModelError:
        return None
    _, rest = split_segments(segments(parameters))
    horizon = horizon_samples(rate_hz)
    usable = [segment for segment in rest if len(segment.u) > horizon + rate_hz]
    if not usable:
        return None
    one_step = [predict_ahead(plant, segment, 1) for segment in usable]
    ahead = [predict_ahead(plant, segment, horizon) for segment in usable]
    return compared(plant.outputs, "outputs", one_step, ahead, rate_hz, SHOWN_S)


def predict_ahead(plant: Plant, segment: Segment, steps: int) -> Prediction:
    """Return outputs when a prediction was made, ``steps`` samples later, and as predicted (N - steps, p) each."""
    x = segment.y[:-steps]
    for step in range(steps):
        u = segment.u[step : len(segment.u) - steps + step]
        x = x @ plant.A.T + u @ plant.B.T + plant.c
    return Prediction(segment.y[:-steps], segment.y[steps:], x)
