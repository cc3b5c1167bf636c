"""Baseline: fast adaptive unknown-input observer with a Lipschitz bound (Gao 2022), a RECONSTRUCTION.

The original text was not available. The form is rebuilt from the structure that the FAUIO paper attributes to it (its
inequalities (66), (67) and (69)) and from the general literature on fast adaptive fault estimation; only the paper's
quoted result (sqrt(mu) = 1.736 on the disturbed arm) is known.

The observer has the structure of :mod:`gains.synthesis.continuous_observer` with the law fa^' = Gamma R (yt' + sigma
yt), hence L_p = Gamma R and L_i = sigma Gamma R. With V = zeta~' P zeta~ + sigma^-1 fa~' S fa~, S = Gamma^-1, Y = P K,
the equality (L1 E_f)' P = R Cb, PN = P L1 A_z - Y Cb and xi = [zeta~, fa~, g~, w, w', fa'] the bound needs xi' M xi <=
0:

    zz: PN + PN' + eps H'H + W^2      fz: -(1/sigma) (L1 E_f)' PN     ff: -(2/sigma) (L1 E_f)' P L1 E_f + W_f^2
    zg: P L1 G      fg: -(1/sigma) (L1 E_f)' P L1 G     gg: -eps I    zw: P L1 E - Y D      zw': -P F D
    fw: -(1/sigma) (L1 E_f)' (P L1 E - Y D) - R D       fw': (1/sigma) (L1 E_f)' P F D - (1/sigma) R D
    ffa': (1/sigma) S     and -mu I for w, w' and fa'   (H: rows scaled by the Lipschitz bounds)
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from adapters.errors import InaccurateError, InfeasibleError
from gains.analysis.augment import augment
from gains.plants.plant import Plant
from gains.published.lmi import block_matrix, confirmed, lipschitz_rows, reported_bound, solve_tempered
from gains.synthesis.continuous_observer import ContinuousObserver, check_continuous, fauio_observer
from gains.synthesis.solver import gain_energy

SIGMAS = (1.0, 3.0, 10.0, 30.0, 100.0)
"""Values of sigma in Young's inequality, which the source leaves open: half a decade apart; the best is used."""


def design_gao2022(plant: Plant, sigmas: float | Sequence[float] = SIGMAS) -> ContinuousObserver:
    """Design the observer of a continuous model: the smallest bound over sigmas, weights of yt against yt', 1/s.

    ``sqrt_mu`` is the bound against [w; w'; fa'], confirmed by the norm of its gains (noise path ``"all"``).

    Errors are those of :func:`gains.published.catalogue.design_baseline`.
    """
    observers: list[ContinuousObserver] = []
    failures: list[InfeasibleError] = []
    for sigma in np.atleast_1d(np.asarray(sigmas, dtype=np.float64)).tolist():
        try:
            observers.append(_design(plant, sigma))
        except InfeasibleError as error:
            failures.append(error)
    if not observers:
        raise next((error for error in failures if isinstance(error, InaccurateError)), failures[0])
    return min(observers, key=lambda observer: observer.sqrt_mu or math.inf)


def _design(plant: Plant, sigma: float) -> ContinuousObserver:
    import cvxpy as cp

    check_continuous(plant)
    s, E, D, rows = augment(plant), plant.E, plant.D, lipschitz_rows(plant)
    (nz, n), p, a1, m = s.L1.shape, len(plant.outputs), len(plant.actuator_faults), len(plant.nonlinearities)
    if not a1:
        raise InfeasibleError(f"{plant.name}: gao2022 estimates actuator faults, and the model has none")
    if not sigma > 0.0:
        raise InfeasibleError(f"{plant.name}: gao2022 needs a positive sigma, not {sigma:g}")
    P, Y = cp.Variable((nz, nz), symmetric=True), cp.Variable((nz, p))
    R, S = cp.Variable((a1, p)), cp.Variable((a1, a1), symmetric=True)
    eps, mu = cp.Variable(nonneg=True), cp.Variable(nonneg=True)
    into, through, noise = s.L1 @ plant.E_f, s.L1 @ plant.G, s.F @ D
    H = rows @ np.eye(n, nz)
    PN = P @ (s.L1 @ s.A_z) - Y @ s.C_b
    Pw = P @ (s.L1 @ E) - Y @ D
    q = D.shape[1]
    weights = 1.0 / plant.errors
    rates = [fault.rate for fault in plant.actuator_faults]
    zero = np.zeros
    M = block_matrix(
        [
            [
                PN + PN.T + eps * (H.T @ H) + np.diag(weights[:nz] ** 2),
                -(PN.T @ into) / sigma,
                P @ through,
                Pw,
                -P @ noise,
                zero((nz, a1)),
            ],
            [
                -(2.0 / sigma) * (into.T @ P @ into) + np.diag(weights[nz:] ** 2),
                -(into.T @ P @ through) / sigma,
                -(into.T @ Pw) / sigma - R @ D,
                (into.T @ P @ noise - R @ D) / sigma,
                S @ np.diag(rates) / sigma,
            ],
            [-eps * np.eye(m), zero((m, q)), zero((m, q)), zero((m, a1))],
            [-mu * np.eye(q), zero((q, q)), zero((q, a1))],
            [-mu * np.eye(q), zero((q, a1))],
            [-mu * np.eye(a1)],
        ]
    )
    seconds = solve_tempered(
        mu,
        [M << 0, P >> 0, S >> 0, R @ s.C_b == into.T @ P],
        [gain_energy(P, Y), gain_energy(S, R)],
        plant,
        "gao2022",
        f"the Lipschitz bound is too large, or (L1 E_f)' P = R Cb cannot be met (sigma = {sigma:g})",
    )
    K = np.linalg.solve(P.value, Y.value)
    L_p = np.linalg.solve(S.value, R.value)
    observer = fauio_observer(plant, K, sigma * L_p, L_p, "gao2022")
    note = f"reconstruction; sigma = {sigma:g}"
    return confirmed(replace(observer, sqrt_mu=reported_bound(mu), solve_s=seconds, notes=(note,)))
