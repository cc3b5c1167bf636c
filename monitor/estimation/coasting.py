"""Compute an observer's steps around lost measurements: by the model alone, and the first one afterwards.

With the recursion of :mod:`monitor.estimation.affine` the residual is yt = R_s s + R_y y + R_v v + r. An observer
coasts on the y that makes it zero: the states follow the model, an actuator fault keeps its size (with integrators of
order 2, its rate). If that leaves y open, because states or a sensor fault absorb all that an output does, the faults
keep their sizes.

When measurements return, y differs from its expected value by the drift of many steps. The gains would treat it as the
drift of a single step: the estimates of faults would be off by many times their noise, and short gaps in quick
succession would make them diverge. So the observer resumes first: the states move by initial_matrix (y - expected y),
as at a restart, while states that are not measured, and the faults, stay.

All of this is linear in z = [s; v; y; 1; g; f], f = [fa^; fs^] the estimates of the step before: after one
substitution, a step of either kind is a single product, as any other.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gains.synthesis.gains_file import Gains

_WEAK = 0.01
"""Singular values, relative to the largest, below which an output hardly shows in the residual. Measured: gains with a
free left inverse have 0.002 to 1e-6 if their states absorb a measurement almost completely, all others 0.2 and more;
solving for such an output moved estimates of motors by half of full command."""


class StepMap(NamedTuple):
    """[s+; zeta^; fa^; yt] = step z and nu = arguments z with z = [s; v; y; 1; g; f]."""

    step: NDArray[np.float64]
    arguments: NDArray[np.float64]


class CoastingMaps(NamedTuple):
    """The step without measurements, whose columns of y are zero, and the first step with them after it."""

    coast: StepMap
    resume: StepMap


# A bank asks for them to run its observers, and once more for their errors.
@functools.lru_cache(maxsize=64)
def coasting_maps(gains: Gains) -> CoastingMaps:
    """Return the steps of a compiled observer while measurements are missing and when they return."""
    s, p, n, a = gains.known, len(gains.outputs), len(gains.states), len(gains.faults)
    a1 = gains.fault_kinds.count("actuator")
    M = gains.step_matrix
    ns, columns = M.shape[0] - n - a - p, M.shape[1]
    of_y = slice(ns + s, ns + s + p)
    kept = np.eye(columns, columns + a)
    others = kept.copy()
    others[of_y] = 0.0
    residual, sensors, actuators = M[-p:], M[ns + n : ns + n + a - a1], M[ns + n + a - a1 : ns + n + a]
    faults = np.vstack([actuators, sensors])
    U, sizes, Vt = np.linalg.svd(residual[:, of_y])
    rank = int(np.sum(sizes > _WEAK * sizes[0]))
    y = -(Vt[:rank].T / sizes[:rank]) @ U[:, :rank].T @ residual @ others
    if rank < p:
        free = Vt[rank:].T
        missing = np.eye(columns + a)[columns:] - faults @ others - faults[:, of_y] @ y
        y += free @ np.linalg.pinv(faults[:, of_y] @ free) @ missing
    expected, moved = others, kept.copy()
    expected[of_y] = y
    moved[:ns] += gains.initial_matrix[:, s : s + p] @ (kept[of_y] - y)

    def substituted(z: NDArray[np.float64]) -> StepMap:
        return StepMap(M @ z, gains.argument_matrix @ z[: ns + s + p + 1])

    return CoastingMaps(substituted(expected), substituted(moved))
