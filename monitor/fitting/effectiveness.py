"""Calibrate how an actuator's fault estimate is read: noise, model error and delay, from healthy operation."""

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
from monitor.estimation.effectiveness import Effectiveness, EffectivenessEstimator, EffectivenessRule
from monitor.estimation.observer import Observer

_SMALLEST_DOUBT = 0.02
_SMALLEST_CERTAINTY = 5.0
_SMALLEST_NOISE = 1e-9
_STEP_S = 2.0
_SWEEPS = 5
_LEAST_QUIET = 0.3
_OUTLIER = 3.0


class HealthyRun(NamedTuple):
    """One healthy stretch: fault estimates, commands and effects of a full deflection, each (N,)."""

    fault: NDArray[np.float64]
    command: NDArray[np.float64]
    full: NDArray[np.float64]


def calibrate_effectiveness(
    runs: Sequence[HealthyRun], rate_hz: float, rule: EffectivenessRule, margin: float = 1.5
) -> EffectivenessRule:
    """Return the rule with noise, inflation, doubts and certainty as healthy operation shows them.

    The doubts are what the estimates scatter more than their noise allows, each weighted with its information; the
    certainty is the largest healthy score with a margin, and at least five standard errors.

    Parameters
    ----------
    runs : Sequence[HealthyRun]
        Healthy stretches, the observer settled.
    rate_hz : float
        Samples per second.
    rule : EffectivenessRule
        Gives what is not calibrated; its doubts are the least ones, for instance the standard error of the gain.
    margin : float
        Factor on the largest healthy score.
    """
    noise, inflation = _noise(runs, rate_hz, rule.timing_s)
    plain = replace(rule, noise=noise, inflation=inflation, loss_doubt=0.0, offset_doubt=0.0)
    said = [verdict for memory_s in rule.memories_s for verdict in _said(runs, rate_hz, plain, memory_s)]
    doubtful = replace(
        plain,
        loss_doubt=max(rule.loss_doubt, _SMALLEST_DOUBT, _excess([(s.loss, s.loss_error) for s in said])),
        offset_doubt=max(rule.offset_doubt, _excess([(s.offset, s.offset_error) for s in said])),
    )
    worst = max(v.score for memory_s in rule.memories_s for v in _said(runs, rate_hz, doubtful, memory_s))
    return replace(doubtful, certainty=max(_SMALLEST_CERTAINTY, margin * worst))


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

    The area between a unit step of the fault and its estimate, both discrete, noise-free.

    Parameters
    ----------
    plant : Plant
        Discrete plant of the gains.
    gains : Gains
        Its compiled gains.
    fault : str
        Name of an actuator fault.
    """
    observer, place = Observer(gains), gains.faults.index(fault)
    column = next(f.column for f in plant.actuator_faults if f.name == fault)
    u, x = np.zeros(len(gains.inputs)), np.linalg.solve(np.eye(len(plant.A)) - plant.A, plant.c)
    observer.restart(u, plant.C @ x)
    area = 0.0
    for _ in range(round(_STEP_S * gains.rate_hz)):
        observer.step(u, plant.C @ x)
        area += 1.0 - float(observer.fault[place])
        x = plant.A @ x + plant.c + column
    return max(0.0, area / gains.rate_hz)


def _said(runs: Sequence[HealthyRun], rate_hz: float, rule: EffectivenessRule, memory_s: float) -> list[Effectiveness]:
    alone = replace(rule, memories_s=(memory_s,))
    said = []
    for run in runs:
        estimator = EffectivenessEstimator(alone, rate_hz)
        for fault, command, full in zip(*(column.tolist() for column in run), strict=True):
            said.append(estimator.update(fault, command, full))
    return said


def _excess(estimates: Sequence[tuple[float, float]]) -> float:
    """Return the scatter of estimates beyond their errors, the certain ones counting most."""
    value, error = np.array([pair for pair in estimates if pair[1] < inf]).T
    weight = 1.0 / error**2
    return float(np.sqrt(max(0.0, float(np.sum(weight * value**2) - len(weight)) / float(np.sum(weight)))))
