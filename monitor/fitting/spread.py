"""Measure the real uncertainty of fault estimates in healthy flight, where all faults are zero."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gains.plants.plant import Plant
from monitor.estimation.affine import AffineObserver
from monitor.estimation.uncertainty import Uncertainty, unmodelled_lag_s
from monitor.fitting.flights import Flight
from monitor.fitting.thresholds import healthy_runs, weighted_mean
from monitor.profile import ObserverProfile
from monitor.sampling.gate import GateRule

_WITHIN_TWO = 0.9545
"""Share of a normal distribution within two standard deviations."""
_ALIKE = ("gps_north", "gps_east")
"""Faults whose estimates have errors of one size, in their unit, whatever the design says: those of one receiver. They
are slow, and minutes of flight hold few of them: on PX4 two flights had a third less in one axis than the next one."""


class HealthyErrors(NamedTuple):
    """What healthy flight shows of the errors of each fault's estimate, by name, as a profile holds it."""

    spread: dict[str, float]
    moves: dict[str, float]


def fit_spread(observer: ObserverProfile, plant: Plant, gate: GateRule, flights: Sequence[Flight]) -> HealthyErrors:
    """Return how many times the standard deviation of the design each fault's estimate has in healthy flight.

    The estimate is within twice that deviation 95 % of the time, and moves by at most twice that times ``moves`` within
    the rows of :class:`Uncertainty` 95 % of the time. A channel without any error in these flights, as one that only a
    judgement fills, is left out, and so is a channel without a standard deviation from the design.
    """
    names = [fault.name for fault in observer.faults]
    rows_of = Uncertainty(
        AffineObserver(observer.gains),
        plant,
        names,
        lines_s=observer.periods_s,
        lag_s=unmodelled_lag_s(observer.isolation),
    ).rows
    off: dict[str, list[NDArray[np.float64]]] = {name: [] for name in names}
    moved: dict[str, list[NDArray[np.float64]]] = {name: [] for name in names}
    usual = dict.fromkeys(names, 1.0)
    for run, stretches in healthy_runs(replace(observer, model=plant), gate, flights):
        for rows in stretches:
            errors, sds = run.found.fault[rows].T, run.noise[rows].T
            for name, error, sd, back in zip(names, errors, sds, rows_of, strict=True):
                smoothed = weighted_mean(error, observer.isolation.smoothing_s, observer.rate_hz)
                usual[name] = float(np.median(sd))
                with np.errstate(all="ignore"):
                    off[name].append(np.abs(error / sd))
                    moved[name].append(np.abs(smoothed[back:] - smoothed[:-back]) / sd[back:])
    spread, moves = dict[str, float](), dict[str, float]()
    for name in names:
        alike = [other for other in (_ALIKE if name in _ALIKE else (name,)) if other in names]
        size = _deviation([usual[other] / usual[name] * part for other in alike for part in off[other]])
        if size > 0.0:
            spread[name] = float(f"{size:.3g}")
            moves[name] = float(f"{_deviation(moved[name]) / size:.3g}")
    return HealthyErrors(spread, {name: size for name, size in moves.items() if size > 0.0})


def _deviation(errors: Sequence[NDArray[np.float64]]) -> float:
    """Return half of what holds 95 % of the errors that are known, zero without any."""
    joined = np.concatenate([*errors, np.empty(0)])
    known = joined[np.isfinite(joined)]
    return float(np.quantile(known, _WITHIN_TWO)) / 2.0 if len(known) else 0.0
