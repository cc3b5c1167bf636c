"""Shared parts of the reconstructed baselines: Lipschitz rows, the solver, and the test of the bound that it reports.

The inequalities are written with E, D, the identity that weighs the errors and the unit rate of fa' replaced by their
scaled versions, so that every bound is for the same [w; w'; fa'] and e as ours.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from adapters.errors import InaccurateError, InfeasibleError
from gains.plants.plant import FloatArray, Plant
from gains.published.error_system import Inputs, error_norm
from gains.synthesis.continuous_observer import ContinuousObserver
from gains.synthesis.solver import DEFAULT, solve_program

SLACK = 1e-4
"""Tolerance of the solver's constraints, as for our own designs."""
ALLOWANCE = 1e-2
"""Share by which the bound may exceed the least for smaller gains: at the least they are 1e7 on the arm, which no
sampled observer can use."""
SMALLEST = 1e-3
"""Smallest bound, as a share of the error that matters: a smaller one is no better, and beyond the solver's
accuracy."""


def lipschitz_rows(plant: Plant) -> FloatArray:
    """Return H with each row times its largest slope, and times sqrt(k) if g_i has k arguments."""
    sizes = [
        math.sqrt(len(g.arguments)) * np.max(np.abs(g.slopes), axis=1) for g in plant.nonlinearities if len(g.slopes)
    ]
    return np.concatenate([np.zeros(0), *sizes])[:, None] * plant.H


def lipschitz_constant(plant: Plant) -> float:
    """Return a Lipschitz constant of x -> G g(H x)."""
    if not plant.nonlinearities:
        return 0.0
    return float(np.linalg.norm(plant.G, 2) * np.linalg.norm(lipschitz_rows(plant), 2))


def block_matrix(blocks: Sequence[Sequence[Any]]) -> Any:
    """Return the symmetric matrix whose upper triangle, row by row from the diagonal, is given.

    Rows and columns of size zero (no nonlinearity, no disturbance) are left out.
    """
    import cvxpy as cp

    size = len(blocks)
    kept = [i for i in range(size) if blocks[i][0].shape[0] > 0]
    full = cp.bmat([[blocks[i][j - i] if j >= i else blocks[j][i - j].T for j in kept] for i in kept])
    return 0.5 * (full + full.T)


def solve_tempered(
    mu: Any, constraints: list[Any], energies: list[tuple[Any, Any]], plant: Plant, method: str, why: str
) -> float:
    """Minimise mu, then the energy of the gains with the bound within ``ALLOWANCE`` of that minimum.

    The minimum alone drives gains to infinity (1e7 on the arm), which no sampled observer can use; bounds below
    ``SMALLEST`` of the error that matters are as good as that. Returns the seconds in the solver; errors as
    :func:`solve_lmi`.
    """
    import cvxpy as cp

    seconds = solve_lmi(cp.Problem(cp.Minimize(mu), constraints), plant, method, why)
    limit = max((1.0 + ALLOWANCE) ** 2 * float(mu.value), SMALLEST**2)
    energy = sum(energy for energy, _ in energies)
    tempered = cp.Problem(cp.Minimize(energy), [*constraints, *(holds for _, holds in energies), mu <= limit])
    return seconds + solve_lmi(tempered, plant, method, why)


def solve_lmi(problem: Any, plant: Plant, method: str, why: str) -> float:
    """Solve an inequality with Clarabel and return the seconds it took.

    Raises
    ------
    InfeasibleError
        It has no solution; the message ends with ``why``.
    InaccurateError
        The solver found neither a solution nor a proof that there is none.
    """
    import cvxpy as cp

    seconds = solve_program(problem, DEFAULT)
    if problem.status in (cp.INFEASIBLE, cp.INFEASIBLE_INACCURATE):
        raise InfeasibleError(f"{plant.name}: the {method} inequality has no solution: {why}")
    if problem.status not in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE):
        raise InaccurateError(f"{plant.name}: the solver stopped short on the {method} inequality ({problem.status})")
    return seconds


def reported_bound(mu: Any) -> float:
    """Return sqrt(mu) of a solution with the solver's tolerance added, at least ``SMALLEST``."""
    return max(math.sqrt(max(float(mu.value), 0.0)) * (1.0 + SLACK), SMALLEST)


def confirmed(observer: ContinuousObserver, inputs: Inputs = "all") -> ContinuousObserver:
    """Return the observer, or raise an InaccurateError if the norm of its gains is above the bound it reports."""
    norm = error_norm(observer.plant, observer, noise_path="all", inputs=inputs)
    if not norm.confirms(math.inf if observer.sqrt_mu is None else observer.sqrt_mu):
        raise InaccurateError(
            f"{observer.plant.name}: the {observer.method} gains have the norm {norm.value:.6g}, above the bound "
            f"{observer.sqrt_mu} that the solver reports; they must not be used"
        )
    return observer
