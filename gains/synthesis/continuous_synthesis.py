"""Convex continuous-time synthesis: all gains at once from one linear matrix inequality per slope vertex.

The inequality, jointly linear in all unknowns, is that of :mod:`gains.synthesis.bounded_real` (docs/theory.md, "The
convex synthesis"). Gains that approach its least mu grow without bound (poles near -1e5 rad/s on the arm), and without
noise in the model the least mu is zero. So the objective is mu + rho trace(Z), as in discrete time
(:mod:`gains.synthesis.convex`).

It is solved in the coordinates of a continuous Kalman filter's errors and in its time scale, as in discrete time
(:mod:`gains.synthesis.conditioning`). For the resulting gains one more inequality, in P and mu alone and solved well
inside its boundary, gives the bound that is certified.
"""

import math
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from adapters.errors import InaccurateError, InfeasibleError, ModelError
from gains.analysis.augment import ErrorModel, augment, error_model
from gains.analysis.estimability import check_existence
from gains.analysis.hinf import StateSpace, hinf_norm
from gains.analysis.riccati import doubled
from gains.plants.plant import FloatArray, Plant
from gains.synthesis.bounded_real import Demands, inequality, solve_continuous, user_design
from gains.synthesis.certificate import certify, closed_error_system
from gains.synthesis.conditioning import FLOOR, Coordinates
from gains.synthesis.continuous_observer import check_continuous
from gains.synthesis.design import Design
from gains.synthesis.solver import DEFAULT, ROBUST, bordered, solve_program

GAIN_WEIGHT = 1e-4
"""Price of the gains. Measured on the disturbed arm, whose least bound is .14517: .14526 with a fastest pole of 223
rad/s and gains up to 2.3e4; at 1e-6 .14517, 714 rad/s and 2.3e5, at 1e-2 .14638, 40 rad/s and 550.
"""
_SLACKS = (1e-4, 1e-3, 1e-2)
"""Relative increases of mu, tried in turn until the certificate holds: a design loses no more than the last one. The
first is as small as the solver allows."""
_SWEEPS = 8
"""Number of iterations for the floor of noise and its time scale, which depend on the filter that they determine.
Chosen: it converges within a few."""
_SMALLEST_SHARE = 1e-3
"""Smallest scale of a state, as a share of the error that matters: a better known state gets this one."""


def design_continuous(
    plant: Plant,
    *,
    decay: tuple[float, float] = (0.0, math.inf),
    gain_weight: float = GAIN_WEIGHT,
    noise_once: bool = False,
) -> Design:
    """Design a continuous observer for a continuous plant and prove it.

    ``decay`` is the range of the decay rates of the error system at every slope vertex, rad/s: -high <= Re <= -low; the
    other parameters are as for :func:`gains.synthesis.convex.design_convex`.

    Raises
    ------
    ModelError
        The model is discrete, has no faults or a hidden mode, or the range of decay rates is invalid.
    InfeasibleError
        An existence condition fails (named in the message) or the inequality has no solution.
    InaccurateError
        The solver stopped short and nothing it found passes the certificate.
    """
    import cvxpy  # noqa: F401 - the first import takes seconds that do not belong to the design's time

    started = time.perf_counter()
    check_continuous(plant)
    low, high = decay
    if not 0.0 <= low < high:
        raise ModelError(f"{plant.name}: decay rates from {low:g} to {high:g} per second are no range of positive ones")
    if not gain_weight > 0.0:
        raise ModelError(f"{plant.name}: a gain weight of {gain_weight} is not positive")
    augmentation = augment(plant, noise_once=noise_once)
    model = error_model(plant, augmentation)
    notes = check_existence(plant)
    coordinates, omega = _coordinates(model, low)
    problem = inequality(model, coordinates, Demands(gain_weight), omega)
    solution, solve_s = solve_continuous(problem, low, high)
    if solution is None:
        raise InaccurateError(f"{plant.name}: the solver found neither gains nor a proof that there are none")
    gains = user_design(problem, solution, augmentation)
    system = closed_error_system(error_model(plant, gains.inverse(augmentation)), gains)
    # Then find a P that proves these gains, with a mu as little above the least as the certificate accepts
    for P, mu, seconds in proofs(system, coordinates.S):
        solve_s += seconds
        design = Design("convex", None, gains, P, mu, noise_once=noise_once, solve_s=solve_s, notes=notes)
        certificate = certify(plant, design)
        kept = certificate.poles_max <= -low and certificate.poles_min >= -high
        if certificate.holds and kept:
            return replace(design, total_s=time.perf_counter() - started)
    raise InaccurateError(
        f"{plant.name}: the solver stopped short and no gains it found could be certified; "
        "check units and scales, or relax the fault rates or the decay rates"
    )


def _coordinates(model: ErrorModel, low: float) -> tuple[Coordinates, float]:
    """Return the coordinates of a Kalman filter of at least the given decay rate, and the rate of its errors, omega.

    States and outputs get a floor of fictitious noise, ``FLOOR`` of their own stationary error over the filter's time
    constant 1 / omega, because a direction without any noise would have no scale.
    """
    A, C = model.mean + low * np.eye(len(model.weights)), model.C
    Q, S, R = model.B @ model.B.T, model.B @ model.D.T, model.D @ model.D.T
    smallest = (_SMALLEST_SHARE / model.weights) ** 2
    omega = max(1.0, low)
    variance = np.maximum(np.diag(Q) / omega, smallest)
    try:
        for _ in range(_SWEEPS):
            output = np.diag(C @ np.diag(variance) @ C.T)
            measured = R + FLOOR**2 * np.diag(output / omega + np.diag(R))
            Sigma = _riccati(A, C, Q + FLOOR**2 * omega * np.diag(variance), S, measured, omega)
            gain = np.linalg.solve(measured, (Sigma @ C.T + S).T).T
            omega = float(np.exp(np.mean(np.log(np.abs(np.linalg.eigvals(A - gain @ C))))))
            variance = np.maximum(np.diag(Sigma), smallest)
        S_factor = np.asarray(np.linalg.cholesky(Sigma), dtype=np.float64)
        Y_factor = np.asarray(np.linalg.cholesky(C @ Sigma @ C.T + omega * measured), dtype=np.float64)
    except np.linalg.LinAlgError as error:
        reason = (
            f"no gains make every error decay at {low:g} rad/s: ask for less"
            if low > 0.0
            else "its numbers are too far apart: check units, scales of disturbance and noise"
        )
        raise InfeasibleError(f"{model.name}: {reason}") from error
    norm = hinf_norm(
        A - low * np.eye(len(A)) - gain @ C,
        model.B - gain @ model.D,
        *model.output(np.zeros((model.a1, len(C)))),
        discrete=False,
    )
    return Coordinates(S_factor, Y_factor, norm.lower**2), omega


def _riccati(A: FloatArray, C: FloatArray, Q: FloatArray, S: FloatArray, R: FloatArray, omega: float) -> FloatArray:
    """Return the stationary covariance of a continuous filter by structured doubling after a Cayley transform.

    Q (na, na), R (p, p) and S (na, p) are the intensities of process noise, of measurement noise and of their
    correlation; ``omega`` is a typical pole of the filter; the point of the transform lies that far to the right of
    every eigenvalue.
    """
    inverse = np.linalg.inv(R)
    A_T = (A - S @ inverse @ C).T
    point = omega + max(0.0, float(np.max(np.linalg.eigvals(A_T).real)))
    shifted = A_T - point * np.eye(len(A))
    G, H = C.T @ inverse @ C, Q - S @ inverse @ S.T
    G_shifted = np.linalg.solve(shifted, G)
    W = np.linalg.inv(shifted.T + H @ G_shifted)
    H_shifted = np.linalg.solve(shifted.T, H.T).T
    return doubled(np.eye(len(A)) + 2.0 * point * W.T, 2.0 * point * G_shifted @ W, 2.0 * point * W @ H_shifted)


def proofs(system: StateSpace, S: FloatArray) -> Iterator[tuple[FloatArray, float, float]]:
    """Yield P, mu and seconds that prove a closed error system: the least mu, raised by increasing slack.

    With the gains fixed the bounded-real inequality is linear in P and mu. An optimum lies on its boundary, where
    rounding decides; a P farthest inside at a slightly larger mu passes the certificate. In the coordinates S (na, na)
    the state has size one.
    """
    norm = max(hinf_norm(A, system.B, system.C, system.D, discrete=False).lower for A in system.A)
    if not 0.0 < norm < math.inf:
        return
    omega = float(np.exp(np.mean(np.log(np.abs(np.linalg.eigvals(system.A))))))
    inverse = np.linalg.inv(S)
    own = StateSpace(inverse @ system.A @ S / omega, inverse @ system.B / omega, system.C @ S / norm, system.D / norm)
    least, _, total = _proof(own)
    if least is None:
        return
    for slack in _SLACKS:
        mu, P, seconds = _proof(own, least * (1.0 + slack))
        total += seconds
        if mu is not None:
            user = norm**2 / omega * inverse.T @ P @ inverse
            yield 0.5 * (user + user.T), norm**2 * mu, total
            total = 0.0


def _proof(system: StateSpace, mu_fixed: float | None = None) -> tuple[float | None, FloatArray, float]:
    """Minimise mu over P, or at a fixed mu find the P farthest inside; return mu, P and seconds."""
    import cvxpy as cp

    na, nw = system.B.shape
    P, mu, margin = cp.Variable((na, na), symmetric=True), cp.Variable(), cp.Variable()
    bound, slack = (mu, 0.0) if mu_fixed is None else (mu_fixed, margin)
    constraints = [P >> 0]
    for A in system.A:
        PA, PB = P @ A, P @ system.B
        rows = [[-(PA + PA.T), -PB], [-PB.T, bound * np.eye(nw)]]
        inequality = bordered(rows, [system.C, system.D])
        constraints.append(inequality >> slack * np.eye(2 * na + nw))
    objective = cp.Minimize(mu) if mu_fixed is None else cp.Maximize(margin)
    seconds = solve_program(cp.Problem(objective, constraints), DEFAULT, ROBUST)
    value = mu.value if mu_fixed is None else mu_fixed
    if P.value is None or value is None:
        return None, np.zeros((0, 0)), seconds
    return float(value), P.value, seconds
