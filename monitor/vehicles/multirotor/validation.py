"""How far to trust a multirotor's model: prediction of data kept back.

In the symbols of :mod:`monitor.vehicles.multirotor.identify`, the effect of the commands is w(k) = sum_d h_d v(k-d).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gains.identification.segment import Segment
from gains.plants.plant import FloatArray
from monitor.fitting.fit_report import Prediction
from monitor.vehicles.multirotor.identify import MultirotorFit


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


def motor_effect(fit: MultirotorFit, u: FloatArray) -> FloatArray:
    """Return w(k) of commands ``u`` (N, s) for k = L - 1, ..., N - 2, L the number of taps (max(0, N - L), s)."""
    v = (1.0 - fit.square) * u + fit.square * u**2
    count = max(0, len(u) - len(fit.taps))
    return np.asarray(sum(h * v[len(fit.taps) - 1 - d :][:count] for d, h in enumerate(fit.taps)))
