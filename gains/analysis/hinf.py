"""H-infinity norm of a linear system by level sets: exact to rounding, with an interval that proves it.

Some singular value of G(lambda) = C (lambda I - A)^-1 B + D equals gamma where, with Gamma = gamma I,

    [ A - lambda I   0                 B        0     ]            [ A - z I   0             B        0     ]
    [ 0             -A^T - lambda I    0       -C^T   ]     and    [ 0         I - z A^T     0       -C^T   ]
    [ C              0                 D       -Gamma ]            [ C         0             D       -Gamma ]
    [ 0              B^T              -Gamma    D^T   ]            [ 0         z B^T        -Gamma    D^T   ]

lose rank (continuous, lambda = j omega; discrete, z = exp(j omega)): the Hamiltonian and the symplectic pencil without
any inverse, so that neither a singular A nor a gamma near a singular value of D does harm. An orthogonal transformation
eliminates the last columns; the remaining pencil has twice the order of A.

Boyd and Balakrishnan, Bruinsma and Steinbuch: from a gain that is attained somewhere, raise gamma a little; if the
level is crossed, the highest gain between the crossings is the next one (quadratic convergence), otherwise gamma is an
upper bound. Which computed eigenvalue lies on the axis is never decided: the gain is evaluated at the frequencies of
all of them and between neighbours. An interval above the level has its ends among them, so it contains one of these
points.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from gains.plants.plant import FloatArray

_GAP = 1e-9
"""Relative width of the interval. Each level has to be raised by more than rounding at the crossings; nine digits are
more than users read."""
_STEPS = 100
"""Largest number of steps. Convergence is quadratic: measured on 200 random systems with poles up to 1e-7 from the
circle, one to three steps. The rest is for systems at the edge of stability, for which the gap widens."""
_WIDEN_AFTER = 20
"""Number of steps after which rounding decides: each further step widens the gap tenfold."""


class StateSpace(NamedTuple):
    """xi' = A xi + B r, e = C xi + D r."""

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray


@dataclass(frozen=True, slots=True)
class HinfNorm:
    """The norm lies in [lower, upper]: the gain of the system at ``omega``, and a level that its gain does not cross.

    Both are infinite for an unstable system. ``omega`` is in radians per second and may be infinite, in discrete time
    in radians per sample, in [0, pi].
    """

    lower: float
    upper: float
    omega: float


def hinf_norm(A: FloatArray, B: FloatArray, C: FloatArray, D: FloatArray, discrete: bool) -> HinfNorm:
    """Return the H-infinity norm of C (lambda I - A)^-1 B + D, A (n, n), B (n, m), C (p, n), D (p, m).

    Lambda runs along the unit circle (discrete) or along the imaginary axis.
    """
    poles = np.linalg.eigvals(A)
    frequencies = np.abs(np.angle(poles)) if discrete else np.abs(poles.imag)
    growth = np.abs(poles) - 1.0 if discrete else poles.real
    if np.any(growth >= 0.0):
        return HinfNorm(math.inf, math.inf, float(frequencies[int(np.argmax(growth))]))
    A, B, C = _balanced(A, B, C)
    start = np.concatenate([frequencies, np.abs(poles), [0.0, math.pi if discrete else math.inf]])
    lower, omega = _highest(A, B, C, D, np.minimum(start, math.pi) if discrete else start, discrete)
    for step in range(_STEPS):
        if not 0.0 < lower < math.inf:
            break
        level = lower * (1.0 + _GAP * 10.0 ** max(0, step - _WIDEN_AFTER))
        crossings = _crossings(A, B, C / level, D / level, discrete)
        between = 0.5 * (crossings[1:] + crossings[:-1])
        highest, where = _highest(A, B, C, D, np.concatenate([crossings, between]), discrete)
        if highest > lower:
            lower, omega = highest, where
        if highest <= level:
            return HinfNorm(lower, level, omega)
    return HinfNorm(lower, lower, omega)


def gains_at(
    A: FloatArray, B: FloatArray, C: FloatArray, D: FloatArray, omega: FloatArray, discrete: bool
) -> FloatArray:
    """Return the largest singular value of C (lambda I - A)^-1 B + D at each frequency; infinite at a pole."""
    if not B.size or not C.size:
        return np.zeros(len(omega))
    finite = np.isfinite(omega)
    points = np.exp(1j * omega) if discrete else 1j * np.where(finite, omega, 0.0)
    pencil = points[:, None, None] * np.eye(len(A)) - A
    try:
        response = C @ np.linalg.solve(pencil, np.broadcast_to(B, (len(omega), *B.shape)))
    except np.linalg.LinAlgError:
        return np.full(len(omega), math.inf)
    gains: FloatArray = np.linalg.norm(response * finite[:, None, None] + D, ord=2, axis=(1, 2))
    return gains


def _balanced(A: FloatArray, B: FloatArray, C: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the realisation with its states scaled so that inputs and outputs of each have one size."""
    from scipy.linalg import matrix_balance

    n = len(A)
    system = np.zeros((n + 1, n + 1))
    system[:n, :n], system[:n, n], system[n, :n] = A, np.linalg.norm(B, axis=1), np.linalg.norm(C, axis=0)
    _, (size, _) = matrix_balance(system, permute=False, separate=True)
    states = size[:n] / size[n]
    return A * states / states[:, None], B / states[:, None], C * states


def _highest(
    A: FloatArray, B: FloatArray, C: FloatArray, D: FloatArray, omega: FloatArray, discrete: bool
) -> tuple[float, float]:
    gains = gains_at(A, B, C, D, omega, discrete)
    top = int(np.argmax(gains))
    return float(gains[top]), float(omega[top])


def _crossings(A: FloatArray, B: FloatArray, C: FloatArray, D: FloatArray, discrete: bool) -> FloatArray:
    """Return the frequencies of all eigenvalues of the pencil for gamma = 1, with both ends of the axis."""
    from scipy.linalg import eigvals

    (n, m), p = B.shape, len(C)
    spread = math.sqrt((np.linalg.norm(B) or 1.0) / (np.linalg.norm(C) or 1.0))
    B, C = B / spread, C * spread
    zero, last = np.zeros, np.zeros((2 * n + p + m, m + p))
    last[:n, :m], last[n : 2 * n, m:] = B, -C.T
    last[2 * n : 2 * n + p] = np.hstack([D, -np.eye(p)])
    last[2 * n + p :] = np.hstack([-np.eye(m), D.T])
    middle = np.eye(n) if discrete else -A.T
    constant = np.block([[A, zero((n, n))], [zero((n, n)), middle], [C, zero((p, n))], [zero((m, n)), zero((m, n))]])
    linear = zero((2 * n + p + m, 2 * n))
    linear[:n, :n] = np.eye(n)
    if discrete:
        linear[n : 2 * n, n:], linear[2 * n + p :, n:] = A.T, -B.T
    else:
        linear[n : 2 * n, n:], constant[2 * n + p :, n:] = np.eye(n), B.T
    Q, _ = np.linalg.qr(last, mode="complete")
    projection = Q[:, m + p :].T
    alpha, beta = eigvals(projection @ constant, projection @ linear, homogeneous_eigvals=True)
    if discrete:
        omega = np.abs(np.angle(alpha * np.conj(beta)))
        return np.unique(np.concatenate([omega, [0.0, math.pi]]))
    finite = np.abs(beta) > 0.0
    with np.errstate(over="ignore"):
        omega = np.abs((alpha[finite] / beta[finite]).imag)
    return np.unique(np.concatenate([omega[np.isfinite(omega)], [0.0]]))
