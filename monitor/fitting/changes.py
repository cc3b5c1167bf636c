"""Fit the noise of the innovations to healthy flights, and the nats from which a sudden change raises an alarm."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gains.plants.plant import Plant
from monitor.estimation.changes import CLIP, ChangeRule, ChangeStage
from monitor.fitting.excitation import excited_variance
from monitor.fitting.extremes import ReturnLevel, return_level
from monitor.fitting.flights import Flight
from monitor.profile import FaultChannel

_ORDER = 12
"""Order of the autoregression. Theory 5.1 (1): of order twelve, it whitens residuals whose correlation is .87 to
.98."""
_ROWS_A_COEFFICIENT = 20
"""Rows for each coefficient of the regression. The standard error falls with the root of the rows: 20 leave a quarter
of the noise on a coefficient."""
_LEAST_NATS = 0.9 * CLIP**2
"""A row counts CLIP^2 / 2 nats at most: an alarm takes two of them, less the tenth that noise takes, or one damaged
value would raise it. Measured on 35 flights of three simulators, 13 of them outside of the fits: what two rows and less
say for a fault of motors, GPS or barometer that is worth an alarm is 126 nats at most."""


def fit_changes(
    plant: Plant,
    rate_hz: float,
    outputs: Sequence[str],
    flights: Sequence[Flight],
    lasts_s: Mapping[str, float] | None = None,
    lags_s: Mapping[str, float] | None = None,
) -> ChangeRule | None:
    """Return whitening and variance of the innovations of some outputs, fitted to what counts as healthy evidence.

    With ``lasts_s``, sensors' faults to name and how long their jumps take, or ``lags_s``, those of actuators that may
    be off and their lags, each output is whitened by its own past alone. None where the flights are too short.
    """
    p, times = len(outputs), (dict(lasts_s or {}), dict(lags_s or {}))
    named = times[0] | times[1]
    start = ChangeRule(tuple(outputs), np.zeros((_ORDER, p, p)), np.tile([1.0, 0.0, 0.0, 0.0], (p, 1)), *times)
    stretches = []
    for flight in flights:
        nu, excited, known = ChangeStage(plant, rate_hz, dict.fromkeys(named), start).innovations(flight.samples)
        rows = np.flatnonzero(known & flight.armed)
        parts = np.split(rows, np.flatnonzero(np.diff(rows) != 1) + 1)
        stretches += [(nu[part], excited[part]) for part in parts if len(part) > 2 * _ORDER]
    if sum(len(nu) for nu, _ in stretches) < _ROWS_A_COEFFICIENT * _ORDER * p * (1 if named else p):
        return None
    if named:
        whitening = np.zeros((_ORDER, p, p))
        for i in range(p):
            whitening[:, i, i] = _autoregression([nu[:, [i]] for nu, _ in stretches])[:, 0, 0]
    else:
        whitening = _autoregression([nu for nu, _ in stretches])
    e = np.vstack([_whitened(nu, whitening) for nu, _ in stretches])
    excited = np.vstack([causes[_ORDER:] for _, causes in stretches])
    # what sensors' models lack is no product of their outputs
    turning = np.zeros(len(e)) if named else (excited[:, :p] ** 2).sum(axis=1)
    causes = (np.column_stack([excited[:, [i, p + i]], turning]) for i in range(p))
    variance = np.array([excited_variance(e[:, [i]], of_axis) for i, of_axis in enumerate(causes)])
    return ChangeRule(tuple(outputs), _rounded(whitening), _rounded(variance), *times)


def healthy_nats(
    plant: Plant,
    rate_hz: float,
    faults: Sequence[FaultChannel],
    rule: ChangeRule,
    flights: Sequence[Flight],
    alarms_per_hour: float,
) -> ReturnLevel:
    """Return the nats that a change named in healthy flight exceeds at a rate of false alarms, whichever it names."""
    series = []
    inputs = {channel.name: channel.input for channel in faults}
    for flight in flights:
        stage = ChangeStage(plant, rate_hz, inputs, rule)
        run = stage.run(flight.samples, flight.armed, np.zeros((len(flight), len(inputs))))
        series += [run.nats[rows] for rows in flight.stretches(at_restart=False)]
    level = return_level(series, rate_hz, alarms_per_hour)
    return replace(level, level=float(f"{max(_LEAST_NATS, level.level):.4g}"))


def _autoregression(stretches: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return Phi (P, p, p) of nu(k) = sum_i Phi_i nu(k - i) + e(k), by least squares."""
    past = np.vstack(
        [np.hstack([nu[_ORDER - 1 - lag : len(nu) - 1 - lag] for lag in range(_ORDER)]) for nu in stretches]
    )
    now = np.vstack([nu[_ORDER:] for nu in stretches])
    stacked = np.linalg.lstsq(past, now, rcond=None)[0]
    return np.ascontiguousarray(stacked.reshape(_ORDER, -1, stacked.shape[1]).transpose(0, 2, 1), np.float64)


def _whitened(nu: NDArray[np.float64], whitening: NDArray[np.float64]) -> NDArray[np.float64]:
    e = nu[_ORDER:].copy()
    for lag, phi in enumerate(whitening):
        e -= nu[_ORDER - 1 - lag : len(nu) - 1 - lag] @ phi.T
    return e


def _rounded(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return values rounded to six digits, as the profile stores them."""
    return np.array([float(f"{value:.6g}") for value in values.ravel()]).reshape(values.shape)
