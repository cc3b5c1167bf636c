"""How far to trust a multirotor's model: prediction of data kept back, and drift.

In the symbols of :mod:`monitor.vehicles.multirotor.identify`, with w(k) = sum_d h_d v(k-d) the errors of one step are
e_o(k) = y_o(k+1) - a_o y_o(k) - B_o w(k) - c_o.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gains.identification.segment import Segment
from monitor.fitting.fit_report import Prediction
from monitor.vehicles.multirotor.identify import MultirotorFit

FloatArray = NDArray[np.float64]

_BLOCK_S = 5.0
"""Length of blocks whose errors are taken as independent, seconds: gusts and manoeuvres are shorter."""
_FEWEST_BLOCKS = 20
"""Fewer blocks leave a covariance of blocks without a use: its standard error exceeds a third of it."""
_SURE = 3.0
"""Standard errors from which on a drift is certain."""
_MATTERS = 0.01
"""A drift of less than a per cent over a flight is below every alarm."""


@dataclass(frozen=True, slots=True)
class Drift:
    """How the response to commands changes as a flight goes on, as with a battery that sags."""

    per_minute: float  # relative change per minute in the air, and its standard error
    error: float
    minutes: float  # longest flight

    @property
    def matters(self) -> bool:
        """Whether it is certain and more than a per cent over the flight."""
        return abs(self.per_minute) > _SURE * self.error and abs(self.per_minute) * self.minutes > _MATTERS


def predict_rates(fit: MultirotorFit, segments: Sequence[Segment], steps: int) -> list[Prediction]:
    """Return predictions of body rates ``steps`` samples ahead, from the rates then and the commands since."""
    predictions = []
    for segment in segments:
        effect = motor_effect(fit, segment.u)
        count = len(effect) - steps + 1
        if count < 1:
            continue
        drive = effect @ fit.B[:3].T + fit.c[:3]
        start = len(segment.u) - 1 - len(effect)
        before = segment.y[start : start + count, :3]
        predicted = before
        for ahead in range(steps):
            predicted = fit.a * predicted + drive[ahead : ahead + count]
        predictions.append(Prediction(before, segment.y[start + steps : start + steps + count, :3], predicted))
    return predictions


def response_drift(fit: MultirotorFit, flights: Sequence[Sequence[Segment]]) -> Drift:
    """Return how the response to commands drifts with the time in the air; each flight starts with a fresh battery.

    The effect of the commands times the minutes flown is regressed beside the effect itself; the axes are averaged,
    each weighted by how well it shows it.
    """
    minutes = []
    for flight in flights:
        flown = 0
        for segment in flight:
            count = len(motor_effect(fit, segment.u))
            minutes.append((flown + np.arange(count)) / fit.rate_hz / 60.0)
            flown += len(segment.u)
    t = np.concatenate(minutes)
    now, effect, after = _equations(fit, [segment for flight in flights for segment in flight])
    slopes, errors = np.empty(3), np.empty(3)
    for o in range(3):
        moved = effect @ fit.B[o]
        moved = moved - moved.mean()
        X = np.column_stack([moved, moved * (t - t.mean()), np.ones(len(t))])
        target = after[:, o] - fit.a[o] * now[:, o]
        theta = np.linalg.lstsq(X, target, rcond=None)[0]
        slopes[o] = theta[1]
        errors[o] = np.sqrt(_clustered(X, target - X @ theta, fit.rate_hz)[1, 1])
    weight = 1.0 / np.maximum(errors, 1e-12) ** 2
    return Drift(float(slopes @ weight / weight.sum()), float(weight.sum() ** -0.5), float(t.max()))


def motor_effect(fit: MultirotorFit, u: FloatArray) -> FloatArray:
    """Return w(k) of commands ``u`` (N, s) for k = L - 1, ..., N - 2, L the number of taps (max(0, N - L), s)."""
    v = (1.0 - fit.square) * u + fit.square * u**2
    count = max(0, len(u) - len(fit.taps))
    return np.asarray(sum(h * v[len(fit.taps) - 1 - d :][:count] for d, h in enumerate(fit.taps)))


def _equations(fit: MultirotorFit, segments: Sequence[Segment]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return y(k), w(k) and y(k+1) of all segments."""
    effects = [motor_effect(fit, segment.u) for segment in segments]
    pairs = [(segment.y[:, :3], len(effect)) for segment, effect in zip(segments, effects, strict=True)]
    now = np.vstack([y[len(y) - 1 - count : len(y) - 1] for y, count in pairs])
    after = np.vstack([y[len(y) - count :] for y, count in pairs])
    return now, np.vstack(effects), after


def _clustered(X: FloatArray, e: FloatArray, rate_hz: float) -> FloatArray:
    """Return the covariance of coefficients with regressors X and errors e, blocks of time being independent."""
    blocks = max(_FEWEST_BLOCKS, round(len(e) / (_BLOCK_S * rate_hz)))
    scores = np.stack([part.sum(axis=0) for part in np.array_split(X * e[:, None], blocks)])
    inverse = np.linalg.pinv(X.T @ X)
    return np.asarray(inverse @ (scores.T @ scores) @ inverse * blocks / (blocks - 1))
