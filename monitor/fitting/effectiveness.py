"""Calibrate the effectiveness rule of an actuator's fault estimates: noise, model error and delay."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import inf
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gains.identification.regression import coloured_inflation
from gains.plants.plant import Plant
from gains.synthesis.gains_file import Gains
from monitor.core.effectiveness import EffectivenessEstimator
from monitor.estimation.affine import AffineObserver
from monitor.estimation.effectiveness import EffectivenessRule, EffectivenessRun

_SMALLEST_DOUBT = 0.02
"""Least standard deviation of a loss that model errors cause. Chosen: minutes of healthy flight do not prove an effect
to be known better than 2 %; with the least certainty no loss below 10 % is then named."""
_MARGIN = 1.5
"""Factor on the largest healthy score. Chosen: other flights may score half as much again as those that were fitted."""
_SMALLEST_CERTAINTY = 5.0
"""Least certainty, in standard errors. A normal error exceeds five once in 1.7 million independent tests."""
_SMALLEST_NOISE = 1e-9
"""Least noise: keeps weights finite if a simulated actuator has no noise."""
_STEP_S = 2.0
"""Length of the step response, seconds. Chosen: four times the half second in which a fault may develop fully."""
_SWEEPS = 5
"""Rounds of fit and selection of quiet samples. Measured on coloured commands with noise: nothing changes after two."""
_LEAST_QUIET = 0.3
"""Least share of samples that the noise is measured on, even if the command moves all the time."""
_MISFIT_STEP_S = 2.0
"""Time between looks at the misfit, seconds. Chosen: a tenth of the time over which it is averaged."""
_OUTLIER = 3.0
"""Limit of a residual, in standard deviations: a gust tells nothing about the correlation of the noise."""


class HealthyRun(NamedTuple):
    """One healthy stretch: fault estimates, commands and effects of a full deflection, each (N,)."""

    fault: NDArray[np.float64]
    command: NDArray[np.float64]
    full: NDArray[np.float64]


def calibrate_effectiveness(runs: Sequence[HealthyRun], rate_hz: float, rule: EffectivenessRule) -> EffectivenessRule:
    """Return the rule with noise, inflation, doubts and certainty as healthy operation shows them.

    The observer had settled. The doubts are the scatter of the estimates beyond their noise, each weighted with its
    information, and at least those of the given rule, for instance the standard error of the gain; the certainty is the
    largest healthy score times ``_MARGIN``, and at least five standard errors.
    """
    noise, inflation = _noise(runs, rate_hz, rule.timing_s)
    plain = replace(rule, noise=noise, inflation=inflation, loss_doubt=0.0, offset_doubt=0.0)
    verdicts = [verdict for memory_s in rule.memories_s for verdict in _verdicts(runs, rate_hz, plain, memory_s)]
    doubtful = replace(
        plain,
        loss_doubt=max(rule.loss_doubt, _SMALLEST_DOUBT, _excess([(v.loss, v.loss_error) for v in verdicts])),
        offset_doubt=max(rule.offset_doubt, _excess([(v.offset, v.offset_error) for v in verdicts])),
    )
    verdicts = [verdict for memory_s in rule.memories_s for verdict in _verdicts(runs, rate_hz, doubtful, memory_s)]
    worst = max(float(np.nanmax(verdict.score, initial=0.0)) for verdict in verdicts)
    certainty = max(_SMALLEST_CERTAINTY, _MARGIN * worst)
    return replace(doubtful, certainty=certainty, misfit=_misfit(runs, rate_hz, doubtful))


def _misfit(runs: Sequence[HealthyRun], rate_hz: float, rule: EffectivenessRule) -> float:
    """Return the largest mean square over 20 s of the part of f^ that loss and offset do not explain, over noise^2."""
    largest, step = 1.0, round(_MISFIT_STEP_S * rate_hz)
    for run in runs:
        estimator = EffectivenessEstimator(replace(rule, misfit=1.0), rate_hz)
        for start in range(0, len(run.fault), step):
            _run(estimator, HealthyRun(*(column[start : start + step] for column in run)), rate_hz)
            largest = max(largest, estimator.misfit)
    return largest


def _run(estimator: EffectivenessEstimator, run: HealthyRun, rate_hz: float) -> EffectivenessRun:
    count = len(run.fault)
    times_ns = np.round(np.arange(count) * (1e9 / rate_hz)).astype(np.int64)
    flags = np.zeros(count, np.bool_), np.ones(count, np.bool_)
    return EffectivenessRun(*estimator.run(times_ns, *flags, *run, np.ones(count)))


def _noise(runs: Sequence[HealthyRun], rate_hz: float, timing_s: float) -> tuple[float, float]:
    """Return the noise of f^ and how many samples count as one, without what the rule accounts for otherwise.

    That is what follows command or full deflection, and what comes while the command moves too fast for its timing.
    """
    fault = np.concatenate([run.fault for run in runs])
    regressors = np.column_stack([np.concatenate(parts) for parts in zip(*(run[1:] for run in runs), strict=True)])
    slip = timing_s * np.abs(np.concatenate([np.gradient(run.command) * rate_hz for run in runs]))
    quiet = np.ones(len(fault), dtype=np.bool_)
    for _ in range(_SWEEPS):
        size = np.linalg.lstsq(regressors[quiet], fault[quiet], rcond=None)[0]
        rest = fault - regressors @ size
        noise = max(float(np.sqrt(np.mean(rest[quiet] ** 2))), _SMALLEST_NOISE)
        quiet = slip <= noise
        if quiet.mean() < _LEAST_QUIET:
            quiet = slip <= np.quantile(slip, _LEAST_QUIET)
    ends = np.cumsum([len(run.fault) for run in runs])[:-1]
    return noise, coloured_inflation(np.split(np.clip(rest, -_OUTLIER * noise, _OUTLIER * noise), ends), rate_hz)


def response_delay_s(plant: Plant, gains: Gains, fault: str) -> float:
    """Return the mean delay of an actuator fault's estimate behind the fault, seconds.

    The area between a unit step of the fault and its estimate, both discrete, noise-free; the plant is that of the
    gains.
    """
    column = next(f.column for f in plant.actuator_faults if f.name == fault)
    x = np.linalg.solve(np.eye(len(plant.A)) - plant.A, plant.c)
    count = round(_STEP_S * gains.rate_hz)
    u, y = np.zeros((count, len(gains.inputs))), np.empty((count, len(plant.C)))
    for k in range(count):
        y[k] = plant.C @ x
        x = plant.A @ x + plant.c + column
    estimate = AffineObserver([gains]).run(u, y).fault[:, gains.faults.index(fault)]
    return max(0.0, float(np.sum(1.0 - estimate)) / gains.rate_hz)


def _verdicts(
    runs: Sequence[HealthyRun], rate_hz: float, rule: EffectivenessRule, memory_s: float
) -> list[EffectivenessRun]:
    """Return loss and offset after each sample of each healthy run, with one memory alone."""
    alone = replace(rule, memories_s=(memory_s,))
    return [_run(EffectivenessEstimator(alone, rate_hz), run, rate_hz) for run in runs]


def _excess(estimates: Sequence[tuple[NDArray[np.float64], NDArray[np.float64]]]) -> float:
    """Return the scatter of estimates beyond their errors; the certain ones count most."""
    value, error = (np.concatenate(parts) for parts in zip(*estimates, strict=True))
    value, error = value[error < inf], error[error < inf]
    weight = 1.0 / error**2
    return float(np.sqrt(max(0.0, float(np.sum(weight * value**2) - len(weight)) / float(np.sum(weight)))))
