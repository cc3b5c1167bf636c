"""The paper's Theorem 1 (no disturbances) and Theorem 2 (with them), as corrected, for comparison.

Unknowns are P = diag(P1, P2 / beta), R1^T = P1 K, R2^T = P2 L2, the multiplier Z of the slopes, and mu; the scalars
beta, epsilon and delta are chosen by hand. The law is L_p = L_i = beta L2. At every vertex Phi of the slopes and for
the error [zeta~; fa~] the inequality reads (the lower blocks follow by symmetry)

    [ Sigma_11   (M + eps N)^T   (X + Z H Phi)^T   Sigma_q   U^T         ]
    [ *          -2 eps P1       0                 0         0           ]
    [ *          *               -2 Z              0         0           ]  <= 0
    [ *          *               *                 -mu I     (delta V)^T ]
    [ *          *               *                 *         -2 delta P1 ]

    Sigma_11 = [ P1 L1 A_z - R1^T Cb + (.)^T   P1 L1 E_f - (R2^T Cb L1 A_z)^T - (R2^T Cb)^T ]  + I
               [ *                             -R2^T Cb L1 E_f - (.)^T                      ]
    Sigma_q  = [ P1 L1 E - R1^T D              -P1 F D                     0           ]
               [ -R2^T Cb L1 E - R2^T D        R2^T Cb F D - R2^T D        P2 / beta   ]    columns [w; w'; f_a']
    X_ij     = [ P1 L1 G H_ij; -R2^T Cb L1 G H_ij ]^T,   H_ij = e_m(i) e_nbar(j)^T,   (H Phi)_ij = g_ij [H_i T, 0]
    M = [0, Cb^T R2],   N = [R1^T Cb, 0],   U = [0, Cb^T R2],   V = [R1^T D, 0, 0]

Theorem 1 (no w) lacks the last block row and column, and the columns of w and w'. Corrections, with the numbers of the
theory's list of errors in the print:

1.  The existence conditions do not follow from Cb (3 x 5 in the example); they are tested for each model.
2.  Young's term behind (1, 1) is (M + eps N)^T (2 eps P1)^-1 (M + eps N); the print has (-2 eps P1)^-1, which would be
    no upper bound. The block -2 eps P1 of the Schur complement is right.
3.  M and N are printed transposed; as above both are nz x (nz + a1).
4.  Phi is a stacked column of blocks g_ij I_(nz + a1), not a row of g_ij I_nbar.
5.  V multiplies w, so delta V belongs into block (4, 5). The print leaves a zero there and proves nothing about w.
    There is a sign, too: -P2 L2 Cb (L1 E - K D) contains +R2^T Cb K D, so U is +Cb^T R2; the print has a minus.
6.  "g_a = 0 without loss of generality" would move a_ij into A, which the example does not do. The vertices lie at
    a_ij and b_ij: what Young's inequality bounds is the term itself, whatever the signs, so no shift is needed.
7.  Theorem 1's least mu is zero: the bound shrinks as the gains grow. See :func:`design_theorem` for what stops it.
8.  The printed sqrt(mu) = 0.0324 of Theorem 2 is below what any observer can reach (0.136): it is mu = 0.18^2.
10. Z only adds conservatism, for at a vertex the term it bounds is affine in the unknowns. It is kept because it is the
    paper's; :mod:`gains.synthesis.continuous_synthesis` does without.

Z is symmetric and positive definite, its blocks (ij, kl) are symmetric and the off-diagonal ones positive
semidefinite. A slope that is constant (a_ij = b_ij) is no uncertainty: it goes into A_z exactly, needs no block of Z
and does not multiply the vertices. H_i with fewer rows than nbar are filled up with zero rows of slope zero.
"""

import math
import time
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from adapters.errors import InaccurateError, InfeasibleError, ModelError
from gains.analysis.augment import ErrorModel, augment, error_model, slope_vertices
from gains.analysis.estimability import check_existence
from gains.plants.plant import FloatArray, Plant
from gains.synthesis.certificate import certify
from gains.synthesis.continuous_observer import check_continuous
from gains.synthesis.design import Design, observer_matrices
from gains.synthesis.solver import DEFAULT, ROBUST, gain_energy, solve_program

Theorem = Literal["theorem1", "theorem2"]

BETA, EPSILON, DELTA = 100.0, 0.0112, 5.0
"""Values of the paper's example."""
SMALLEST_SQRT_MU = 2.5e-4
"""Smallest bound that is pursued: the one that the paper prints for Theorem 1 (2.5399e-4), whose least bound is zero,
rounded down."""
_SLACKS = (1e-4, 1e-3, 1e-2, 5e-2)
"""Relative increases of mu, tried in turn until the certificate holds: a design loses no more than the last one. The
first is as small as the solver allows."""


@dataclass(frozen=True, slots=True, eq=False)
class _Slope:
    """One slope g_ij that varies.

    X is L1 G H_ij (nz, nbar), H is H_i T (nbar, nz), ``values`` are its values at each vertex.
    """

    X: FloatArray
    H: FloatArray
    values: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _Terms:
    """The plant's part of the inequality; zeta~ and fa~ in units of the errors that matter, y in units of its size."""

    L1_A: FloatArray  # [L1 A_z, L1 E_f] with the constant slopes (nz, na)
    B: FloatArray  # [L1 E, -F D, 0] (nz, nw)
    C: FloatArray  # [Cb, 0] (p, na)
    D: FloatArray  # [D, 0, 0] (p, nw)
    D_rate: FloatArray  # [0, D, 0] (p, nw)
    rate: FloatArray  # [0, 0, rates of the faults] (a1, nw)
    slopes: tuple[_Slope, ...]  # the slopes that vary
    vertices: int  # number of their vertices
    outputs: FloatArray  # size of each output (p,)


@dataclass(frozen=True, slots=True, eq=False)
class _Solution:
    """K, beta L2, diag(P1, P2 / beta) and mu in the units of :class:`_Terms`."""

    K: FloatArray
    L: FloatArray
    P: FloatArray
    mu: float


def design_theorem(
    plant: Plant,
    theorem: Theorem,
    *,
    beta: float = BETA,
    epsilon: float = EPSILON,
    delta: float = DELTA,
    smallest_sqrt_mu: float = SMALLEST_SQRT_MU,
) -> Design:
    """Design the paper's observer with its own inequality, corrected, and prove it: L_p = L_i = beta L2.

    First comes the least mu; bounds below ``smallest_sqrt_mu`` are not pursued. In Theorem 1, whose least mu is zero,
    the bound always is that value: it is what was requested, not the best possible. Then, with a slightly larger mu,
    come the gains that put the least energy into the error, with the smallest P, so that the error decays fast:
    trace(Z_1) + trace(Z_2) + trace(P) with Z_1 >= K^T P1 K and Z_2 >= beta L2^T P2 L2. Without such a choice the gains
    depend on where the solver happens to stop.

    beta cancels: the inequality contains only beta L2 and P2 / beta. It determines L2, nothing else. epsilon and delta,
    of which Theorem 1 has only epsilon, apply to errors in units of the sizes that matter; all three are positive.

    Raises as :func:`gains.synthesis.continuous_synthesis.design_continuous`, and a ModelError for a model that does not
    fit the theorem and for a scalar that is not positive.
    """
    import cvxpy  # noqa: F401 - the first import takes seconds that do not belong to the design's time

    started = time.perf_counter()
    check_continuous(plant)
    for name, value in (("beta", beta), ("epsilon", epsilon), ("delta", delta), ("least bound", smallest_sqrt_mu)):
        if not 0.0 < value < math.inf:
            raise ModelError(f"{plant.name}: {name} is {value}; it must be positive")
    disturbed = bool(plant.disturbances or plant.noises)
    if theorem == "theorem1" and disturbed:
        raise ModelError(f"{plant.name}: theorem1 knows no disturbances or noise; use theorem2 or leave them out")
    if not disturbed and not plant.actuator_faults:
        raise ModelError(f"{plant.name}: {theorem} has nothing to bound: no disturbance, noise or actuator fault")
    augmentation = augment(plant)
    model = error_model(plant, augmentation)
    notes = check_existence(plant)
    terms = _terms(plant, augmentation.L1, model)
    scalars = (epsilon, delta if disturbed else None)
    least, solve_s = _solve(terms, *scalars)
    if least is None:
        raise InfeasibleError(
            f"{plant.name}: the inequality of {theorem} has no solution with epsilon {epsilon:g}"
            + (f" and delta {delta:g}" if disturbed else "")
            + ": try others, or the convex synthesis, which needs none"
            + "".join(f" ({note})" for note in notes)
        )
    reached = math.sqrt(max(least.mu, 0.0))
    if reached < smallest_sqrt_mu:
        notes = (*notes, f"the bound was stopped at {smallest_sqrt_mu:g}; larger gains would lower it")
    nz = len(augmentation.L1)
    units = model.weights
    for slack in _SLACKS:
        solution, seconds = _solve(terms, *scalars, max(least.mu * (1.0 + slack), smallest_sqrt_mu**2))
        solve_s += seconds
        if solution is None:
            continue
        K = solution.K / units[:nz, None] / terms.outputs
        L = solution.L / units[nz:, None] / terms.outputs
        P = solution.P * units * units[:, None]
        gains = observer_matrices(augmentation, K, L, L)
        design = Design(theorem, None, gains, P, solution.mu, fault_state="error", solve_s=solve_s, notes=notes)
        if certify(plant, design).holds:
            return replace(design, total_s=time.perf_counter() - started)
    raise InaccurateError(
        f"{plant.name}: the solver stopped short on the inequality of {theorem} and no gains it found could be "
        "certified; check units and scales, or try another epsilon or delta"
    )


def _terms(plant: Plant, L1: FloatArray, model: ErrorModel) -> _Terms:
    """Return the constants of the inequality."""
    na = len(model.weights)
    nz, n, nw = na - model.a1, len(plant.states), model.B.shape[1]
    size, error = 1.0 / model.weights, model.weights[:nz]
    outputs = np.max(np.abs(model.C) * size, axis=1)
    outputs = np.where(outputs > 0.0, outputs, 1.0)
    vertices = slope_vertices(plant)
    width = max((len(g.arguments) for g in plant.nonlinearities), default=0)
    A = np.array(model.A[0, :nz])
    slopes, column = [], 0
    for i, g in enumerate(plant.nonlinearities):
        rows = np.zeros((width, nz))
        rows[: len(g.arguments), :n] = g.rows
        into = L1 @ plant.G[:, i]
        for j, (low, high) in enumerate(g.slopes.tolist()):
            if low < high:
                # The error model's A is that of the first vertex; a varying slope leaves it.
                A[:, :nz] -= vertices[0, column] * np.outer(into, rows[j])
                X = np.zeros((nz, width))
                X[:, j] = error * into
                slopes.append(_Slope(X, rows * size[:nz], vertices[:, column]))
            column += 1
    q = (nw - model.a1) // 2
    D = model.D / outputs[:, None]
    return _Terms(
        L1_A=error[:, None] * A * size,
        B=error[:, None] * model.B[:nz],
        C=model.C * size / outputs[:, None],
        D=D,
        D_rate=np.roll(D, q, axis=1),
        rate=model.weights[nz:, None] * model.B[nz:],
        slopes=tuple(slopes),
        vertices=len(vertices),
        outputs=outputs,
    )


def _solve(
    terms: _Terms, epsilon: float, delta: float | None, mu_fixed: float | None = None
) -> tuple[_Solution | None, float]:
    """Minimise mu, or the energy of the gains at a fixed mu; None if there is no solution, and the seconds."""
    import cvxpy as cp

    (nz, na), p, nw = terms.L1_A.shape, len(terms.C), terms.B.shape[1]
    a1 = na - nz
    E_z, E_a = np.eye(na)[:, :nz], np.eye(na)[:, nz:]
    C_b = terms.C[:, :nz]
    P1, R1_T = cp.Variable((nz, nz), symmetric=True), cp.Variable((nz, p))
    P, R2_T = E_z @ P1 @ E_z.T, np.zeros((na, p))
    mu = cp.Variable()
    # The columns of Sigma_q in units of sqrt(mu), and P2 with them, so that all numbers have similar size for the
    # solver.
    level = 1.0 if mu_fixed is None else math.sqrt(mu_fixed)
    bound = mu if mu_fixed is None else 1.0
    effect = E_z @ P1
    Sigma_q = np.zeros((na, nw))
    energies, constraints = [gain_energy(P1, R1_T)], [P1 >> 0]
    if a1:
        P2, L_P = level * cp.Variable((a1, a1), symmetric=True), cp.Variable((a1, p))
        P, R2_T = P + E_a @ P2 @ E_a.T, E_a @ L_P
        effect = effect - R2_T @ C_b
        Sigma_q = E_a @ P2 @ terms.rate
        energies.append(gain_energy(P2, L_P))
        constraints.append(P2 >> 0)
    half = E_z @ P1 @ terms.L1_A - (E_z @ R1_T + R2_T) @ terms.C - R2_T @ C_b @ terms.L1_A
    Sigma_11 = half + half.T + np.eye(na)
    Sigma_q = (Sigma_q + effect @ terms.B - (E_z @ R1_T + R2_T) @ terms.D - R2_T @ terms.D_rate) / level
    young = R2_T @ C_b + epsilon * (R1_T @ terms.C).T
    Z = _multiplier(terms, constraints)
    for vertex in range(terms.vertices):
        right, corner = [young, Sigma_q], [2.0 * epsilon * P1, bound * np.eye(nw)]
        if Z is not None:
            X_T = cp.hstack([effect @ slope.X for slope in terms.slopes])
            H_Phi = np.vstack([slope.values[vertex] * slope.H @ E_z.T for slope in terms.slopes])
            right.append(X_T + (Z @ H_Phi).T)
            corner.append(2.0 * Z)
        if delta is not None:
            right.append(R2_T @ C_b)
            corner.append(2.0 * delta * P1)
        zero = [[np.zeros((a.shape[0], b.shape[0])) for b in corner] for a in corner]
        rows = [[block if i == j else zero[i][j] for j in range(len(corner))] for i, block in enumerate(corner)]
        if delta is not None:
            rows[-1][1] = -delta / level * R1_T @ terms.D
            rows[1][-1] = rows[-1][1].T
        matrix = [[-Sigma_11, *(-block for block in right)]]
        matrix += [[-block.T, *row] for block, row in zip(right, rows, strict=True)]
        constraints.append(cp.bmat(matrix) >> 0)
    if mu_fixed is None:
        program = cp.Problem(cp.Minimize(mu), constraints)
    else:
        constraints += [constraint for _, constraint in energies]
        program = cp.Problem(cp.Minimize(cp.trace(P) + sum(energy for energy, _ in energies)), constraints)
    seconds = solve_program(program, DEFAULT, ROBUST)
    if program.status == cp.INFEASIBLE or P1.value is None:
        return None, seconds
    P_value = np.asarray(P.value, dtype=np.float64)
    if np.linalg.eigvalsh(P_value)[0] <= 0.0:
        return None, seconds
    return _Solution(
        K=np.linalg.solve(P1.value, R1_T.value),
        L=np.linalg.solve(P2.value, L_P.value) if a1 else np.zeros((0, p)),
        P=0.5 * (P_value + P_value.T),
        mu=float(mu.value) if mu_fixed is None else mu_fixed,
    ), seconds


def _multiplier(terms: _Terms, constraints: list[Any]) -> Any:
    """Return Z of the paper's form, None if no slope varies, and add its constraints."""
    import cvxpy as cp

    count = len(terms.slopes)
    if not count:
        return None
    width = len(terms.slopes[0].H)
    blocks: list[list[Any]] = [[None] * count for _ in range(count)]
    for i in range(count):
        for j in range(i, count):
            block = cp.Variable((width, width), symmetric=True)
            constraints.append(block >> 0)
            blocks[i][j] = blocks[j][i] = block
    Z = cp.bmat(blocks)
    constraints.append(Z >> 0)
    return Z
