"""Clarabel behind CVXPY, with settings that solve badly conditioned inequalities to their optimum."""

import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

DEFAULT: Mapping[str, Any] = {}
ROBUST: Mapping[str, Any] = {
    "direct_solve_method": "faer",
    "static_regularization_constant": 1e-5,
    "iterative_refinement_max_iter": 100,
    "iterative_refinement_reltol": 1e-14,
    "iterative_refinement_abstol": 1e-14,
    "iterative_refinement_stop_ratio": 1.5,
}
"""Settings for badly conditioned problems. With its defaults Clarabel fails on the nearly singular systems at the end
of such problems; a larger static regularisation, corrected by more iterative refinement, reaches the optimum. Measured
on the disturbed arm at 100 Hz: the defaults end without a certificate, a regularisation from 1e-8 to 1e-4 gives the
same bound."""


def solve_program(program: Any, *attempts: Mapping[str, Any]) -> float:
    """Solve with Clarabel, once for each of the settings until one succeeds; return the seconds it took.

    Use it for every inequality. A failure is no error here: it shows in the program's status and in values that are
    None. A solution that the solver itself calls inaccurate is kept, because a certificate decides.
    """
    import cvxpy as cp

    seconds = 0.0
    for settings in attempts:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # suppresses "may be inaccurate": the certificate decides
                program.solve(solver=cp.CLARABEL, **settings)
        except cp.SolverError:
            continue
        seconds += float(program.solver_stats.solve_time or 0.0)
        if program.status in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE, cp.INFEASIBLE):
            break
    return seconds


def gain_energy(P: Any, R: Any, border: Sequence[Any] = ()) -> tuple[Any, Any]:
    """Return trace(Z) and the constraint Z >= R^T P^-1 R: an innovation's energy in the norm of P.

    A ``border``, a last block row of the constraint as of :func:`bordered`, adds its own energy.
    """
    import cvxpy as cp

    Z = cp.Variable((R.shape[1],) * 2, symmetric=True)
    return cp.trace(Z), bordered([[Z, R.T], [R, P]], border) >> 0


def bordered(blocks: list[list[Any]], border: Sequence[Any]) -> Any:
    """Return the block matrix with the given last block row (and column) and an identity in the corner."""
    import cvxpy as cp

    if border:
        size = border[0].shape[0]
        blocks = [[*row, block.T] for row, block in zip(blocks, border, strict=True)]
        blocks.append([*border, np.eye(size)])
    return cp.bmat(blocks)
