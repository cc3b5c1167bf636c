"""What each flight by itself says of a multirotor's motors and trim, to tell which of them disagrees."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gains.identification.segment import Segment
from monitor.fitting.agreement import Agreement, ComparedEffect, FlightEffects, agreement, flight_effects
from monitor.vehicles.multirotor.identify import MultirotorFit
from monitor.vehicles.multirotor.validation import motor_effect

_MOTORS, _TRIM = 0.01, 0.02
"""Least scatter between flights of a motor's effect, and of the moment that keeps the vehicle level as a share of half
the motors' moments at hover. Measured: motors of six healthy flights of a simulated quad, in calm and in wind, squares,
sticks and hovering, scatter by 0.8 %, roll and pitch by 0.1 %, yaw by 1 to 4 %."""
_AXES = ("roll", "pitch", "yaw")


def motor_agreement(
    fit: MultirotorFit, names: Sequence[str], flights: Sequence[Sequence[Segment]], motors: Sequence[str]
) -> Agreement:
    """Compare what the motors do in each flight with what they do in the others.

    Per flight, with w of the model and weights by the errors of the axes,

        y_o(k+1) - a_o y_o(k) = sum_i theta_i B_oi w_i(k) + c_o

    gives the share theta_i of its pooled effect that motor i has; the offsets c_o are the flight's own, so that a
    payload that hangs askew is not taken for a motor.
    """
    n = len(fit.a)
    hover = np.mean(np.concatenate([motor_effect(fit, one.u) for flight in flights for one in flight]), axis=0)
    moments = 0.5 * np.abs(fit.B[:n] * hover).sum(axis=1)
    effects = [
        ComparedEffect(motor, f"{motor} pushes {{}} less", f"{motor} pushes {{}} more", _MOTORS) for motor in motors
    ]
    out = "is out of trim about {} by {{}} of its motors' moment"
    effects += [ComparedEffect(f"{axis}_trim", *2 * (out.format(axis),), _TRIM) for axis in _AXES[:n]]
    found = [_flight(fit, name, flight, moments) for name, flight in zip(names, flights, strict=True)]
    return agreement(effects, found)


def _flight(
    fit: MultirotorFit, name: str, segments: Sequence[Segment], moments: np.ndarray[tuple[int], np.dtype[np.float64]]
) -> FlightEffects | str:
    n = len(fit.a)
    regressors, target = [], []
    for segment in segments:
        w = motor_effect(fit, segment.u)
        if not len(w):
            continue
        y = segment.y[len(segment.y) - 1 - len(w) :, :n]
        offsets = np.broadcast_to(np.diag(moments), (len(w), n, n))
        regressors.append(np.concatenate([w[:, None, :] * fit.B[:n], offsets], axis=2))
        target.append(y[1:] - fit.a * y[:-1])
    if not target:
        return name
    return flight_effects(name, np.concatenate(regressors), np.concatenate(target), fit.residual_std[:n], fit.rate_hz)
