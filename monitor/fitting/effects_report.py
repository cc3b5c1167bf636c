"""What a plane's or a rover's model is worth on data that it was not fitted on: each output, predicted and measured."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from adapters.errors import ModelError
from gains.identification.residuals import residual_statistics
from gains.identification.segment import Segment
from gains.identification.shooting import split_segments
from gains.plants.plant import Plant
from monitor.fitting.fit_report import Comparison, liveliest

HORIZON_S = 0.2
"""Prediction horizon, seconds: about the time in which an alarm has to be raised."""
SHOWN_S = 20.0
"""Seconds drawn: as many as show single manoeuvres over the width of a page."""

EffectPair = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]


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
    horizon = max(2, round(HORIZON_S * rate_hz))
    usable = [segment for segment in rest if len(segment.u) > horizon + rate_hz]
    if not usable:
        return None
    one = [predict_ahead(plant, segment, 1) for segment in usable]
    several = [predict_ahead(plant, segment, horizon) for segment in usable]
    longest = max(range(len(several)), key=lambda i: len(several[i][1]))
    _, measured, predicted = several[longest]
    residual = (one[longest][1] - one[longest][2])[horizon - 1 :]
    shown = liveliest(measured, round(SHOWN_S * rate_hz))
    horizon_s = horizon / rate_hz
    return Comparison(
        names=plant.outputs,
        units=tuple("m/s²" if name.endswith("acceleration") else "rad/s" for name in plant.outputs),
        times=np.arange(len(measured))[shown] / rate_hz,
        measured=measured[shown],
        predicted=predicted[shown],
        residuals=residual[shown],
        explained={"one step ahead": _explained(one), f"{horizon_s:g} s ahead": _explained(several)},
        statistics=residual_statistics(plant.outputs, [now - ahead for _, now, ahead in one]),
        about=f"outputs predicted {horizon_s:g} s ahead, data kept back; residual one step ahead",
    )


def predict_ahead(plant: Plant, segment: Segment, steps: int) -> EffectPair:
    """Return outputs when a prediction was made, ``steps`` samples later, and as predicted (N - steps, p) each."""
    x = segment.y[:-steps]
    for step in range(steps):
        u = segment.u[step : len(segment.u) - steps + step]
        x = x @ plant.A.T + u @ plant.B.T + plant.c
    return segment.y[:-steps], segment.y[steps:], x


def _explained(pairs: Sequence[EffectPair]) -> NDArray[np.float64]:
    missed = np.vstack([measured - predicted for _, measured, predicted in pairs])
    change = np.vstack([measured - before for before, measured, _ in pairs])
    return np.asarray(1.0 - (missed**2).mean(axis=0) / np.maximum((change**2).mean(axis=0), 1e-300))
