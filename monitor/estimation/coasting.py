"""Steps around lost measurements: by the model alone, and the first one after it.

With the recursion of :mod:`monitor.estimation.affine` the residual is yt = R_s s + R_y y + R_v v + r. An observer
coasts on the y that makes it zero: the states follow the model, an actuator fault keeps its size (with integrators of
order 2, its rate), and where a sensor fault leaves y open, because it explains all that its output does, that fault
keeps its size too.

When measurements return, y differs from what is expected by the drift of many steps. The gains would treat it as the
drift of a single step: it would throw the estimates of faults off by many times their noise, and short gaps in quick
succession would make them diverge. So the observer resumes first: the states move by initial_matrix (y - expected y),
as at a restart, while states that are not measured, and the faults, stay.

All of this is linear in z = [s; v; y; 1; g; f], f = [fa^; fs^] the estimates of the step before: substituted once, a
step of either kind is a single product, as any other.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gains.synthesis.gains_file import Gains

_NEGLIGIBLE = 1e-10
"""Singular values, relative to the largest, below which an output does not show in the residual but for rounding."""


class StepMap(NamedTuple):
    """[s+; zeta^; fa^; yt] = step z and nu = arguments z with z = [s; v; y; 1; g; f]."""

    step: NDArray[np.float64]
    arguments: NDArray[np.float64]


class CoastingMaps(NamedTuple):
    """The step without measurements, whose columns of y are zero, and the first step with them after it."""

    coast: StepMap
    resume: StepMap


def coasting_maps(gains: Gains) -> CoastingMaps:
    """Return the steps of a compiled observer while measurements are missing and when they return."""
    s, p, n, a = len(gains.inputs), len(gains.outputs), len(gains.states), len(gains.faults)
    a1 = gains.fault_kinds.count("actuator")
    M = gains.step_matrix
    ns, columns = M.shape[0] - n - a - p, M.shape[1]
    of_y = slice(ns + s, ns + s + p)
    kept = np.eye(columns, columns + a)
    others = kept.copy()
    others[of_y] = 0.0
    residual, sensors = M[-p:], M[ns + n : ns + n + a - a1]
    U, sizes, Vt = np.linalg.svd(residual[:, of_y])
    rank = int(np.sum(sizes > _NEGLIGIBLE * sizes[0]))
    y = -(Vt[:rank].T / sizes[:rank]) @ U[:, :rank].T @ residual @ others
    if rank < p:
        free = Vt[rank:].T
        missing = np.eye(columns + a)[columns + a1 :] - sensors @ others - sensors[:, of_y] @ y
        y += free @ np.linalg.pinv(sensors[:, of_y] @ free) @ missing
    expected, moved = others, kept.copy()
    expected[of_y] = y
    moved[:ns] += gains.initial_matrix[:, s : s + p] @ (kept[of_y] - y)

    def substituted(z: NDArray[np.float64]) -> StepMap:
        return StepMap(M @ z, gains.argument_matrix @ z[: ns + s + p + 1])

    return CoastingMaps(substituted(expected), substituted(moved))
