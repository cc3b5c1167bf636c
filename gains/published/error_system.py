"""The error system of any linear observer with scalar nonlinearities, derived from plant and observer alone.

For the observer s' = A_o s + B_y y + M (B v + G g(H x^) + c), [x^; f_s^; fa^] = C_e s + D_e y the errors do not depend
on x, u and constant faults exactly when X, Y_a and Y_s exist with

    A_o X + B_y C = X A          C_e X + D_e C   = [I; 0; 0]      X [B, G, c] = M [B, G, c]
    A_o Y_a = X E_f              C_e Y_a         = [0; 0; I]
    A_o Y_s + B_y D_f = 0        C_e Y_s + D_e D_f = [0; I; 0]

Then xi = X x + Y_a f_a + Y_s f_s + Y_w w - s obeys, with slopes Delta of g, w = [w_1; w_2], E = [E_1 0], D = [0 D_1]
and [C_x, D_x] the rows of [C_e, D_e] for x^,

    xi' = (A_o + M G Delta H C_x) xi + (X E - B_y D - A_o Y_w - M G Delta H (C_x Y_w + D_x D)) w
          + Y_w w' + Y_a fa' + Y_s fs'
    e   = C_e xi - (C_e Y_w + D_e D) w          e = [x~; f_s~; fa~]

Y_w is free: it moves the direct path of the noise into w'. The transfer from w is the same for every choice, the norm
against w and w' as independent signals is not: ``"zeta"`` removes the direct path from [x~; f_s~] as the theory does,
``"all"`` from all of e as the printed inequalities do. Y_s is zero if an observer needs no assumption about f_s.
"""

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from adapters.errors import ModelError
from gains.analysis.augment import slope_matrix, slope_vertices
from gains.analysis.hinf import StateSpace, hinf_norm
from gains.plants.plant import FloatArray, Plant
from gains.synthesis.continuous_observer import ContinuousObserver

NoisePath = Literal["zeta", "all"]
Inputs = Literal["all", "disturbances"]

_TOLERANCE = 1e-6
"""Residual of a matrix equation that counts as rounding, as a share of its solution's largest entry: gains may reach
1e5."""
_CONSISTENCY = 1e-6
"""Relative tolerance of a bound: the solver's own."""


@dataclass(frozen=True, slots=True)
class ErrorNorm:
    """H-infinity norm of the scaled error system: infinite if it is unstable.

    ``value`` is a gain of the system, exact to nine digits, at the worst slope vertex, ``slopes``, and at the frequency
    ``hz``, which is infinite if the direct path has the largest gain; ``pole_max`` is the largest real part of a pole
    over the vertices, 1/s.
    """

    value: float
    hz: float
    slopes: tuple[float, ...]
    pole_max: float

    def confirms(self, sqrt_mu: float) -> bool:
        """Return whether a bound holds: the system is stable, and its norm not above the bound."""
        return self.pole_max < 0.0 and self.value <= sqrt_mu * (1.0 + _CONSISTENCY)


def published_error_system(
    plant: Plant, observer: ContinuousObserver, slopes: FloatArray, *, noise_path: NoisePath = "zeta"
) -> StateSpace:
    """Return the scaled error system of an observer, of any order, at given slopes of all arguments (arguments,).

    Its inputs are [w; w'; fa'; fs'], each divided by its scale or rate, its outputs e = [x~; f_s~; fa~], each divided
    by the error that matters. Columns of fs' are zero if an observer needs no assumption about f_s. ``noise_path``
    names the errors from which the direct path of the noise is removed.

    Raises
    ------
    ModelError
        The observer's error depends on the state, the inputs or constant faults.
    """
    n, a2, ne, ns = len(plant.states), len(plant.sensor_faults), len(plant.errors), len(observer.step)
    A_o, B_y, C_e, D_e = observer.A, observer.B_y, observer.output[:ne, :ns], observer.output[:ne, ns:]
    X, Y_a, Y_s = _coordinates(plant, observer)
    freed = n + a2 if noise_path == "zeta" else ne
    Y_w = -np.linalg.pinv(C_e[:freed]) @ D_e[:freed] @ plant.D
    sloped = observer.into @ plant.G @ slope_matrix(plant, slopes) @ plant.H
    B_w = X @ plant.E - B_y @ plant.D - A_o @ Y_w - sloped @ (C_e[:n] @ Y_w + D_e[:n] @ plant.D)
    moved = [Y * [fault.rate for fault in f] for Y, f in ((Y_a, plant.actuator_faults), (Y_s, plant.sensor_faults))]
    B = np.hstack([B_w, Y_w, *moved])
    direct = np.zeros((ne, B.shape[1]))
    direct[:, : Y_w.shape[1]] = -(C_e @ Y_w + D_e @ plant.D)
    weights = 1.0 / plant.errors[:, None]
    return StateSpace(A_o + sloped @ C_e[:n], B, weights * C_e, weights * direct)


def error_norm(
    plant: Plant, observer: ContinuousObserver, *, noise_path: NoisePath = "zeta", inputs: Inputs = "all"
) -> ErrorNorm:
    """Return the norm of an observer's error over all slope vertices.

    The norm is against [w; w'; fa'], or with ``"disturbances"`` against [w; w'] alone, with every fault constant.
    """
    norms: list[ErrorNorm] = []
    kept = 2 * plant.D.shape[1] + (len(plant.actuator_faults) if inputs == "all" else 0)
    for slopes in slope_vertices(plant):
        A, B, C, D = published_error_system(plant, observer, slopes, noise_path=noise_path)
        norm = hinf_norm(A, B[:, :kept], C, D[:, :kept], discrete=False)
        pole = float(np.max(np.linalg.eigvals(A).real))
        norms.append(ErrorNorm(norm.lower, norm.omega / (2.0 * math.pi), tuple(slopes.tolist()), pole))
    worst = max(norms, key=lambda norm: norm.value)
    return replace(worst, pole_max=max(norm.pole_max for norm in norms))


def _coordinates(plant: Plant, observer: ContinuousObserver) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return X (ns, n), Y_a (ns, a1) and Y_s (ns, a2) of the module docstring."""
    n, ns, ne, a2 = len(plant.states), len(observer.step), len(plant.errors), len(plant.sensor_faults)
    errors, I_n, I_s = np.eye(ne), np.eye(n), np.eye(ns)
    C_e, D_e = observer.output[:ne, :ns], observer.output[:ne, ns:]
    driven = np.hstack([plant.B, plant.G, plant.c[:, None]])
    # vec(M X) = (M kron I) vec(X) and vec(X M) = (I kron M^T) vec(X) for X read row by row
    products = [np.kron(observer.A, I_n) - np.kron(I_s, plant.A.T), np.kron(C_e, I_n), np.kron(I_s, driven.T)]
    right = [-observer.B_y @ plant.C, errors[:, :n] - D_e @ plant.C, observer.into @ driven]
    sides = np.concatenate([side.ravel() for side in right])[:, None]
    X = _solved(plant, observer, np.vstack(products), sides, "the states or the inputs").reshape(ns, n)
    stacked = np.vstack([observer.A, C_e])
    constant = np.vstack([X @ plant.E_f, errors[:, n + a2 :]])
    Y_a = _solved(plant, observer, stacked, constant, "constant actuator faults")
    constant = np.vstack([-observer.B_y @ plant.D_f, errors[:, n : n + a2] - D_e @ plant.D_f])
    Y_s = _solved(plant, observer, stacked, constant, "constant sensor faults")
    return X, Y_a, Y_s


def _solved(plant: Plant, observer: ContinuousObserver, M: FloatArray, right: FloatArray, what: str) -> FloatArray:
    """Return the solution of M X = right, rows scaled to one; raise an error if there is none."""
    size = np.linalg.norm(np.hstack([M, right]), axis=1, keepdims=True)
    size[size == 0.0] = 1.0
    solution, *_ = np.linalg.lstsq(M / size, right / size, rcond=None)
    miss = float(np.max(np.abs((M @ solution - right) / size), initial=0.0))
    if not miss <= _TOLERANCE * max(1.0, float(np.max(np.abs(solution), initial=0.0))):
        raise ModelError(f"{plant.name}: the error of the {observer.method} observer depends on {what}")
    return np.asarray(solution, dtype=np.float64)
