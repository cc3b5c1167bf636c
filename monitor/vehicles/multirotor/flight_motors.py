"""Compares the trim and thrust of each flight of a multirotor with the others, to find one with a weak motor.

A weak motor shows in the mean of the model's residual, not in the response to single commands: that is a regression on
commands, and where these come slowly or the flight was calm it underestimates the effect of every motor. On recordings
at 10 Hz two healthy minutes of hover had 37 % of the effects of agile flights, while their trim agrees within 0.1 %.
"""

from collections.abc import Sequence

import numpy as np

from gains.identification.segment import Segment
from gains.plants.plant import FloatArray
from monitor.fitting.agreement import (
    Agreement,
    Cause,
    ComparedEffect,
    FlightEffects,
    agreement,
    flight_effects,
    with_parts,
)
from monitor.vehicles.multirotor.identify import MultirotorFit

_TRIM, _THRUST, _CHANGE = 0.02, 0.03, 0.03
"""Usual scatter between flights: of the moment that keeps the vehicle level, as a share of half the motors' moments; of
the commanded thrust; and of its change from begin to end. The first is chosen: 2 mm of a battery's position on arms
of 20 cm. The others are measured: healthy flights of three simulated vehicles scatter by .6 to 7 % (in 5 m/s of
wind), and by 1 to 4 %."""
_PART_S = 25.0
"""Length of parts, seconds. Chosen: a fault that lasts twice as long fills one part; shorter parts have fewer than the
six blocks that a covariance of three trims needs."""
AXES = ("roll", "pitch", "yaw")


def motor_agreement(
    fit: MultirotorFit, names: Sequence[str], flights: Sequence[Sequence[Segment]], motors: Sequence[str]
) -> Agreement:
    """Compare the trim and the commanded thrust of each flight with those of the others.

    Per flight, with w of the model and r of its bends, h the mean of w over all flights, s motors, and t from -1/2 to
    1/2 in the flight,

        y_o(k+1) - a_o y_o(k) - B_o w(k) - r_o(k) - c_o = theta_o sum_i |B_oi h_i| / 2 + error
        sum_i w_i(k) / sum_i h_i - 1           = theta_thrust + theta_change t + error.

    A weak motor changes each theta_o by the share of the moment that it lacks, which names it. A payload, a sagging
    battery or propellers that are all worn change the thrust.
    """
    n = len(fit.a)
    effects = [fit.effect(segment.u) for flight in flights for segment in flight]
    hover = np.mean(np.concatenate(effects), axis=0)
    moments = 0.5 * np.abs(fit.B[:n] * hover).sum(axis=1)
    out, more = "is out of trim about {} by {{}} of its motors' moment", "commands {{}} {} thrust{}"
    end = " at its end than at its begin"
    compared = [ComparedEffect(f"{axis}_trim", *2 * (out.format(axis),), _TRIM) for axis in AXES[:n]]
    compared.append(ComparedEffect("thrust", more.format("less", ""), more.format("more", ""), _THRUST))
    compared.append(ComparedEffect("change", more.format("less", end), more.format("more", end), _CHANGE))
    causes = [
        Cause(f"{motor} pushes {{}} less", np.append(-fit.B[:n, i] * hover[i] / moments, [0.0, 0.0]))
        for i, motor in enumerate(motors)
    ]
    rests = [_rest(fit, flight, hover, moments) for flight in flights]
    said = [_effects(name, rest, fit.rate_hz) for name, rest in zip(names, rests, strict=True)]
    whole = agreement(compared, said, causes)
    trims = [Cause(cause.text, cause.direction[:n]) for cause in causes]
    return with_parts(whole, said, _parts(names, rests, fit.rate_hz), trims)


def _rest(fit: MultirotorFit, segments: Sequence[Segment], hover: FloatArray, moments: FloatArray) -> FloatArray:
    """Return the model's residual about each axis, and the thrust beyond the usual one (N, n + 1), as shares."""
    n = len(fit.a)
    rows = []
    for segment in segments:
        w = fit.effect(segment.u)
        y = segment.y[len(segment.y) - 1 - len(w) :, :n]
        rest = (y[1:] - fit.a * y[:-1] - fit.drive(segment.u)[:, :n] - fit.c[:n]) / moments
        rows.append(np.column_stack([rest, w.sum(axis=1) / hover.sum() - 1.0]))
    return np.concatenate([np.empty((0, n + 1)), *rows])


def _effects(name: str, rest: FloatArray, rate_hz: float) -> FlightEffects | str:
    m = rest.shape[1]
    regressors = np.zeros((len(rest), m, m + 1))
    regressors[:, range(m), range(m)] = 1.0
    regressors[:, m - 1, m] = np.linspace(-0.5, 0.5, len(rest))
    return flight_effects(name, regressors, rest, np.ones(m), rate_hz)


def _parts(names: Sequence[str], rests: Sequence[FloatArray], rate_hz: float) -> list[FlightEffects]:
    """Return the trims of each flight's parts: the thrust changes from part to part with the manoeuvres."""
    parts: list[FlightEffects] = []
    for name, rest in zip(names, rests, strict=True):
        for part in np.array_split(rest[:, :-1], max(1, int(len(rest) / rate_hz / _PART_S))):
            regressors = np.broadcast_to(np.eye(part.shape[1]), (len(part), part.shape[1], part.shape[1]))
            said = flight_effects(name, regressors, part, np.ones(part.shape[1]), rate_hz)
            parts += [said] if isinstance(said, FlightEffects) else []
    return parts
