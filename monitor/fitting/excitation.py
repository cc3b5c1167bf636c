"""Fit how the errors of an observer's estimates grow with the vehicle's motion, to healthy flights."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from monitor.estimation.excitation import ExcitationRule, ExcitationStage
from monitor.fitting.flights import Flight
from monitor.fitting.thresholds import Times, healthy_levels, healthy_runs
from monitor.profile import ObserverProfile
from monitor.sampling.gate import GateRule

_SWEEPS = 16
"""Rounds of the weighted fit of the variance. Measured on three vehicles: sixteen are within 1.1 % of forty in each
coefficient, ten within 5 %."""
_LEAST_SHARE = 0.05
"""Least variance that a weight assumes, as a share of the mean: otherwise rows at rest decide alone."""


def fit_excitation(
    observer: ObserverProfile,
    gate: GateRule,
    flights: Sequence[Flight],
    outputs: Sequence[str],
    unit: NDArray[np.float64],
    smallest: float,
    beyond: tuple[float, float],
    alarms_per_hour: float,
    times: Times,
) -> ExcitationRule:
    """Return the rule by which evidence of an observer's actuators is scaled.

    Parameters
    ----------
    observer : ObserverProfile
        The observer, without such a rule.
    gate, flights : GateRule, Sequence[Flight]
        When samples count, and the healthy flights.
    outputs : Sequence[str]
        Outputs whose size excites errors.
    unit : NDArray[np.float64]
        Size of each actuator's fault that makes them comparable: its command at hover (m,), in the order of the faults.
    smallest : float
        Smallest size worth an alarm, in these units: up to it the scale is 1.
    beyond : tuple[float, float]
        Variance per squared output and per squared change of a command beyond what the flights show, in these units.
    alarms_per_hour : float
        Rate at which all of a channel's paths may raise a false alarm; what is believed of each actuator exceeds the
        scaled smallest size as seldom.
    times : Times
        How long evidence has to last.
    """
    actuators = [place for place, channel in enumerate(observer.faults) if channel.kind != "sensor"]
    none = ExcitationRule(tuple(outputs), *(0.0,) * 7)
    error, believed, excited, levels, throttles = [], [], [], [], []
    for run, stretches in healthy_runs(observer, gate, flights):
        samples = run.estimates.samples
        stage = ExcitationStage(none, observer.gains[0].outputs, samples.u.shape[1], observer.rate_hz)
        causes = stage.run(samples, run.found.level)
        error += [run.found.smoothed[rows][:, actuators] / unit for rows in stretches]
        believed += [run.estimates.isolated[rows][:, actuators] / unit for rows in stretches]
        excited += [causes[rows, :2] for rows in stretches]
        levels += [run.found.level[rows] for rows in stretches]
        throttles += [samples.u[rows].mean(axis=1) for rows in stretches]
    c = excited_variance(np.concatenate(error), np.concatenate(excited), np.concatenate(levels))
    scaled = [
        column / np.sqrt(_regressors(causes, level) @ c)
        for sizes, causes, level in zip(believed, excited, levels, strict=True)
        for column in sizes.T
    ]
    level = healthy_levels(scaled, observer.rate_hz, alarms_per_hour, times).plain.level
    largest = np.concatenate(excited).max(axis=0)
    told = np.concatenate(throttles).max(), np.sqrt(np.concatenate(levels).max())
    numbers = [*(level / smallest) ** 2 * np.array([*c[:3], *beyond]), *largest, (level / smallest) ** 2 * c[3], *told]
    return ExcitationRule(tuple(outputs), *(float(f"{number:.4g}") for number in numbers))


def excited_variance(
    error: NDArray[np.float64], excited: NDArray[np.float64], level: NDArray[np.float64] | None = None
) -> NDArray[np.float64]:
    """Return c >= 0 of E e^2 = c_0 + c_1 r^2 + c_2 d^2 + ... (1 + n,), of errors (N, m) and causes r, d, ... (N, n).

    With a ``level`` of the residuals (N,) they are those of E e^2 = max(1, level) (c_0 + c_1 r^2 + ...) + c level
    (2 + n,). By iterated weighted least squares; use it for any error that grows with what a vehicle does.
    """
    from scipy.optimize import nnls

    square = (error**2).mean(axis=1)
    causes = _regressors(excited, level)
    weights = np.full(len(square), 1.0 / square.mean())
    for _ in range(_SWEEPS):
        c, _ = nnls(causes * weights[:, None], square * weights)
        weights = 1.0 / np.maximum(causes @ c, _LEAST_SHARE * square.mean())
    c[0] = max(c[0], _LEAST_SHARE**2 * square.mean())
    return np.asarray(c, np.float64)


def _regressors(excited: NDArray[np.float64], level: NDArray[np.float64] | None) -> NDArray[np.float64]:
    columns = np.column_stack([np.ones(len(excited)), excited**2])
    return columns if level is None else np.column_stack([columns * np.maximum(1.0, level)[:, None], level])
