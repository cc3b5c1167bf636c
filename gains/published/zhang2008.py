"""Baseline: fast adaptive estimation of actuator faults (Zhang, Jiang, Cocquempot 2008), a RECONSTRUCTION.

The original text was not available. The form is rebuilt from the structure that the FAUIO paper attributes to it and
from the general literature; the paper quotes no number for it.

    x^' = A x^ + B v + c + G g(x^) + E_f fa^ - L e_y        e_y = C x^ - y
    fa^' = -Gamma F_z (e_y' + sigma e_y)

With P > 0, G_z > 0, Y = P L and the equality E_f' P = F_z C the inequality is, at every slope vertex (an extension: A
stands for A + G Delta H there),

    [ P A + A'P - Y C - C'Y' + 2 alpha P    -(1/sigma) (A'P E_f - C'Y'E_f)                    ]
    [ *                                     -(2/sigma) E_f'P E_f + (1/(sigma mu_z)) G_z       ]  < 0

It has no sensor faults, no disturbance and no noise, and bounds no H-infinity norm. Gamma, free in the form, is the
learning rate times (E_f' P E_f)^-1: f_a~ then decays at about that rate.
"""

import numpy as np

from adapters.errors import InfeasibleError
from gains.analysis.augment import slope_matrix, slope_vertices
from gains.plants.plant import Plant
from gains.published.lmi import block_matrix, confirmed, solve_lmi
from gains.synthesis.continuous_observer import ContinuousObserver, check_continuous
from gains.synthesis.solver import gain_energy

_SIGMA = 1.0
"""Weight of e_y against e_y', 1/s, which the source leaves open."""
_MU_Z = 1.0
"""Weight of G_z in the form: G_z is free, so that any positive weight gives the same result."""
_LEARNING_RATE = 10.0
"""Rate at which the fault estimate follows the fault, 1/s."""
_DECAY = 0.5
"""alpha, 1/s; it is 0 in the form attributed to the original."""


def design_zhang2008(plant: Plant) -> ContinuousObserver:
    """Design the observer of a continuous model with actuator faults only.

    It has no bound (``sqrt_mu`` None); its stability at every slope vertex is confirmed.

    Errors are those of :func:`gains.published.catalogue.design_baseline`.
    """
    import cvxpy as cp

    check_continuous(plant)
    if plant.sensor_faults:
        raise InfeasibleError(
            f"{plant.name}: zhang2008 estimates actuator faults only, and '{plant.sensor_faults[0].name}' is a sensor "
            "fault"
        )
    n, p, a1 = len(plant.states), len(plant.outputs), len(plant.actuator_faults)
    if not a1:
        raise InfeasibleError(f"{plant.name}: zhang2008 estimates actuator faults, and the model has none")
    C, E = plant.C, plant.E_f
    P, Y, F_z = cp.Variable((n, n), symmetric=True), cp.Variable((n, p)), cp.Variable((a1, p))
    G_z = cp.Variable((a1, a1), symmetric=True)
    energy, energetic = gain_energy(P, Y)
    constraints = [P >> np.eye(n), G_z >> 0, F_z @ C == E.T @ P, energetic]
    for slopes in slope_vertices(plant):
        A = plant.A + plant.G @ slope_matrix(plant, slopes) @ plant.H
        S = P @ A - Y @ C
        corner = -(2.0 / _SIGMA) * (E.T @ P @ E) + G_z / (_SIGMA * _MU_Z)
        constraints.append(block_matrix([[S + S.T + 2.0 * _DECAY * P, -(S.T @ E) / _SIGMA], [corner]]) << 0)
    why = "the slopes are too wide, or E_f' P = F_z C cannot be met (a fault does not show in the rate of an output)"
    seconds = solve_lmi(cp.Problem(cp.Minimize(energy), constraints), plant, "zhang2008", why)
    L = np.linalg.solve(P.value, Y.value)
    L_p = _LEARNING_RATE * np.linalg.solve(E.T @ P.value @ E, F_z.value)
    x, q, y = np.split(np.eye(n + a1 + p), [n, n + a1])
    yt = y - C @ x
    fa = q + L_p @ yt
    step = np.vstack([plant.A @ x + E @ fa + L @ yt, _SIGMA * L_p @ yt])
    observer = ContinuousObserver(
        plant=plant,
        method="zhang2008",
        step=step,
        output=np.vstack([x, fa, yt]),
        into=np.eye(n + a1, n),
        start=np.vstack([np.linalg.pinv(C), np.zeros((a1, p))]),
        solve_s=seconds,
        notes=("reconstruction; no bound is claimed",),
    )
    return confirmed(observer)
