"""Baseline: augmented-state unknown-input observer with a Lipschitz bound (Gao 2016), a RECONSTRUCTION.

The original text (Gao, Liu, Chen, IEEE Transactions on Industrial Electronics 63(4), 2016) was not available. The form
is rebuilt from the structure that the FAUIO paper attributes to it and from the general literature; only the paper's
quoted result (sqrt(mu) = 1.76 on the disturbed arm) is known.

The faults f = [f_a; f_s] join the state as xb = [x; f'; f], with f'' = 0 ASSUMED for both (FAUIO assumes nothing about
f_s): Ab = [A 0 Bf; 0 0 0; 0 I 0], Cb = [C 0 Df], Bf = [E_f 0], Df = [0 D_f]. The observer is

    z' = R z + T_u (B v + c + G g(x^)) + (L_1u + L_2u) y        x^ = z + H y
    T_u = I - H Cb      R = T_u Ab - L_1u Cb      L_2u = R H

with H = 0, or H = Bd (Cb Bd)^+ so that T_u Bd = 0 for the disturbances that can be decoupled. Its error obeys
x~' = R x~ + T_u G g~ + (T_u Bd - L_1u D) w - H D w', and with Q = P L_1u the bound needs

    [ S + S' + W^2 + eps Lx'Lx + 2 alpha P   P T_u G   P T_u Bd - Q D   -P H D ]
    [ *                                      -eps I    0                0      ]  <= 0     S = P T_u Ab - Q Cb
    [ *                                      *         -mu I            0      ]
    [ *                                      *         *                -mu I  ]

(Lx: rows scaled by the Lipschitz bounds; alpha is 0 in the form attributed to the original.)
"""

import numpy as np

from adapters.errors import InfeasibleError
from gains.plants.plant import FloatArray, Plant, check_independence, first_dependent
from gains.published.lmi import block_matrix, confirmed, lipschitz_rows, reported_bound, solve_tempered
from gains.synthesis.continuous_observer import ContinuousObserver, check_continuous
from gains.synthesis.solver import gain_energy


def design_gao2016(plant: Plant, decouple: bool = False, decay: float = 0.3) -> ContinuousObserver:
    """Design the observer of a continuous model, confirmed by the norm of its gains against the disturbances.

    ``sqrt_mu`` is the bound against [w; w'] for faults that do not accelerate: fa' and fs' are no disturbances in this
    form.

    ``decouple`` removes, by H, the disturbances whose directions are independent in the outputs; ``decay`` is alpha,
    1/s: with 0 the errors of the cheapest gains within the bound take hours to decay.

    Errors are those of :func:`gains.published.catalogue.design_baseline`.
    """
    import cvxpy as cp

    check_continuous(plant)
    check_independence(plant)
    D, rows = plant.D, lipschitz_rows(plant)
    n, p, m, q = len(plant.states), len(plant.outputs), len(plant.nonlinearities), D.shape[1]
    a1, a2 = len(plant.actuator_faults), len(plant.sensor_faults)
    nf = a1 + a2
    if not nf:
        raise InfeasibleError(f"{plant.name}: gao2016 estimates faults, and the model has none")
    size = n + 2 * nf
    Ab = np.zeros((size, size))
    Ab[:n, :n], Ab[:n, n + nf : n + nf + a1], Ab[n + nf :, n : n + nf] = plant.A, plant.E_f, np.eye(nf)
    Cb = np.hstack([plant.C, np.zeros((p, nf + a1)), plant.D_f])

    raised = np.eye(size, n)
    Bd, Gb = raised @ plant.E, raised @ plant.G
    H = _decoupling(Bd, Cb) if decouple else np.zeros((size, p))
    T_u = np.eye(size) - H @ Cb
    rates = [fault.rate for fault in (*plant.actuator_faults, *plant.sensor_faults)]
    x, f_s, f_a = np.split(plant.errors, [n, n + a2])
    weights = 1.0 / np.concatenate([x, rates, f_a, f_s])
    Lx = rows @ raised.T
    P, Q = cp.Variable((size, size), symmetric=True), cp.Variable((size, p))
    eps, mu = cp.Variable(nonneg=True), cp.Variable(nonneg=True)
    S = P @ (T_u @ Ab) - Q @ Cb
    zero = np.zeros
    M = block_matrix(
        [
            [
                S + S.T + np.diag(weights**2) + eps * (Lx.T @ Lx) + 2.0 * decay * P,
                P @ (T_u @ Gb),
                P @ (T_u @ Bd) - Q @ D,
                -P @ (H @ D),
            ],
            [-eps * np.eye(m), zero((m, q)), zero((m, q))],
            [-mu * np.eye(q), zero((q, q))],
            [-mu * np.eye(q)],
        ]
    )
    why = (
        "with these disturbances decoupled, some fault cannot be told from them; leave decoupling out"
        if decouple
        else "the Lipschitz bound is too large, or some fault shows in no output"
    )
    seconds = solve_tempered(mu, [M << 0, P >> 0], [gain_energy(P, Q)], plant, "gao2016", why)
    L_1u = np.linalg.solve(P.value, Q.value)
    R = T_u @ Ab - L_1u @ Cb
    order = [*range(n), *range(n + nf + a1, size), *range(n + nf, n + nf + a1)]
    output = np.vstack([np.eye(size)[order], -Cb])
    direct = output @ H + np.vstack([zero((n + nf, p)), np.eye(p)])
    observer = ContinuousObserver(
        plant=plant,
        method="gao2016",
        step=np.hstack([R, L_1u + R @ H]),
        output=np.hstack([output, direct]),
        into=T_u @ raised,
        start=raised @ np.linalg.pinv(plant.C) - H,
        sqrt_mu=reported_bound(mu),
        solve_s=seconds,
        notes=("reconstruction; the bound is against [w; w'] only and assumes f_a'' = f_s'' = 0",),
    )
    return confirmed(observer, inputs="disturbances")


def _decoupling(Bd: FloatArray, Cb: FloatArray) -> FloatArray:
    """Return H with (I - H Cb) Bd = 0 for those columns of Bd, in order, that are independent in the outputs."""
    kept: list[int] = []
    for column in range(Bd.shape[1]):
        seen = Cb @ Bd[:, [*kept, column]]
        if seen.any(axis=0).all() and first_dependent(seen) is None:
            kept.append(column)
    directions = Bd[:, kept]
    return np.asarray(directions @ np.linalg.pinv(Cb @ directions), dtype=np.float64)
