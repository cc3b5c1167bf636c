"""Baseline: nonlinear unknown-input observer with a Lipschitz bound (Chen and Saif 2006), a RECONSTRUCTION.

The original text (Chen, Saif, American Control Conference 2006) was not available. The form is rebuilt from the
structure that the FAUIO paper attributes to it (its inequality (14)) and from the general literature; the paper only
says that it is infeasible on the arm.

A sensor fault joins the state, zeta = [x; f_s], with its rate as an unknown input: Dd = [E_f 0; 0 I]. With
Ad = [A 0; 0 0], U = -Dd (Cb Dd)^+, V = I - (Cb Dd)(Cb Dd)^+, Yb = P Y, Kb = P K and gamma the Lipschitz constant of
x -> G g(H x), the inequality

    [ Psi + Psi' + gamma I    sqrt(gamma) (P (I + U Cb) + Yb V Cb) ]
    [ *                       -I                                   ]  < 0     Psi = P (I + U Cb) Ad + Yb V Cb Ad - Kb Cb

gives z' = N z + L y + M (B v + c + G g(x^)), zeta^ = z - E_o y with E_o = U + Y V, M = I + E_o Cb, N = M Ad - K Cb and
L = K (I + Cb E_o) - M Ad E_o. It needs rank(Cb Dd) = rank(Dd), and has neither disturbance nor noise, hence no bound
mu.

The form estimates no f_a. Added here: f_a is solved from the output equation through a first-order filter,
fa^' = ((Cb Dd)_a^+ (y' - C (A x^ + B v + c + G g)) - fa^) / tau, integrated once so that y is never differentiated.
"""

import math

import numpy as np

from adapters.errors import InfeasibleError
from gains.plants.plant import FloatArray, Plant, check_independence, first_dependent
from gains.published.lmi import block_matrix, confirmed, lipschitz_constant, solve_lmi
from gains.synthesis.continuous_observer import ContinuousObserver, check_continuous
from gains.synthesis.solver import gain_energy

_SMALLEST_CONSTANT = 1e-3
"""Smallest Lipschitz constant, 1/s, that a nonlinearity gets: the inequality divides by it."""
_MARGIN = 1e-6
"""Margin in place of "< 0", which no solver accepts as a constraint: ten times its tolerance."""


_FILTER_S = 0.05
"""tau, seconds. Chosen: at 100 Hz five samples, over which the noise of y is averaged."""


def design_chen2006(plant: Plant) -> ContinuousObserver:
    """Design the observer of a continuous model.

    It has no bound (``sqrt_mu`` None); its stability at every slope vertex is confirmed.

    Errors are those of :func:`gains.published.catalogue.design_baseline`.
    """
    import cvxpy as cp

    check_continuous(plant)
    check_independence(plant)
    n, p, a1 = len(plant.states), len(plant.outputs), len(plant.actuator_faults)
    nz = n + len(plant.sensor_faults)
    if not plant.faults:
        raise InfeasibleError(f"{plant.name}: chen2006 estimates faults, and the model has none")
    C_b = np.hstack([plant.C, plant.D_f])
    Ad, Dd = np.zeros((nz, nz)), np.zeros((nz, a1 + nz - n))
    Ad[:n, :n], Dd[:n, :a1], Dd[n:, a1:] = plant.A, plant.E_f, np.eye(nz - n)
    seen = C_b @ Dd
    if not seen.any(axis=0).all() or first_dependent(seen) is not None:
        raise InfeasibleError(
            f"{plant.name}: chen2006 needs every fault to show independently in the rates of the outputs "
            "(rank(Cb Dd) = rank(Dd)), and here they do not"
        )
    inverse = np.asarray(np.linalg.pinv(seen), dtype=np.float64)
    U, V = -Dd @ inverse, np.eye(p) - seen @ inverse
    constant = lipschitz_constant(plant)
    gamma = max(constant, _SMALLEST_CONSTANT)
    P = cp.Variable((nz, nz), symmetric=True)
    Yb, Kb = cp.Variable((nz, p)), cp.Variable((nz, p))
    PM = P @ (np.eye(nz) + U @ C_b) + Yb @ (V @ C_b)
    Psi = PM @ Ad - Kb @ C_b
    inequality = block_matrix([[Psi + Psi.T + gamma * np.eye(nz), math.sqrt(gamma) * PM], [-np.eye(nz)]])
    excess = cp.Variable()
    why = f"the Lipschitz constant {constant:.3g} of the nonlinearity is too large for it"
    # the smallest excess always exists, so that the solver proves an inequality infeasible instead of failing on it
    least = cp.Problem(cp.Minimize(excess), [inequality << excess * np.eye(2 * nz), P >> 0])
    seconds = solve_lmi(least, plant, "chen2006", why)
    if excess.value > -_MARGIN:
        raise InfeasibleError(f"{plant.name}: the chen2006 inequality has no solution: {why}")
    energies = [gain_energy(P, Yb), gain_energy(P, Kb)]
    tempered = cp.Problem(
        cp.Minimize(cp.trace(P) + sum(energy for energy, _ in energies)),
        [inequality << 0, P >> 0, *(holds for _, holds in energies)],
    )
    seconds += solve_lmi(tempered, plant, "chen2006", why)
    Y, K = np.linalg.solve(P.value, Yb.value), np.linalg.solve(P.value, Kb.value)
    E_o = U + Y @ V
    M = np.eye(nz) + E_o @ C_b
    N = M @ Ad - K @ C_b
    L = K @ (np.eye(p) + C_b @ E_o) - M @ Ad @ E_o
    return confirmed(_observer(plant, (N, L, M, E_o), inverse[:a1], seconds))


def _observer(
    plant: Plant, matrices: tuple[FloatArray, FloatArray, FloatArray, FloatArray], inverse: FloatArray, seconds: float
) -> ContinuousObserver:
    """Return the observer with the filtered estimate of f_a; its state is [z; r], fa^ = r + (Cb Dd)_a^+ y / tau."""
    N, L, M, E_o = matrices
    tau = _FILTER_S
    n, p, a1 = len(plant.states), len(plant.outputs), len(inverse)
    nz = len(N)
    z, r, y = np.split(np.eye(nz + a1 + p), [nz, nz + a1])
    zeta = z - E_o @ y
    fa = r + inverse @ y / tau
    yt = y - np.hstack([plant.C, plant.D_f]) @ zeta
    solved = inverse @ plant.C
    step = np.vstack([N @ z + L @ y, -(solved @ plant.A @ zeta[:n] + fa) / tau])
    return ContinuousObserver(
        plant=plant,
        method="chen2006",
        step=step,
        output=np.vstack([zeta, fa, yt]),
        into=np.vstack([M[:, :n], -solved / tau]),
        start=np.vstack([np.eye(nz, n) @ np.linalg.pinv(plant.C) + E_o, -inverse / tau]),
        solve_s=seconds,
        notes=("reconstruction; f_a comes from an added filter, and no bound is claimed",),
    )
