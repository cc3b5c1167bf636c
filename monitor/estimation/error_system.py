"""The error system of an affine observer: how far its estimates may be off, from the very matrices that run.

With the exact observer state S [x; f_a] = [L1 x; f_a], the error delta = s - S [x; f_a] of the recursion of
:mod:`monitor.estimation.affine` and the error phi = f^ - f of its fault estimates follow

    [delta; phi]+ = A [delta; phi] + B w,        w = [w_1; w_2; df_a; df_s] white, each as large as designed for,

with other A and B for a sample that was measured, coasted or resumed (:mod:`monitor.estimation.coasting`): disturbances
E_1 w_1 and the steps df of the faults, rate / rate_hz each, move the plant away from what the observer carries on,
noise D_1 w_2 enters with each measurement. A sensor fault may do anything while it is measured; while it is not, it is
held to move at its rate too. Nonlinearities count with their mean slopes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, solve_discrete_lyapunov

from gains.plants.plant import Plant
from gains.synthesis.gains_file import Gains
from monitor.estimation.coasting import StepMap, coasting_maps
from monitor.estimation.observer import ErrorSystem
from monitor.estimation.settling import unseen_states

_MEASURED = 0
"""Index of the system in which all outputs are measured."""
_PRIOR_S = 1.0
"""An actuator fault that was there before a restart counts as one that grew for this long at its rate, seconds. Chosen:
a longer time shows estimates after a restart as more uncertain, and for longer."""


def error_system(gains: Gains, plant: Plant) -> ErrorSystem:
    """Return the error system of one observer on a sampled plant, which may have more faults than the observer."""
    n, s, p, a = len(gains.states), len(gains.inputs), len(gains.outputs), len(gains.faults)
    nz, m, a1 = len(gains.L1), len(gains.nonlinearities), gains.fault_kinds.count("actuator")
    nd, ns = nz + len(gains.L_i), len(gains.initial_matrix)
    of_y, of_g = slice(ns + s, ns + s + p), slice(ns + s + p + 1, ns + s + p + 1 + m)
    rows = np.concatenate([np.arange(nd), ns + nz + np.arange(a1), ns + np.arange(n, nz)])
    slopes = block_diag(*(g.slopes.mean(axis=1)[None] for g in plant.nonlinearities))
    disturbed, noisy, moving = _inputs(gains, plant)
    A, Q = np.zeros((2, 3, nd + a, nd + a))
    for kind, chosen in enumerate((_measured(gains), *coasting_maps(gains))):
        M = chosen.step[rows]
        if m:
            M = M + M[:, of_g] @ slopes @ chosen.arguments
        A[kind] = np.hstack([M[:, :nd], M[:, -a:]])
        B = M[:, of_y] @ noisy
        B[:nd] -= disturbed
        if kind != _MEASURED:
            B -= M[:, -a:] @ moving
        Q[kind] = B @ B.T
    start = np.zeros((nd + a, nd + a))
    wrong = gains.L1 @ (unseen_states(gains).T @ (unseen_states(gains) * plant.state_errors))
    start[:nz, :nz] = wrong @ wrong.T
    seen = gains.initial_matrix[:nd, s : s + p] @ noisy
    start[:nd, :nd] += seen @ seen.T
    of_q = np.arange(nz, nz + a1)
    start[of_q, of_q] += (_PRIOR_S * gains.rate_hz * disturbed[of_q].sum(axis=1)) ** 2
    return ErrorSystem(A, Q, solve_discrete_lyapunov(A[_MEASURED], Q[_MEASURED]), start)


def _inputs(gains: Gains, plant: Plant) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return how w = [w_1; w_2; df_a; df_s] of unit variance moves S [x; f_a], y, and the sensor faults."""
    nz, a1, p = len(gains.L1), gains.fault_kinds.count("actuator"), len(gains.outputs)
    rates = {fault.name: fault.rate for fault in plant.faults}
    steps = np.diag([rates[name] / gains.rate_hz for name in gains.faults])
    E_1 = np.array([w.scale * w.column for w in plant.disturbances]).reshape(-1, len(gains.states)).T
    D_1 = np.array([w.scale * w.column for w in plant.noises]).reshape(-1, p).T
    q1, q2, a = E_1.shape[1], D_1.shape[1], len(steps)
    disturbed, noisy, moving = (np.zeros((k, q1 + q2 + a)) for k in (nz + len(gains.L_i), p, a))
    disturbed[:nz, :q1] = gains.L1 @ E_1
    disturbed[nz : nz + a1, q1 + q2 : q1 + q2 + a1] = steps[:a1, :a1]
    noisy[:, q1 : q1 + q2] = D_1
    moving[a1:, q1 + q2 + a1 :] = steps[a1:, a1:]
    return disturbed, noisy, moving


def _measured(gains: Gains) -> StepMap:
    """Return the plain step over [s; v; y; 1; g; f], of which it does not use f."""
    a, m = len(gains.faults), len(gains.nonlinearities)
    unused = ((0, 0), (0, a))
    return StepMap(np.pad(gains.step_matrix, unused), np.pad(gains.argument_matrix, ((0, 0), (0, m + a))))
