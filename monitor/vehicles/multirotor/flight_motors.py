"""What each flight by itself says of a multirotor's trim and thrust, to tell which of them disagrees.

Which motor is weak shows in the mean of what the model leaves over, not in the answer to single commands: that is a
regression on commands, and where they come slowly or the flight was calm it shrinks the effect of every motor. On
recordings at 10 Hz two healthy minutes of hover had 37 % of the effects of brisk flights; their trim agrees within
.1 %.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gains.identification.segment import Segment
from monitor.fitting.agreement import Agreement, Cause, ComparedEffect, FlightEffects, agreement, flight_effects
from monitor.vehicles.multirotor.identify import MultirotorFit
from monitor.vehicles.multirotor.validation import motor_effect

FloatArray = NDArray[np.float64]

_TRIM, _THRUST, _CHANGE = 0.02, 0.03, 0.03
"""Usual scatter between flights: of the moment that keeps the vehicle level, as a share of half the motors' moments;
of the thrust that is commanded, and of its change from begin to end. The first is chosen: 2 mm of a battery's place on
arms of 20 cm. The others are measured: healthy flights of three simulated vehicles scatter by .6 to 7 % (in 5 m/s of
wind), and by 1 to 4 %."""
_AXES = ("roll", "pitch", "yaw")


def motor_agreement(
    fit: MultirotorFit, names: Sequence[str], flights: Sequence[Sequence[Segment]], motors: Sequence[str]
) -> Agreement:
    """Compare the trim and the commanded thrust of each flight with those of the others.

    Per flight, with w of the model, h its mean over all flights, s motors, and t from -1/2 to 1/2 in the flight,

        y_o(k+1) - a_o y_o(k) - B_o w(k) - c_o = theta_o sum_i |B_oi h_i| / 2 + error
        sum_i w_i(k) / sum_i h_i - 1           = theta_thrust + theta_change t + error.

    A motor that gives a share less moves theta_o by what it gave: by that it is named. A payload, a battery that sags
    or propellers that are all worn move the thrust.
    """
    n = len(fit.a)
    effects = [motor_effect(fit, segment.u) for flight in flights for segment in flight]
    hover = np.mean(np.concatenate(effects), axis=0)
    moments = 0.5 * np.abs(fit.B[:n] * hover).sum(axis=1)
    out, more = "is out of trim about {} by {{}} of its motors' moment", "commands {{}} {} thrust{}"
    end = " at its end than at its begin"
    compared = [ComparedEffect(f"{axis}_trim", *2 * (out.format(axis),), _TRIM) for axis in _AXES[:n]]
    compared.append(ComparedEffect("thrust", more.format("less", ""), more.format("more", ""), _THRUST))
    compared.append(ComparedEffect("change", more.format("less", end), more.format("more", end), _CHANGE))
    causes = [
        Cause(f"{motor} pushes {{}} less", np.append(-fit.B[:n, i] * hover[i] / moments, [0.0, 0.0]))
        for i, motor in enumerate(motors)
    ]
    said = [_flight(fit, name, flight, hover, moments) for name, flight in zip(names, flights, strict=True)]
    return agreement(compared, said, causes)


def _flight(
    fit: MultirotorFit, name: str, segments: Sequence[Segment], hover: FloatArray, moments: FloatArray
) -> FlightEffects | str:
    n = len(fit.a)
    rows = []
    for segment in segments:
        w = motor_effect(fit, segment.u)
        y = segment.y[len(segment.y) - 1 - len(w) :, :n]
        rest = (y[1:] - fit.a * y[:-1] - w @ fit.B[:n].T - fit.c[:n]) / moments
        rows.append(np.column_stack([rest, w.sum(axis=1) / hover.sum() - 1.0]))
    target = np.concatenate([np.empty((0, n + 1)), *rows])
    regressors = np.zeros((len(target), n + 1, n + 2))
    regressors[:, range(n + 1), range(n + 1)] = 1.0
    regressors[:, n, n + 1] = np.linspace(-0.5, 0.5, len(target))
    return flight_effects(name, regressors, target, np.ones(n + 1), fit.rate_hz)
