"""The augmented state zeta = [x; f_s] and the error system that the injection gains close.

With T = [I 0], A_z = [A 0], Cb = [C D_f], E = [E_1 0], D = [0 D_1] and a left inverse of Theta = [T; Cb],
[L1 F; L_q F_q] Theta = [I; 0], the observer

    zeta^ = eta + F y,   x^ = T zeta^       q^ = q + F_q y,   fa^ = q^ + L_p yt       yt = y - Cb zeta^
    eta+  = L1 x^+ + K yt                   q+ = q^ + L_q x^+ + L_i yt
    x^+   = A x^ + B v + c + G g(nu^) + E_f fa^,   nu^ = H x^ + H_v v + h + H_f q^

(eta+ = N eta + J y + L1 (B v + c + G g + E_f fa^) with N = L1 A_z - K Cb, J = N F + K) has the errors
zeta~ = zeta - zeta^ and z = f_a - q^ with, for [Kb; L_ib] = [K; L_i] + [L1; L_q] E_f L_p and slopes Delta of g,

    [zeta~; z]+ = ( [L1; L_q] [A_z + G Delta H T, E_f + G Delta H_f] + [0 0; 0 I] - [Kb; L_ib] [Cb 0] ) [zeta~; z]
                  + ( [L1 E, -F D, 0; L_q E, -F_q D, I] - [Kb; L_ib] [D 0 0] ) [w; w+; df_a]
    e = [zeta~; fa~],   fa~ = z - L_p (Cb zeta~ + D w),   df_a = f_a+ - f_a

Every left inverse is [L1 F] = [L1_0 F_0] + Y [W1 W2], [W1 W2] Theta = 0, with any Y (na, k): the last rows of Y are
[L_q F_q]. The published observer has the pseudo-inverse and no L_q, F_q.

For actuator faults that ramp, integrators of order 2 estimate their rate r = (f_a+ - f_a) / T too:

    q1+ = q1^ + T q2^ + L_i1 yt,   q2+ = q2^ + L_i2 yt,   fa^ = q1^ + L_p yt,   z = [f_a - q1^; r - q2^]

so that A_a has [I, T I; 0, I] for its last I, and r+ - r takes the place of df_a.

With the slopes anywhere between their bounds, the part of A_a with Delta is that of their mean plus Gs diag(delta) Hs
with |delta_i| <= 1: a column of Gs and a row of Hs for each slope that varies.

A noise that passes through F counts twice in [w; w+]. If F moves f_s^ alone, f_s^ = D_f^+ (y - C x^), it can count once
(``noise_once``): xi = [zeta~ + F D w; z] is moved by w alone,

    xi+ = (as above) xi + ( [L1 E, 0; L_q E, I] - [Kb; L_ib] [D - Cb F D, 0] ) [w; df_a],   zeta~ = xi_zeta - F D w

because neither A_a nor the slopes depend on f_s. In discrete time this x^ does not contain the output of its own
sample, so that what is published is zeta^ + L_z yt, with the error zeta~ - L_z (Cb zeta~ + D w); what the observer goes
on with, and the arguments of g, stay zeta^.

Each w is divided by its scale, df_a (or r+ - r) by rate / rate_hz, and each error by the size that matters.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np

from adapters.errors import InfeasibleError, ModelError
from gains.plants.plant import FloatArray, Plant, check_independence

LARGEST_VERTEX_COUNT = 1 << 10
"""Largest number of varying slopes whose vertices are enumerated: ten. Each vertex is one more inequality for the
solver; beyond, the proof by multipliers replaces them."""
SAMPLE_COUNT = 64
"""Number of vertices at which norms and floors are computed if there are more. Fewer make a floor smaller and a norm
less certain, never wrong: only the time decides (measured: .6 ms for the norm of a system of six states)."""


@dataclass(frozen=True, slots=True, eq=False)
class Augmentation:
    """A left inverse of [T; Cb], and its free part."""

    # (nz, n), (nz, p), (nq, n) and (nq, p)
    L1: FloatArray
    F: FloatArray
    L_q: FloatArray
    F_q: FloatArray
    # basis (k, n + p) of the left null space of [T; Cb]
    W1: FloatArray
    W2: FloatArray
    # (n, nz) and (p, nz)
    A_z: FloatArray
    C_b: FloatArray
    noise_once: bool = False  # whether its error system is that of [w; df_a], in which noise counts once

    def moved(self, Y: FloatArray) -> Augmentation:
        """Return the left inverse with Y [W1 W2] added, Y (nz + nq, k)."""
        zeta, q = Y[: len(self.L1)], Y[len(self.L1) :]
        return replace(
            self,
            L1=self.L1 + zeta @ self.W1,
            F=self.F + zeta @ self.W2,
            L_q=self.L_q + q @ self.W1,
            F_q=self.F_q + q @ self.W2,
        )


@dataclass(frozen=True, slots=True, eq=False)
class ErrorModel:
    """The error system before injection, with weights applied to its inputs."""

    name: str  # the plant's name, for errors
    # slope of each argument of each nonlinearity at each vertex (vertices, arguments), or at some of them
    slopes: FloatArray
    A: FloatArray  # A_a at each of these (vertices, na, na), na = nz + a1, or nz + 2 a1 with integrators of order 2
    mean: FloatArray  # A_a at the mean slopes (na, na)
    # Gs (na, k) and Hs (k, na) of the k slopes that vary
    G: FloatArray
    H: FloatArray
    # (na, nw), (p, na) and (p, nw); columns of B and D: [w; w+; df_a], each in units of its scale, or [w; df_a] if
    # noise counts once
    B: FloatArray
    C: FloatArray
    D: FloatArray
    direct: FloatArray  # direct path from w to zeta~ (nz, nw): -F D if noise counts once, otherwise zero
    into: FloatArray  # [L1; L_q] E_f (na, a1)
    weights: FloatArray  # one over the error that matters, for each entry of e (nz + a1,)
    a1: int  # number of actuator faults: the last entries of e, and their errors after zeta~ in [zeta~; z]
    fixed: int  # number of entries of e, the first ones, without a direct gain: nz, or none with an L_z
    free: FreeRows  # effect of moving the left inverse

    @property
    def sizes(self) -> FloatArray:
        """Size of each entry of [zeta~; z]: the error that matters, for the rate of a fault that error per second."""
        errors = 1.0 / self.weights
        return np.concatenate([errors, errors[len(errors) - self.a1 :]])[: len(self.B)]

    def injection(self, K: FloatArray, L_i: FloatArray, L_p: FloatArray) -> FloatArray:
        """Return [Kb; L_ib] (na, p)."""
        return np.vstack([K, L_i]) + self.into @ L_p

    def output(self, L_e: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return (C_e, D_e) of the weighted error e for direct gains [L_z; L_p] (nz + a1, p), or L_p alone (a1, p)."""
        (ne, nz), (na, nw) = (len(self.weights), len(self.weights) - self.a1), self.B.shape
        C_e, D_e, first = np.eye(ne, na), np.zeros((ne, nw)), ne - len(L_e)
        D_e[:nz] = self.direct
        C_e[first:] -= L_e @ self.C
        D_e[first:] -= L_e @ self.D
        return self.weights[:, None] * C_e, self.weights[:, None] * D_e


@dataclass(frozen=True, slots=True, eq=False)
class FreeRows:
    """What Y multiplies: A (vertices, k, na), mean (k, na), B (k, nw), G (k, slopes), F (k, p) and into (k, a1)."""

    A: FloatArray
    mean: FloatArray
    B: FloatArray
    G: FloatArray
    F: FloatArray
    into: FloatArray


def augment(plant: Plant, integrator_order: int = 1, *, noise_once: bool = False) -> Augmentation:
    """Return A_z, Cb and the pseudo-inverse of a plant as a left inverse, with its free part.

    [L1 F] is the pseudo-inverse of [T; Cb] with each row in units of the error that matters there, for a state its own
    and for an output the largest that a state's error causes: a change of units does not change the observer. If all of
    those are one, it is the plain pseudo-inverse of docs/theory.md. For a bound against [w; df_a] (``noise_once``) F
    moves f_s^ alone.

    Raises
    ------
    ModelError
        Directions of faults depend on each other.
    """
    check_independence(plant)
    n, a2, nq = len(plant.states), len(plant.sensor_faults), integrator_order * len(plant.actuator_faults)
    T = np.eye(n, n + a2)
    C_b = np.hstack([plant.C, plant.D_f])
    largest = np.max(np.abs(plant.C) * plant.state_errors, axis=1)
    rows = 1.0 / np.concatenate([plant.state_errors, np.where(largest > 0.0, largest, 1.0)])
    columns = np.concatenate([plant.state_errors, 1.0 / np.max(np.abs(plant.D_f) * rows[n:, None], axis=0)])
    scaled = rows[:, None] * np.vstack([T, C_b]) * columns
    inverse = columns[:, None] * np.linalg.pinv(scaled) * rows
    free = np.linalg.svd(scaled)[0][:, n + a2 :].T * rows
    if noise_once:
        # [I 0; -D_f^+ C, D_f^+], in the same units
        inverse = np.eye(n + a2, n + len(C_b))
        inverse[n:, n:] = columns[n:, None] * np.linalg.pinv(scaled[n:, n:]) * rows[n:]
        inverse[n:, :n] = -inverse[n:, n:] @ plant.C
        free = free[:0]
    return Augmentation(
        L1=inverse[:, :n],
        F=inverse[:, n:],
        L_q=np.zeros((nq, n)),
        F_q=np.zeros((nq, len(C_b))),
        W1=free[:, :n],
        W2=free[:, n:],
        A_z=plant.A @ T,
        C_b=C_b,
        noise_once=noise_once,
    )


def error_model(
    plant: Plant, augmentation: Augmentation, integrator_order: int = 1, *, sampled: bool = False
) -> ErrorModel:
    """Return the error system of a plant at every slope vertex, or at the sample of them of :func:`sampled_vertices`.

    In continuous time ' stands for + and f_a' for df_a, and z has no identity in its dynamics: the identity in A_a
    becomes zero, and f_a' is divided by the fault's rate alone. Integrators have order 1, or in discrete time 2.

    Raises
    ------
    ModelError
        Noise shall count once, but F moves more than f_s^.
    InfeasibleError
        Too many slopes vary to enumerate the vertices, and a sample is not allowed.
    """
    nz, n = augmentation.L1.shape
    a1, p = len(plant.actuator_faults), len(plant.outputs)
    na = nz + a1 * integrator_order
    q = len(plant.disturbances) + len(plant.noises)
    # effect of [x^; q^] on x and on the arguments of g
    moves, arguments = np.zeros((n, na)), np.zeros((len(plant.H), na))
    moves[:, : nz + a1] = np.hstack([augmentation.A_z, plant.E_f])
    arguments[:, :n], arguments[:, nz : nz + a1] = plant.H, plant.H_f
    slopes = sampled_vertices(plant) if sampled else slope_vertices(plant)
    middle, half, into = _slope_ranges(plant)
    sloped = moves + (into * slopes[:, None]) @ arguments
    mean = moves + into * middle @ arguments
    L = np.vstack([augmentation.L1, augmentation.L_q])
    F = np.vstack([augmentation.F, augmentation.F_q])
    still = np.zeros((na, na))
    if plant.rate_hz is not None:
        still[nz:, nz:] = integrators(a1, integrator_order, plant.rate_hz)
    # each column in units of its signal
    steps = np.zeros((na, a1))
    steps[na - a1 :] = np.diag([fault.rate / (plant.rate_hz or 1.0) for fault in plant.actuator_faults])
    # without slopes that are constant or have no effect on the states
    varying = (half > 0.0) & np.any(into, axis=0) & np.any(arguments, axis=1)
    W1, W2 = augmentation.W1, augmentation.W2
    C_a = np.hstack([augmentation.C_b, np.zeros((p, na - nz))])
    B, D = [L @ plant.E, -F @ plant.D, steps], [plant.D, np.zeros((p, q + a1))]
    direct, free_B = [np.zeros((nz, 2 * q + a1))], [W1 @ plant.E, -W2 @ plant.D, np.zeros((len(W1), a1))]
    if augmentation.noise_once:
        if np.any(F[:n]) or np.any(F[nz:]):
            raise ModelError(f"{plant.name}: noise counts twice where outputs move more than sensor faults at once")
        moved, _ = B.pop(1), free_B.pop(1)
        D, direct = [plant.D + C_a @ moved, np.zeros((p, a1))], [moved[:nz], np.zeros((nz, a1))]
    return ErrorModel(
        name=plant.name,
        slopes=slopes,
        A=L @ sloped + still,
        mean=L @ mean + still,
        G=(L @ into * half)[:, varying],
        H=arguments[varying],
        B=np.hstack(B),
        C=C_a,
        D=np.hstack(D),
        direct=np.hstack(direct),
        into=L @ plant.E_f,
        weights=1.0 / plant.errors,
        a1=a1,
        fixed=0 if augmentation.noise_once and plant.rate_hz is not None else nz,
        free=FreeRows(
            A=W1 @ sloped,
            mean=W1 @ mean,
            B=np.hstack(free_B),
            G=(W1 @ into * half)[:, varying],
            F=W2,
            into=W1 @ plant.E_f,
        ),
    )


def integrators(a1: int, order: int, rate_hz: float) -> FloatArray:
    """Return I (order 1) or [I, T I; 0, I] (order 2) with blocks (a1, a1): the dynamics of q and z without inputs."""
    chain = np.array([[1.0, 1.0 / rate_hz], [0.0, 1.0]])[:order, :order]
    return np.kron(chain, np.eye(a1))


def slope_vertices(plant: Plant) -> FloatArray:
    """Return every combination of slope bounds (vertices, arguments); constant slopes do not multiply them.

    Raises
    ------
    InfeasibleError
        There are more than ``LARGEST_VERTEX_COUNT``.
    """
    varying = varying_slopes(plant)
    if 1 << varying > LARGEST_VERTEX_COUNT:
        raise InfeasibleError(
            f"{plant.name}: {varying} slopes vary, which makes 2^{varying} vertices; at most {LARGEST_VERTEX_COUNT} "
            "are handled: hold slopes constant or narrow the nonlinearity; 'fauio design --vertex-free' needs no "
            "vertices"
        )
    bounds = [sorted(set(pair)) for g in plant.nonlinearities for pair in g.slopes.tolist()]
    return np.array(list(itertools.product(*bounds))).reshape(1 << varying, len(bounds))


def sampled_vertices(plant: Plant) -> FloatArray:
    """Return ``SAMPLE_COUNT`` combinations of slope bounds, the lowest, the highest and random ones; fewer are all."""
    if 1 << varying_slopes(plant) <= SAMPLE_COUNT:
        return slope_vertices(plant)
    low, high = np.array([pair for g in plant.nonlinearities for pair in g.slopes.tolist()]).T
    up = np.random.default_rng(0).integers(0, 2, (SAMPLE_COUNT, len(low))) > 0
    up[0], up[1] = False, True
    return np.asarray(np.where(up, high, low), dtype=np.float64)


def varying_slopes(plant: Plant) -> int:
    """Return how many slopes are not constant: the number of vertices is 2 to that power."""
    return sum(low < high for g in plant.nonlinearities for low, high in g.slopes.tolist())


def sloped_dynamics(plant: Plant, *, sampled: bool = False) -> tuple[FloatArray, FloatArray]:
    """Return A + G Delta H (count, n, n) and the slopes (count, arguments), at their mean first, then at every vertex.

    How actuator faults move the states there is E_f + G Delta H_f (:func:`sloped_faults`).

    Where they are ``sampled``, the vertices are those of :func:`sampled_vertices`.
    """
    slopes = sampled_vertices(plant) if sampled else slope_vertices(plant)
    middle, _, into = _slope_ranges(plant)
    if len(slopes) > 1:
        slopes = np.vstack([middle, slopes])
    return np.asarray(plant.A + (into * slopes[:, None]) @ plant.H, dtype=np.float64), slopes


def sloped_faults(plant: Plant, slopes: FloatArray) -> FloatArray:
    """Return E_f + G Delta H_f (n, a1) at slopes (arguments,)."""
    return np.asarray(plant.E_f + _slope_ranges(plant)[2] * slopes @ plant.H_f, dtype=np.float64)


def _slope_ranges(plant: Plant) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the middle and half the width of each slope, and G (n, arguments) of its argument."""
    low, high = np.vstack([np.zeros((0, 2)), *(g.slopes for g in plant.nonlinearities)]).T
    owner = [i for i, g in enumerate(plant.nonlinearities) for _ in g.arguments]
    return 0.5 * (low + high), 0.5 * (high - low), plant.G[:, owner]


def slope_matrix(plant: Plant, slopes: FloatArray) -> FloatArray:
    """Return Delta (..., m, arguments) for slopes (..., arguments): g moves by Delta times the arguments' change."""
    counts = [len(g.arguments) for g in plant.nonlinearities]
    owner = np.repeat(np.eye(len(counts)), counts, axis=1)
    return np.asarray(owner * slopes[..., None, :], dtype=np.float64)
