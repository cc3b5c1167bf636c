"""The bounded-real inequality of the convex syntheses in the solver's coordinates, and its solution.

For the discrete error system of :mod:`gains.analysis.augment`, a full P and R = P [Kb; L_i] make the inequality

    [ P   P (A_a + vertex) - R Ca   P B - R D         0      ]
    [ *   P - C_x^T C_x             -C_x^T D_x        C_f^T  ]  >= 0
    [ *   *                         mu I - D_x^T D_x  D_f^T  ]
    [ *   *                         *                 I      ]

jointly linear in (P, R, L_p, mu), with C_f = W_f ([0 I] - L_p Ca) and D_f = -W_f L_p D. (With an L_z all rows of e
have a direct gain, so that L_e = [L_z; L_p] takes the place of L_p, and there is no C_x.) Moving the left inverse by Y
adds Y times the free rows of :mod:`gains.analysis.augment` to A_a, B and Gs; with Yb = P Y the inequality stays linear,
in (P, R, L_p, Yb, mu). It is that of the theory with the rows of e that hold no unknown, C_x = W_x [I 0] and D_x, taken
out by a Schur complement, and with the columns of X = [B; D; D_x] replaced by as many as their rank, because only X X^T
enters.

With multipliers Lambda = diag(lambda) >= 0 one inequality replaces those of all vertices (S-procedure): the vertex is
the mean, P B gains the columns P Gs, mu I the diagonal Lambda, and P - C_x^T C_x loses Hs^T Lambda Hs. It implies the
inequality for all slopes, also for slopes that move; its bound can be a little larger. In the same way, with
multipliers of their own, [P, P A; *, r^2 P] >= 0 keeps the poles within r.

P bounds the observability Gramian of the error too, so that W >= (P B - R D)^T P^-1 (P B - R D) + D_f^T D_f makes
trace(W) a bound of the squared H2 norm, in the same unknowns: it can take a share of the objective.

In continuous time (x' for x+) a full P > 0 and the same R make it

    [ T + T^T + C_x^T C_x   P B - R D + C_x^T D_x   C_f^T ]
    [ *                     D_x^T D_x - mu I        D_f^T ]  <= 0,     T = P (A_a + vertex) - R Ca
    [ *                     *                       -I    ]

P > 0 has to be a constraint of its own: the inequality alone also holds for error systems that are not stable. A range
of decay rates [low, high] is a constraint with the same P: T + T^T + 2 low P <= 0 and T + T^T + 2 high P >= 0.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from adapters.errors import InfeasibleError
from gains.analysis.augment import Augmentation, ErrorModel, FreeRows
from gains.plants.plant import FloatArray
from gains.synthesis.conditioning import Coordinates, with_floor
from gains.synthesis.design import ObserverMatrices, observer_matrices, split_direct
from gains.synthesis.solver import DEFAULT, ROBUST, bordered, gain_energy, solve_program

_LEAST_MU_WEIGHT = 1e-4
"""Least weight of mu in the objective; it keeps mu bounded if h2 = 1 minimises the H2 norm alone. A smaller one leaves
mu loose (measured on the arm, sqrt(mu) 1.07 instead of .37 at 1e-6); a larger one influences the choice."""
_NO_ROW = 1e-9
"""Share of the largest free row, in units of the errors, below which a row is zero: above rounding, below every row
that counts."""
_AT_ONCE = 10.0
"""Price in continuous time of the error that an output causes at once, through the left inverse, relative to that which
it causes through a gain in a time constant. Measured on the disturbed arm: at 1, 10, 100 sqrt(mu) is .14514, .14517,
.14525 with the fastest pole at -6300, -650, -220 rad/s. In discrete time a sample is the unit of both."""
_INSIDE = 1e-6
"""Share by which gains stay within their bound: ten times the solver's tolerance."""


@dataclass(frozen=True, slots=True, eq=False)
class Demands:
    """The requirements of a design, as for :func:`gains.synthesis.convex.design_convex`."""

    gain_weight: float
    pole_radius: float = 1.0
    h2: float = 0.0
    P: FloatArray | None = None  # the Lyapunov matrix if it is given, in the user's units
    gain_bound: float = np.inf  # bound of the entries of the gains, in the user's units
    looseness: float = 1.0  # bound of [Kb; L_i] relative to that bound
    free: bool = True  # whether the left inverse is found with the gains
    multipliers: bool = False  # whether one inequality replaces those of all vertices


@dataclass(frozen=True, slots=True, eq=False)
class Inequality:
    """The error system in the coordinates of the solver, and the requirements of its design."""

    name: str  # the plant's name, for errors
    a1: int  # number of actuator faults
    asked: Demands
    coordinates: Coordinates  # the coordinates of the solver
    direct: FloatArray  # size of the rows of L_e in the user's units, for outputs in the solver's
    into: FloatArray  # [L1; L_q] E_f of the pseudo-inverse (na, a1), in the user's units
    # the free rows that Yb multiplies, of size one; no rows if the left inverse stays the pseudo-inverse
    free: FreeRows
    basis: FloatArray  # those rows as combinations of the model's (k, rows)
    # A_a at every vertex, or with multipliers at the mean alone (vertices, na, na); the reduced B and D
    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    # the rows of W S / sqrt(mu of the coordinates) for the errors without a direct gain, and for those with one
    C_x: FloatArray
    C_f0: FloatArray
    # direct path from the reduced columns to those errors before the gain; zero unless noise counts once
    D_x: FloatArray
    D_f0: FloatArray
    # the slopes' Gs (na, k) and Hs (k, na), each column as long as its row; k = 0 without multipliers
    G: FloatArray
    H: FloatArray
    balance: FloatArray  # scale of the slopes: lambda here is ``balance`` times that of the model (k,)
    omega: float  # unit of the rates of a continuous error system, 1/s; one in discrete time


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Raw values of the unknowns in the coordinates of the solver; multipliers (2, k): of the bound, of the poles."""

    P: FloatArray
    R: FloatArray
    Yb: FloatArray
    L_e: FloatArray
    mu: float
    noise_energy: float
    multipliers: FloatArray


def inequality(model: ErrorModel, coordinates: Coordinates, asked: Demands, omega: float | None = None) -> Inequality:
    """Return the model in the solver's coordinates, with as few columns as matter; discrete, with the floor of noise.

    The model is evaluated at every vertex unless there are multipliers, and is in continuous time if ``omega`` is
    given.
    """
    S, Y = coordinates.S, coordinates.Y
    driven, pace = (with_floor(model, S, Y), 1.0) if omega is None else (model, omega)
    rows = driven.free
    seen = np.hstack([rows.mean @ S, rows.B]) / pace
    left, singular, _ = np.linalg.svd(seen, full_matrices=False)
    kept = singular > _NO_ROW * np.max(singular, initial=0.0) if asked.free else np.zeros(len(singular), dtype=np.bool_)
    basis = (left[:, kept] / singular[kept]).T
    weights = model.weights[:, None] / np.sqrt(coordinates.mu)
    errors = weights * S[: len(model.weights)]
    at_once = weights[: len(driven.direct)] * driven.direct
    enters = [np.linalg.solve(S, driven.B) / pace, np.linalg.solve(Y, driven.D), at_once, basis @ rows.B / pace]
    left, singular, _ = np.linalg.svd(np.vstack(enters), full_matrices=False)
    columns = (left * singular)[:, singular > np.finfo(np.float64).eps * singular[0]]
    B, D, at_once, free_B = np.split(columns, np.cumsum([len(block) for block in enters])[:-1])
    used = slice(None) if asked.multipliers else slice(0)
    G = np.asarray(np.linalg.solve(S, model.G[:, used]), dtype=np.float64)
    H = model.H[used] @ S
    balance = np.linalg.norm(H, axis=1) / np.linalg.norm(G, axis=0)
    dynamics = model.mean[None] if asked.multipliers else model.A
    return Inequality(
        name=model.name,
        a1=model.a1,
        asked=asked,
        coordinates=coordinates,
        direct=np.sqrt(coordinates.mu) / model.weights[model.fixed :],
        into=model.into,
        free=FreeRows(
            A=basis @ (rows.mean[None] if asked.multipliers else rows.A) @ S / pace,
            mean=basis @ rows.mean @ S / pace,
            B=free_B,
            G=basis @ rows.G[:, used] * np.sqrt(balance),
            F=basis @ rows.F @ Y * (1.0 if omega is None else _AT_ONCE),
            into=basis @ rows.into,
        ),
        basis=basis,
        A=np.asarray(np.linalg.solve(S, dynamics @ S), dtype=np.float64) / pace,
        B=B,
        C=np.asarray(np.linalg.solve(Y, model.C @ S), dtype=np.float64),
        D=D,
        C_x=errors[: model.fixed],
        C_f0=errors[model.fixed :],
        D_x=at_once[: model.fixed],
        D_f0=np.pad(at_once[model.fixed :], ((0, model.a1), (0, 0))),
        G=G * np.sqrt(balance),
        H=H / np.sqrt(balance)[:, None],
        balance=balance,
        omega=pace,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Unknowns:
    """Unknowns of the inequality, and products with them that several of its blocks contain.

    ``P`` is a constant if it is given; ``L_e``, ``C_f`` and ``D_f`` are None without direct gains, the multipliers
    ``bound`` and ``decay`` without slopes that need them.
    """

    P: Any
    R: Any
    Yb: Any
    L_e: Any
    mu: Any
    bound: Any
    decay: Any
    PB: Any
    PG: Any
    C_f: Any
    D_f: Any


def solve_bounded_real(problem: Inequality, fixed: tuple[float, float] | None = None) -> tuple[Solution | None, float]:
    """Minimise mu (and the gains), or at fixed mu and trace(W) find the point farthest inside the inequality.

    Use the first form for the least bound. Its optimum lies on the boundary of the inequality, where rounding decides:
    if it fails the certificate, use the second with a slightly larger mu. Returns None if the solver failed, and its
    time in seconds.

    Raises
    ------
    InfeasibleError
        The inequality has no solution.
    """
    import cvxpy as cp

    x = _unknowns(problem)
    margin = cp.Variable()
    slack, constraints = (0.0, []) if fixed is None else (margin, [x.mu == fixed[0]])
    for vertex in range(len(problem.A)):
        PA = _moved(problem, x, vertex)
        constraints.append(_bounded_real(problem, x, PA, slack))
        if problem.asked.pole_radius < 1.0:
            constraints.append(_decaying(problem, x, PA, slack))
    share = problem.asked.h2
    noise_energy: Any = 0.0
    if share > 0.0:
        noise_energy, holds = _noise_energy(problem, x)
        constraints.append(holds)
        if fixed is not None:
            constraints.append(noise_energy <= fixed[1])
    if problem.asked.gain_bound < np.inf:
        constraints += _bounded(problem, x.P, x.R, x.L_e)
    if fixed is None:
        gain_energy, holds = _gain_energy(problem, x)
        constraints.append(holds)
        worst_case = max(1.0 - share, _LEAST_MU_WEIGHT) * x.mu
        objective = cp.Minimize(worst_case + share * noise_energy + problem.asked.gain_weight * gain_energy)
    else:
        objective = cp.Maximize(margin)
    program = cp.Problem(objective, constraints)
    seconds = solve_program(program, ROBUST)
    if program.status == cp.INFEASIBLE:
        raise InfeasibleError(_reason(problem))
    solution = _solution(x, float(noise_energy.value or 0.0) if share > 0.0 else 0.0)
    return None if solution is None or not solution.mu > 0.0 else solution, seconds


def solve_continuous(problem: Inequality, low: float, high: float) -> tuple[Solution | None, float]:
    """Minimise mu and the gains of a continuous error system whose decay rates, rad/s, lie within a range.

    Returns as :func:`solve_bounded_real`; P lies on the boundary of the inequality, so that rounding decides whether it
    proves anything.

    Raises
    ------
    InfeasibleError
        The inequality has no solution.
    """
    import cvxpy as cp

    x = _unknowns(problem)
    gain_energy, holds = _gain_energy(problem, x)
    # placed before the others this constraint lets the solver prove that rates are infeasible; after them the solver
    # stops short
    constraints = [holds]
    for vertex in range(len(problem.A)):
        PA = _moved(problem, x, vertex)
        inside = -(PA + PA.T)
        across, bounded = -x.PB - problem.C_x.T @ problem.D_x, _bound(problem, x)
        rows = [[inside - problem.C_x.T @ problem.C_x, across], [across.T, bounded]]
        constraints.append(bordered(rows, [] if x.L_e is None else [x.C_f, x.D_f]) >> 0)
        if low > 0.0:
            constraints.append(inside - 2.0 * low / problem.omega * x.P >> 0)
        if high < np.inf:
            constraints.append(2.0 * high / problem.omega * x.P - inside >> 0)
    program = cp.Problem(cp.Minimize(x.mu + problem.asked.gain_weight * gain_energy), constraints)
    seconds = solve_program(program, DEFAULT, ROBUST)
    if program.status == cp.INFEASIBLE:
        asked = "" if (low, high) == (0.0, np.inf) else f" at rates from {low:g} to {high:g} rad/s"
        raise InfeasibleError(_reason(problem, asked))
    return _solution(x, 0.0), seconds


def _unknowns(problem: Inequality) -> _Unknowns:
    """Return the unknowns, P as a constant in the solver's coordinates if it is given."""
    import cvxpy as cp

    (na, _), p, ne, k, free = problem.B.shape, len(problem.C), len(problem.C_f0), len(problem.H), len(problem.basis)
    S = problem.coordinates.S
    given = None if problem.asked.P is None else S.T @ problem.asked.P @ S / problem.coordinates.mu
    P = cp.Variable((na, na), symmetric=True) if given is None else cp.Constant(given)
    R, L_e = cp.Variable((na, p)), cp.Variable((ne, p)) if ne else None
    Yb = cp.Variable((na, free)) if free else None
    return _Unknowns(
        P=P,
        R=R,
        Yb=Yb,
        L_e=L_e,
        mu=cp.Variable(),
        bound=cp.Variable(k) if k else None,
        decay=cp.Variable(k) if k else None,
        PB=_with_free(P @ problem.B - R @ problem.D, Yb, problem.free.B),
        PG=_with_free(P @ problem.G, Yb, problem.free.G),
        C_f=None if L_e is None else problem.C_f0 - L_e @ problem.C,
        D_f=None if L_e is None else problem.D_f0 - L_e @ problem.D,
    )


def _with_free(product: Any, Yb: Any, rows: FloatArray) -> Any:
    """Return P X with the term that the moved left inverse adds."""
    return product if Yb is None else product + Yb @ rows


def _moved(problem: Inequality, x: _Unknowns, vertex: int) -> Any:
    """Return P A of the closed error system at a vertex, or at the mean with multipliers."""
    return _with_free(x.P @ problem.A[vertex] - x.R @ problem.C, x.Yb, problem.free.A[vertex])


def _bounded_real(problem: Inequality, x: _Unknowns, PA: Any, slack: Any) -> Any:
    """Return the inequality of the module's docstring at one vertex, or at the mean with multipliers."""
    (na, nw), ne, k = problem.B.shape, len(problem.C_f0), len(problem.H)
    rows = [
        [x.P, PA, x.PB],
        [PA.T, x.P - problem.C_x.T @ problem.C_x, -problem.C_x.T @ problem.D_x],
        [x.PB.T, -problem.D_x.T @ problem.C_x, _bound(problem, x)],
    ]
    # The rows of e that hold an unknown: a Schur complement cannot eliminate them.
    border = [] if x.L_e is None else [np.zeros((ne, na)), x.C_f, x.D_f, *([np.zeros((ne, k))] if k else [])]
    return bordered(_sloped(rows, x.PG, problem.H, x.bound), border) >> slack * np.eye(2 * na + nw + k + ne)


def _bound(problem: Inequality, x: _Unknowns) -> Any:
    """Return mu I - D_x^T D_x."""
    return x.mu * np.eye(problem.B.shape[1]) - problem.D_x.T @ problem.D_x


def _decaying(problem: Inequality, x: _Unknowns, PA: Any, slack: Any) -> Any:
    """Return [P, P A; *, r^2 P] >= 0 at one vertex, or at the mean with multipliers: poles within r."""
    import cvxpy as cp

    rows = [[x.P, PA], [PA.T, problem.asked.pole_radius**2 * x.P]]
    return cp.bmat(_sloped(rows, x.PG, problem.H, x.decay)) >> slack * np.eye(2 * len(problem.B) + len(problem.H))


def _noise_energy(problem: Inequality, x: _Unknowns) -> tuple[Any, Any]:
    """Return trace(W) and the constraint W >= (P B - R D)^T P^-1 (P B - R D) + D_e^T D_e: the squared H2 norm."""
    import cvxpy as cp

    na, nw = problem.B.shape
    W = cp.Variable((nw, nw), symmetric=True)
    border = [] if x.L_e is None else [x.D_f, np.zeros((len(problem.C_f0), na))]
    return cp.trace(W), bordered([[W - problem.D_x.T @ problem.D_x, x.PB.T], [x.PB, x.P]], border) >> 0


def _gain_energy(problem: Inequality, x: _Unknowns) -> tuple[Any, Any]:
    """Return trace(Z) and the constraint Z >= R^T P^-1 R + L_e^T L_e: the innovations' energy in the error.

    The energy that an output puts there through the move of the left inverse has a price, too, so that the left inverse
    is not moved without a benefit.
    """
    import cvxpy as cp

    if x.Yb is None:
        return gain_energy(x.P, x.R, () if x.L_e is None else (x.L_e, np.zeros((x.L_e.shape[0], x.R.shape[0]))))
    gains = cp.hstack([x.R, x.Yb @ problem.free.F])
    if x.L_e is None:
        return gain_energy(x.P, gains)
    ne, p = x.L_e.shape
    return gain_energy(x.P, gains, (cp.hstack([x.L_e, np.zeros((ne, p))]), np.zeros((ne, x.R.shape[0]))))


def _solution(x: _Unknowns, noise_energy: float) -> Solution | None:
    """Return the values of the unknowns, or None if the solver found none with P > 0."""
    values = [y.value for y in (x.P, x.R, x.Yb, x.L_e, x.mu) if y is not None]
    if not all(value is not None and np.all(np.isfinite(value)) for value in values):
        return None
    if np.linalg.eigvalsh(x.P.value)[0] <= 0.0:
        return None
    none = np.zeros(0 if x.bound is None else x.bound.size)
    return Solution(
        P=x.P.value,
        R=x.R.value,
        Yb=np.zeros((x.R.shape[0], 0)) if x.Yb is None else x.Yb.value,
        L_e=np.zeros((0, x.R.shape[1])) if x.L_e is None else x.L_e.value,
        mu=float(x.mu.value),
        noise_energy=noise_energy,
        multipliers=np.array([none if y is None or y.value is None else y.value for y in (x.bound, x.decay)]),
    )


def user_gains(problem: Inequality, injection: Any, L_e: Any, Y: FloatArray | None = None) -> tuple[Any, Any, Any]:
    """Return K, L_i and L_e in the user's units for P^-1 R and L_e in the solver's: numbers, or expressions of them.

    ``Y`` moves the left inverse, by :attr:`Inequality.basis` (:func:`user_inverse`).
    """
    S, inverse = problem.coordinates.S, np.linalg.inv(problem.coordinates.Y)
    direct = np.diag(problem.direct) @ L_e @ inverse
    into = problem.into if Y is None else problem.into + Y @ problem.free.into
    nz = len(problem.C_x) + len(problem.C_f0) - problem.a1
    gains = problem.omega * S @ injection @ inverse - into @ direct[nz - len(problem.C_x) :]
    return gains[:nz], gains[nz:], direct


def user_design(problem: Inequality, solution: Solution, augmentation: Augmentation) -> ObserverMatrices:
    """Return the observer of a solution in the user's units; the left inverse is the augmentation's, moved."""
    Y = problem.coordinates.S @ np.linalg.solve(solution.P, solution.Yb)
    K, L_i, L_e = user_gains(problem, np.linalg.solve(solution.P, solution.R), solution.L_e, Y)
    return observer_matrices(augmentation.moved(Y @ problem.basis), K, L_i, *split_direct(L_e, problem.a1))


def _bounded(problem: Inequality, P: Any, R: Any, L_e: Any) -> list[Any]:
    """Return constraints that bound the gains: every entry for a given P, otherwise the sizes of Kb, L_i and L_e.

    With P >= kappa I and V >= [Kb; L_i]^T P [Kb; L_i] in the user's units, V_jj <= X^2 kappa bounds the columns of [Kb;
    L_i] by X: sufficient (K has L1 E_f L_p less) and linear in P, R, V and kappa. It is stricter than the bound of the
    entries, so that a looser bound of [Kb; L_i] can still keep the entries within theirs.
    """
    import cvxpy as cp

    p, bound, none = R.shape[1], problem.asked.gain_bound * (1.0 - _INSIDE), np.zeros((0, R.shape[1]))
    if problem.asked.P is not None:
        entries = user_gains(problem, np.linalg.inv(P.value) @ R, none if L_e is None else L_e)
        return [cp.abs(gain) <= bound for gain in entries if gain.shape[0]]
    S, inverse = problem.coordinates.S, np.linalg.inv(problem.coordinates.Y)
    size = np.linalg.norm(S, 2)
    V, kappa = cp.Variable((p, p), symmetric=True), cp.Variable()
    constraints = [cp.bmat([[V, R.T], [R, P]]) >> 0, P - kappa * (S.T @ S / size**2) >> 0]
    constraints += [column @ V @ column <= kappa for column in (inverse * (size / (problem.asked.looseness * bound))).T]
    if L_e is not None:
        constraints.append(cp.abs(np.diag(problem.direct / bound) @ L_e @ inverse) <= min(problem.asked.looseness, 1.0))
    return constraints


def _reason(problem: Inequality, asked: str = "") -> str:
    asked += "" if problem.asked.pole_radius == 1.0 else f" with all poles within {problem.asked.pole_radius:g}"
    if problem.asked.P is not None:
        return (
            f"{problem.name}: no gains prove themselves{asked} with the Lyapunov matrix that was given: design "
            "the one that it comes from for what the other is asked too, or ask for less"
        )
    if problem.asked.multipliers:
        asked += ", by one proof for all at once"
    return (
        f"{problem.name}: no gains make the error decay for every slope{asked}: narrow the slopes (give the "
        "nonlinearities a range) or ask for less"
    )


def _sloped(rows: list[list[Any]], PG: Any, H: FloatArray, multipliers: Any) -> list[list[Any]]:
    """Return block rows with the S-procedure: H^T Lambda H subtracted from the second block, [PG; 0; Lambda] added."""
    import cvxpy as cp

    if multipliers is None:
        return rows
    Lambda = cp.diag(multipliers)
    rows[1][1] = rows[1][1] - H.T @ Lambda @ H
    column = [PG, *(np.zeros((row[0].shape[0], len(H))) for row in rows[1:])]
    extended = [[*row, block] for row, block in zip(rows, column, strict=True)]
    return [*extended, [*(block.T for block in column), Lambda]]
