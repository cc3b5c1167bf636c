"""The augmented state zeta = [x; f_s] and the error system that the injection gains close.

With T = [I 0], A_z = [A 0], Cb = [C D_f], E = [E_1 0], D = [0 D_1] and L1 T + F Cb = I the observer

    eta+ = N eta + J y + L1 (B v + c + G g(x^) + E_f fa^),   zeta^ = eta + F y,   x^ = T zeta^
    q+   = q + L_i yt,   fa^ = q + L_p yt,   yt = y - Cb zeta^,   N = L1 A_z - K Cb,   J = N F + K

has the errors zeta~ = zeta - zeta^ and z = f_a - q with, for Kb = K + L1 E_f L_p and slopes Delta of g,

    [zeta~; z]+ = ( [L1 A_z + L1 G Delta H T, L1 E_f; 0, I] - [Kb; L_i] [Cb 0] ) [zeta~; z]
                  + ( [L1 E, -F D, 0; 0, 0, I] - [Kb; L_i] [D 0 0] ) [w; w+; df_a]
    e = [zeta~; fa~],   fa~ = z - L_p (Cb zeta~ + D w),   df_a = f_a+ - f_a

For actuator faults that ramp, integrators of order 2 estimate their rate r = (f_a+ - f_a) / T too:

    q1+ = q1 + T q2 + L_i1 yt,   q2+ = q2 + L_i2 yt,   fa^ = q1 + L_p yt,   z = [f_a - q1; r - q2]

so that A_a has [I, T I; 0, I] for its last I, [L1 E_f, 0] for L1 E_f, and r+ - r takes the place of df_a.

With the slopes anywhere between their bounds, L1 G Delta H T in A_a is that of their mean plus Gs diag(delta) Hs with
|delta_i| <= 1: a column of Gs and a row of Hs for each slope that varies.

Each w is divided by its scale, df_a (or r+ - r) by rate / rate_hz, and each error by the size that matters.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from adapters.errors import InfeasibleError
from gains.plants.plant import FloatArray, Plant, check_independence

LARGEST_VERTEX_COUNT = 1 << 10
"""Ten varying slopes. Each vertex is one more inequality of the solver; beyond, the proof by multipliers takes their
place.
"""
SAMPLE_COUNT = 64
"""Vertices at which norms and floors are computed where there are more. Fewer make a floor smaller and a norm less
sure, never wrong: a matter of time alone (measured: .6 ms for the norm of a system of six states).
"""


@dataclass(frozen=True, slots=True, eq=False)
class Augmentation:
    """L1 (nz, n), F (nz, p), A_z (n, nz) and Cb (p, nz) of a plant."""

    L1: FloatArray
    F: FloatArray
    A_z: FloatArray
    C_b: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class ErrorModel:
    """The error system before injection, with weights applied to its inputs.

    Parameters
    ----------
    name : str
        The plant's name, for errors.
    slopes : FloatArray
        Slope of each argument of each nonlinearity at each vertex (vertices, arguments), or at some of them.
    A : FloatArray
        A_a at each of these (vertices, na, na), na = nz + a1, or nz + 2 a1 with integrators of order 2.
    mean : FloatArray
        A_a at the mean slopes (na, na).
    G, H : FloatArray
        Gs (na, k) and Hs (k, na) of the k slopes that vary.
    B, C, D : FloatArray
        (na, nw), (p, na) and (p, nw); columns of B and D: [w; w+; df_a], each in units of its scale.
    weights : FloatArray
        One over the error that matters, for each entry of e (nz + a1,).
    a1 : int
        Number of actuator faults: the last entries of e, and their errors after zeta~ in [zeta~; z].
    """

    name: str
    slopes: FloatArray
    A: FloatArray
    mean: FloatArray
    G: FloatArray
    H: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    weights: FloatArray
    a1: int

    @property
    def sizes(self) -> FloatArray:
        """Size of each entry of [zeta~; z]: the error that matters, for the rate of a fault that of it a second."""
        errors = 1.0 / self.weights
        return np.concatenate([errors, errors[len(errors) - self.a1 :]])[: len(self.B)]

    def injection(self, K: FloatArray, L_i: FloatArray, L_p: FloatArray) -> FloatArray:
        """Return [Kb; L_i] (na, p), Kb = K + L1 E_f L_p."""
        nz = len(K)
        return np.vstack([K + self.mean[:nz, nz : nz + self.a1] @ L_p, L_i])

    def output(self, L_p: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return (C_e, D_e) of the weighted error e for the direct gain L_p (a1, p)."""
        (ne, nz), (na, nw) = (len(self.weights), len(self.weights) - self.a1), self.B.shape
        C_e, D_e = np.eye(ne, na), np.zeros((ne, nw))
        C_e[nz:] -= L_p @ self.C
        D_e[nz:] -= L_p @ self.D
        return self.weights[:, None] * C_e, self.weights[:, None] * D_e


def augment(plant: Plant) -> Augmentation:
    """Return L1, F, A_z and Cb of a plant.

    [L1 F] is the pseudo-inverse of [T; Cb] with each row in units of the error that matters there, for a state
    its own and for an output the largest that a state's error makes: the result follows a change of units. Where
    all of those are one it is the plain pseudo-inverse of docs/theory.md.

    Raises
    ------
    ModelError
        Directions of faults depend on each other.
    """
    check_independence(plant)
    n, a2 = len(plant.states), len(plant.sensor_faults)
    T = np.eye(n, n + a2)
    C_b = np.hstack([plant.C, plant.D_f])
    largest = np.max(np.abs(plant.C) * plant.state_errors, axis=1)
    rows = 1.0 / np.concatenate([plant.state_errors, np.where(largest > 0.0, largest, 1.0)])
    columns = np.concatenate([plant.state_errors, 1.0 / np.max(np.abs(plant.D_f) * rows[n:, None], axis=0)])
    scaled = rows[:, None] * np.vstack([T, C_b]) * columns
    inverse = columns[:, None] * np.linalg.pinv(scaled) * rows
    return Augmentation(inverse[:, :n], inverse[:, n:], plant.A @ T, C_b)


def error_model(
    plant: Plant, augmentation: Augmentation, integrator_order: int = 1, *, sampled: bool = False
) -> ErrorModel:
    """Return the error system of a plant at every slope vertex, or at the sample of them of :func:`sampled_vertices`.

    In continuous time ' stands for + and f_a' for df_a, and z does not keep its value by itself: the identity in A_a
    becomes zero, and f_a' is divided by the fault's rate alone. Integrators have order 1, or in discrete time 2.

    Raises
    ------
    InfeasibleError
        More slopes vary than vertices can be enumerated for, and a sample will not do.
    """
    L1, F = augmentation.L1, augmentation.F
    nz, n = L1.shape
    a1, p = len(plant.actuator_faults), len(plant.outputs)
    na = nz + a1 * integrator_order
    q = len(plant.disturbances) + len(plant.noises)
    # A_a = [L1 A_z, L1 E_f; 0, I]
    A_a = np.zeros((na, na))
    A_a[:nz, : nz + a1] = np.hstack([L1 @ augmentation.A_z, L1 @ plant.E_f])
    if plant.rate_hz is not None:
        A_a[nz:, nz:] = integrators(a1, integrator_order, plant.rate_hz)
    # B = [L1 E, -F D, 0; 0, 0, I], each column in units of what drives it
    B = np.zeros((na, 2 * q + a1))
    B[:nz, :q], B[:nz, q : 2 * q] = L1 @ plant.E, -F @ plant.D
    B[na - a1 :, 2 * q :] = np.diag([fault.rate / (plant.rate_hz or 1.0) for fault in plant.actuator_faults])
    slopes = sampled_vertices(plant) if sampled else slope_vertices(plant)
    # Gs and Hs: mean plus Gs diag(delta) Hs, without slopes that are constant or do not reach the error
    middle, half, into, rows = _slope_ranges(plant)
    varying = (half > 0.0) & np.any(L1 @ into, axis=0) & np.any(rows, axis=1)
    G, H = np.zeros((na, np.sum(varying))), np.zeros((np.sum(varying), na))
    G[:nz], H[:, :n] = (L1 @ into * half)[:, varying], rows[varying]
    mean = A_a.copy()
    mean[:nz, :n] += L1 @ into * middle @ rows
    A = np.repeat(A_a[None], len(slopes), axis=0)
    A[:, :nz, :n] += (L1 @ into * slopes[:, None]) @ rows
    return ErrorModel(
        name=plant.name,
        slopes=slopes,
        A=A,
        mean=mean,
        G=G,
        H=H,
        B=B,
        C=np.hstack([augmentation.C_b, np.zeros((p, na - nz))]),
        D=np.hstack([plant.D, np.zeros((p, q + a1))]),
        weights=1.0 / plant.errors,
        a1=a1,
    )


def integrators(a1: int, order: int, rate_hz: float) -> FloatArray:
    """Return I (order 1) or [I, T I; 0, I] (order 2) with blocks (a1, a1): how q and z go on by themselves."""
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

    Where they are ``sampled``, the vertices are those of :func:`sampled_vertices`.

    Raises
    ------
    InfeasibleError
        Too many slopes vary.
    """
    slopes = sampled_vertices(plant) if sampled else slope_vertices(plant)
    middle, _, into, rows = _slope_ranges(plant)
    if len(slopes) > 1:
        slopes = np.vstack([middle, slopes])
    return np.asarray(plant.A + (into * slopes[:, None]) @ rows, dtype=np.float64), slopes


def _slope_ranges(plant: Plant) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the middle and half the width of each slope, and G (n, arguments) and H (arguments, n) of its argument."""
    low, high = np.vstack([np.zeros((0, 2)), *(g.slopes for g in plant.nonlinearities)]).T
    owner = [i for i, g in enumerate(plant.nonlinearities) for _ in g.arguments]
    return 0.5 * (low + high), 0.5 * (high - low), plant.G[:, owner], plant.H


def slope_matrix(plant: Plant, slopes: FloatArray) -> FloatArray:
    """Return Delta (..., m, arguments) for slopes (..., arguments): g moves by Delta times the arguments' change."""
    counts = [len(g.arguments) for g in plant.nonlinearities]
    owner = np.repeat(np.eye(len(counts)), counts, axis=1)
    return np.asarray(owner * slopes[..., None, :], dtype=np.float64)
