"""Convex discrete-time synthesis: all gains at once from one linear matrix inequality per slope vertex.

For the error system of :mod:`gains.augment`, a full P and R = P [Kb; L_i] make the bounded-real inequality

    [ P   P (A_a + vertex) - R Ca   P B - R D   0      ]
    [ *   P - C_x^T C_x             0           C_f^T  ]  >= 0
    [ *   *                         mu I        D_f^T  ]
    [ *   *                         *           I      ]

jointly linear in (P, R, L_p, mu), with C_f = W_f ([0 I] - L_p Ca) and D_f = -W_f L_p D. It is that of the
theory with the rows of e that hold no unknown, C_x = W_x [I 0], taken out by a Schur complement, and with the
columns of [B; D] replaced by as many as their rank, for only [B; D] [B; D]^T enters. It is solved in the
coordinates of :mod:`gains.conditioning`.

Minimising mu alone leaves the gains free where they do not matter and drives them to infinity where they
matter a little. So the objective is mu + rho trace(Z), Z >= [Kb; L_i]^T P [Kb; L_i] + L_p^T W_f^2 L_p: the
energy that an innovation of size one puts into the error.

P bounds the observability Gramian of the error too, so that W >= (P B - R D)^T P^-1 (P B - R D) + D_f^T D_f makes
trace(W) a bound of the squared H2 norm at every vertex, in the same unknowns: it can take a share of the objective.

The solver's time grows with the sixth power of the inequality's size and with the number of vertices. A large
plant with many of them is first given one inequality in place of them all (S-procedure): with the slopes
Delta = mean + diag(delta), |delta| <= 1, entering as G delta H, and multipliers Lambda = diag(lambda) >= 0, the
vertex is the mean, P B gains the columns P G, mu I the diagonal Lambda, and P - C_x^T C_x loses
H^T Lambda H. It implies the inequality at every vertex; its bound can be a little larger. Every solution has to pass
:mod:`gains.certificate`, or it is none.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gains.augment import Augmentation, ErrorModel, augment, error_model
from gains.certificate import certify
from gains.conditioning import Coordinates, kalman_coordinates, with_floor
from gains.design import Design
from gains.discretise import discretise
from gains.errors import InaccurateError, InfeasibleError, ModelError
from gains.existence import check_existence
from gains.plant import FloatArray, Plant

GAIN_WEIGHT = 1e-3
_SLACKS = (1e-3, 1e-2, 5e-2)
_LEAST_MU_WEIGHT = 1e-4
_LARGEST_CONE = 5_000

# With its defaults Clarabel gives up on the nearly singular systems at the end of such problems; a larger
# static regularisation, repaired by more iterative refinement, takes it to the optimum.
SOLVER = {
    "direct_solve_method": "faer",
    "static_regularization_constant": 1e-5,
    "iterative_refinement_max_iter": 100,
    "iterative_refinement_reltol": 1e-14,
    "iterative_refinement_abstol": 1e-14,
    "iterative_refinement_stop_ratio": 1.5,
}


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    """The error system in the coordinates of the solver, and what is asked of it.

    C_x and C_f0 are the rows of W S / sqrt(mu of the coordinates) for zeta~ and for z. With multipliers, A is the
    mean alone, and the last columns of B and D are those of the slopes, whose arguments are H; else H is empty.
    """

    name: str
    a1: int
    pole_radius: float
    gain_weight: float
    h2: float
    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    C_x: FloatArray
    C_f0: FloatArray
    H: FloatArray
    vertices: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _Solution:
    """Raw values of the unknowns in the coordinates of the solver."""

    P: FloatArray
    R: FloatArray
    L_p: FloatArray
    mu: float
    noise_energy: float


def design_convex(
    plant: Plant,
    rate_hz: float | None = None,
    *,
    pole_radius: float = 1.0,
    gain_weight: float = GAIN_WEIGHT,
    integrator_order: int = 1,
    h2: float = 0.0,
    vertices: bool | None = None,
) -> Design:
    """Design an observer for a plant and prove it.

    Parameters
    ----------
    plant : Plant
        Continuous model (sampled at ``rate_hz``) or discrete model.
    rate_hz : float | None
        Samples per second; None takes the rate of a discrete model.
    pole_radius : float
        Upper bound of the size of every pole of the error system at every slope vertex, in (0, 1].
    gain_weight : float
        rho, the price of the energy that an innovation puts into the error, against mu; positive. Less of it
        follows noise that the scales call harmless more closely.
    integrator_order : int
        1 for actuator faults that move at no more than their rate; 2 for those that ramp: their rate then is that
        of their rate, per second squared, and a steady ramp is followed without lag.
    h2 : float
        alpha in [0, 1]: 0 minimises the bound of the largest energy of the error, 1 that of its energy under white
        noise in every input (the squared H2 norm), and what lies between (1 - alpha) mu + alpha trace(W).
    vertices : bool | None
        One inequality per slope vertex (the least bound), or one with multipliers for all; None takes multipliers
        where the vertices would take long, and the vertices where multipliers fail.

    Returns
    -------
    Design
        Gains whose certificate holds.

    Raises
    ------
    ModelError
        The model cannot be sampled at that rate, has no faults or a hidden mode, or an option is out of range.
    InfeasibleError
        An existence condition fails (named in the message) or the inequality has no solution.
    InaccurateError
        The solver stopped short and nothing it found passes the certificate.
    """
    import cvxpy  # noqa: F401 - the first import takes seconds that do not belong to the design's time

    started = time.perf_counter()
    rate_hz = plant.rate_hz if rate_hz is None else rate_hz
    if rate_hz is None:
        raise ModelError(f"{plant.name}: a continuous model needs a rate in samples per second (--rate)")
    if not 0.0 < pole_radius <= 1.0:
        raise ModelError(f"{plant.name}: a pole radius of {pole_radius} does not lie in (0, 1]")
    if not gain_weight > 0.0:
        raise ModelError(f"{plant.name}: a gain weight of {gain_weight} is not positive")
    if integrator_order not in (1, 2):
        raise ModelError(f"{plant.name}: an integrator order of {integrator_order} is neither 1 nor 2")
    if not 0.0 <= h2 <= 1.0:
        raise ModelError(f"{plant.name}: an H2 share of {h2} does not lie in [0, 1]")
    discrete = discretise(plant, rate_hz)
    augmentation = augment(discrete)
    # A chain of integrators hides the same modes as one: what exists for order 1 exists for order 2.
    notes = check_existence(discrete, augmentation, error_model(discrete, augmentation))
    model = error_model(discrete, augmentation, integrator_order)
    coordinates = kalman_coordinates(model, pole_radius)
    problem = _problem(model, coordinates, pole_radius, gain_weight, h2)
    for attempt in _attempts(problem, model.slopes, vertices):
        for solution, solve_s in _solutions(attempt):
            design = _design(discrete, augmentation, coordinates, model, solution)
            certificate = certify(discrete, design)
            if certificate.holds and certificate.poles_max_abs <= pole_radius:
                total_s = time.perf_counter() - started
                return replace(design, solve_s=solve_s, total_s=total_s, notes=notes)
    raise InaccurateError(
        f"{plant.name}: the solver stopped short and no gains it found could be certified; "
        "check units and scales, or relax the fault rates or the pole radius"
    )


def _problem(
    model: ErrorModel, coordinates: Coordinates, pole_radius: float, gain_weight: float, h2: float
) -> _Problem:
    """Return the model in the solver's coordinates, with the floor of noise and as few columns as matter."""
    S, Y = coordinates.S, coordinates.Y
    na, nz = len(S), len(model.weights) - model.a1
    floored = with_floor(model, S, Y)
    into = np.vstack([np.linalg.solve(S, floored.B), np.linalg.solve(Y, floored.D)])
    left, singular, _ = np.linalg.svd(into, full_matrices=False)
    columns = left * singular
    errors = (model.weights[:, None] * S[: len(model.weights)]) / np.sqrt(coordinates.mu)
    A = np.asarray(np.linalg.solve(S, model.A @ S), dtype=np.float64)
    return _Problem(
        name=model.name,
        a1=model.a1,
        pole_radius=pole_radius,
        gain_weight=gain_weight,
        h2=h2,
        A=A,
        B=columns[:na],
        C=np.asarray(np.linalg.solve(Y, model.C @ S), dtype=np.float64),
        D=columns[na:],
        C_x=errors[:nz],
        C_f0=errors[nz:],
        H=np.zeros((0, na)),
        vertices=A,
    )


def _attempts(problem: _Problem, slopes: FloatArray, vertices: bool | None) -> Iterator[_Problem]:
    """Yield the problem with multipliers and the one with vertices, as asked for or as its size demands."""
    size = 2 * len(problem.B) + problem.B.shape[1] + problem.a1
    several = len(slopes) > 1
    large = several and len(slopes) * size * (size + 1) // 2 > _LARGEST_CONE
    if several and (vertices is False or (vertices is None and large)):
        yield _with_multipliers(problem, slopes)
    if vertices is not False or not several:
        yield problem


def _with_multipliers(problem: _Problem, slopes: FloatArray) -> _Problem:
    """Return the problem with the mean of its vertices and the slopes' deviations from it as G delta H."""
    G, H = [], []
    for slope in slopes.T:
        high = slope > slope.mean()
        if np.any(high):
            deviation = 0.5 * (problem.A[high].mean(axis=0) - problem.A[~high].mean(axis=0))
            left, singular, right = np.linalg.svd(deviation)  # of rank one: a column of G times a row of H
            G.append(np.sqrt(singular[0]) * left[:, 0])
            H.append(np.sqrt(singular[0]) * right[0])
    return replace(
        problem,
        A=problem.A.mean(axis=0, keepdims=True),
        B=np.column_stack([problem.B, *G]),
        D=np.hstack([problem.D, np.zeros((len(problem.D), len(G)))]),
        H=np.array(H),
    )


def _solutions(problem: _Problem) -> Iterator[tuple[_Solution, float]]:
    """Yield the optimum, then points farther inside at slightly larger mu, with the solver's time so far.

    An optimum lies on the boundary of the inequality, where rounding decides. If it fails the certificate, a
    point inside, a little above the least mu, can still pass.
    """
    try:
        best, solve_s = _solve(problem)
    except InfeasibleError:
        if not len(problem.H):
            raise
        return  # multipliers ask for more than the vertices: without a solution they prove nothing
    if best is None:
        return
    yield best, solve_s
    for slack in _SLACKS:
        solution, seconds = _solve(problem, (best.mu * (1.0 + slack), best.noise_energy * (1.0 + slack)))
        solve_s += seconds
        if solution is not None:
            yield solution, solve_s


def _solve(problem: _Problem, fixed: tuple[float, float] | None = None) -> tuple[_Solution | None, float]:
    """Minimise mu (and the gains), or at fixed mu and trace(W) find the point farthest inside the inequality.

    Returns
    -------
    tuple[_Solution | None, float]
        None where the solver failed, and its time in seconds.

    Raises
    ------
    InfeasibleError
        The inequality has no solution.
    """
    import cvxpy as cp

    A, B, C, D = problem.A, problem.B, problem.C, problem.D
    (na, nw), p, a1 = B.shape, len(C), problem.a1
    P, R = cp.Variable((na, na), symmetric=True), cp.Variable((na, p))
    L_p = cp.Variable((a1, p)) if a1 else None
    mu, margin, Z = cp.Variable(), cp.Variable(), cp.Variable((p, p), symmetric=True)
    C_f = None if L_p is None else problem.C_f0 - L_p @ C
    D_f = None if L_p is None else -L_p @ D
    PB, H = P @ B - R @ D, problem.H
    inputs, remainder = mu * np.eye(nw), P - problem.C_x.T @ problem.C_x
    if len(H):
        multipliers = cp.Variable(len(H))
        inputs = cp.diag(cp.hstack([mu * np.ones(nw - len(H)), multipliers]))
        remainder = remainder - H.T @ cp.diag(multipliers) @ H
    slack, constraints = (0.0, []) if fixed is None else (margin, [mu == fixed[0]])
    for vertex in A:
        PA = P @ vertex - R @ C
        rows = [
            [P, PA, PB],
            [PA.T, remainder, np.zeros((na, nw))],
            [PB.T, np.zeros((nw, na)), inputs],
        ]
        inequality = _bordered(rows, [np.zeros((a1, na)), C_f, D_f], a1)
        constraints.append(inequality >> slack * np.eye(2 * na + nw + a1))
    for vertex in problem.vertices if problem.pole_radius < 1.0 else ():
        PA = P @ vertex - R @ C
        decay = cp.bmat([[P, PA], [PA.T, problem.pole_radius**2 * P]])
        constraints.append(decay >> slack * np.eye(2 * na))
    share: float = problem.h2
    energy: Any = 0.0
    if share > 0.0:
        real = nw - len(H)
        W = cp.Variable((real, real), symmetric=True)
        energy = cp.trace(W)
        constraints.append(
            _bordered(
                [[W, PB[:, :real].T], [PB[:, :real], P]],
                [None if D_f is None else D_f[:, :real], np.zeros((a1, na))],
                a1,
            )
            >> 0
        )
        if fixed is not None:
            constraints.append(energy <= fixed[1])
    if fixed is None:
        constraints.append(_bordered([[Z, R.T], [R, P]], [L_p, np.zeros((a1, na))], a1) >> 0)
        objective = cp.Minimize(
            max(1.0 - share, _LEAST_MU_WEIGHT) * mu + share * energy + problem.gain_weight * cp.trace(Z)
        )
    else:
        objective = cp.Maximize(margin)
    program = cp.Problem(objective, constraints)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # "may be inaccurate": the certificate decides that
            program.solve(solver=cp.CLARABEL, **SOLVER)
    except cp.SolverError:
        return None, 0.0
    seconds = float(program.solver_stats.solve_time or 0.0)
    if program.status == cp.INFEASIBLE:
        poles = "" if problem.pole_radius == 1.0 else f" with all poles within {problem.pole_radius:g}"
        raise InfeasibleError(
            f"{problem.name}: no gains make the error decay for every slope{poles}: narrow the slopes (give the "
            "nonlinearities a range) or ask for less"
        )
    if P.value is None or np.linalg.eigvalsh(P.value)[0] <= 0.0 or not mu.value > 0.0:
        return None, seconds
    return _Solution(
        P=P.value,
        R=R.value,
        L_p=np.zeros((0, p)) if L_p is None else L_p.value,
        mu=float(mu.value),
        noise_energy=float(energy.value) if share > 0.0 else 0.0,
    ), seconds


def _bordered(blocks: list[list[Any]], border: list[Any], size: int) -> Any:
    """Return the block matrix with the given last block row (and column) and an identity in the corner."""
    import cvxpy as cp

    if size:
        blocks = [[*row, block.T] for row, block in zip(blocks, border, strict=True)]
        blocks.append([*border, np.eye(size)])
    return cp.bmat(blocks)


def _design(
    plant: Plant, augmentation: Augmentation, coordinates: Coordinates, model: ErrorModel, solution: _Solution
) -> Design:
    """Return a solution as gains in the user's units, with mu raised by the smallest slack."""
    S, Y, mu = coordinates.S, coordinates.Y, coordinates.mu
    nz = len(model.weights) - model.a1
    injection = S @ np.linalg.solve(solution.P, solution.R) @ np.linalg.inv(Y)
    L_p = np.sqrt(mu) * solution.L_p @ np.linalg.inv(Y) / model.weights[nz:, None]
    K = injection[:nz] - augmentation.L1 @ plant.E_f @ L_p
    N = augmentation.L1 @ augmentation.A_z - K @ augmentation.C_b
    inverse = np.linalg.inv(S)
    P = mu * inverse.T @ solution.P @ inverse
    return Design(
        method="convex",
        rate_hz=float(plant.rate_hz or 0.0),
        K=K,
        L_i=injection[nz:],
        L_p=L_p,
        L1=augmentation.L1,
        F=augmentation.F,
        N=N,
        J=N @ augmentation.F + K,
        P=0.5 * (P + P.T),
        mu=mu * solution.mu * (1.0 + _SLACKS[0]),
    )
