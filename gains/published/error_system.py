"""The error system of any linear observer with scalar nonlinearities, found from plant and observer alone.

For the observer s' = A_o s + B_y y + B_v v + B_g g(nu) + b, [x^; f_s^; fa^] = C_e s + D_e y, nu = C_nu s + D_nu y
the errors do not depend on x, u and constant faults exactly when X, Y_a and Y_s exist with

    A_o X + B_y C = X A          C_e X + D_e C   = [I; 0; 0]      C_nu X + D_nu C     = H
    A_o Y_a = X E_f              C_e Y_a         = [0; 0; I]      C_nu Y_a            = 0
    A_o Y_s + B_y D_f = 0        C_e Y_s + D_e D_f = [0; I; 0]    C_nu Y_s + D_nu D_f = 0
    X B = B_v                    X G = B_g                        X c                 = b

Then xi = X x + Y_a f_a + Y_s f_s + Y_w w - s obeys, with slopes Delta of g, w = [w_1; w_2], E = [E_1 0], D = [0 D_1],

    xi' = (A_o + B_g Delta C_nu) xi + (X E - B_y D - A_o Y_w - B_g Delta (C_nu Y_w + D_nu D)) w
          + Y_w w' + Y_a fa' + Y_s fs'
    e   = C_e xi - (C_e Y_w + D_e D) w          e = [x~; f_s~; fa~]

Y_w is free: it moves the direct path of the noise into w'. The transfer from w is the same for every choice, the norm
against w and w' taken apart is not: ``"zeta"`` frees [x~; f_s~] of it as the theory does, ``"all"`` all of e as the
printed inequalities do. Y_s is zero where an observer needs no assumption about f_s.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from adapters.errors import ModelError
from gains.analysis.augment import slope_vertices
from gains.analysis.hinf import hinf_norm
from gains.plants.plant import FloatArray, Plant
from gains.synthesis.continuous_observer import ContinuousObserver

NoisePath = Literal["zeta", "all"]
Inputs = Literal["all", "disturbances"]

_TOLERANCE = 1e-6
"""Of the largest entry: what rounding leaves of matrix equations whose gains may reach 1e5."""
_CONSISTENCY = 1e-6
"""Relative: what the solver may leave of its own bound."""


class StateSpace(NamedTuple):
    """xi' = A xi + B r, e = C xi + D r."""

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray


@dataclass(frozen=True, slots=True)
class ErrorNorm:
    """H-infinity norm of the scaled error system: infinite where it is unstable.

    Parameters
    ----------
    value : float
        A gain that the system has, exact to nine digits, worst slope vertex.
    hz : float
        Its frequency (infinite where the direct path is the largest).
    slopes : tuple[float, ...]
        Its vertex.
    pole_max : float
        Largest real part of a pole over the vertices, 1/s.
    """

    value: float
    hz: float
    slopes: tuple[float, ...]
    pole_max: float

    def confirms(self, sqrt_mu: float) -> bool:
        """Return whether a bound stands: stable, and the norm not above it."""
        return self.pole_max < 0.0 and self.value <= sqrt_mu * (1.0 + _CONSISTENCY)


def published_error_system(
    plant: Plant,
    observer: ContinuousObserver,
    slopes: FloatArray,
    *,
    noise_path: NoisePath = "zeta",
    sensor_fault_rates: bool = False,
) -> StateSpace:
    """Return the scaled error system of an observer at given slopes.

    Parameters
    ----------
    plant : Plant
        Continuous model with its scales.
    observer : ContinuousObserver
        An observer of it, of any order.
    slopes : FloatArray
        Slope of each argument of each nonlinearity (arguments,).
    noise_path : {"zeta", "all"}
        Which errors are freed of the direct path of the noise.
    sensor_fault_rates : bool
        Whether fs' is an input too (each in units of its rate); zero columns where no assumption is needed.

    Returns
    -------
    StateSpace
        From [w; w'; fa'; (fs')], each divided by its scale or rate, to e = [x~; f_s~; fa~], each divided by the error
        that matters.

    Raises
    ------
    ModelError
        The observer's error depends on the state, the inputs or constant faults.
    """
    n, p = len(plant.states), len(plant.outputs)
    a1, a2 = len(plant.actuator_faults), len(plant.sensor_faults)
    ne = n + a2 + a1
    A_o, B_y, C_e, D_e = observer.A, observer.B_y, observer.C[:ne], observer.D_y[:ne]
    rows = argument_rows(plant)
    X, Y_a, Y_s = _coordinates(plant, observer, rows)
    noise = np.array([w.scale for w in plant.noises])
    disturbance = np.array([w.scale for w in plant.disturbances])
    E = np.hstack([plant.E_1 * disturbance, np.zeros((n, len(noise)))])
    D = np.hstack([np.zeros((p, len(disturbance))), plant.D_1 * noise])
    freed = n + a2 if noise_path == "zeta" else ne
    Y_w = -np.linalg.pinv(C_e[:freed]) @ D_e[:freed] @ D
    sloped = observer.B_g @ slope_matrix(plant, slopes)
    B_w = X @ E - B_y @ D - A_o @ Y_w - sloped @ (observer.C_nu @ Y_w + observer.D_nu @ D)
    rates = [fault.rate for fault in plant.actuator_faults]
    inputs = [B_w, Y_w, Y_a * rates]
    if sensor_fault_rates:
        inputs.append(Y_s * [fault.rate for fault in plant.sensor_faults])
    B = np.hstack(inputs)
    direct = np.zeros((ne, B.shape[1]))
    direct[:, : D.shape[1]] = -(C_e @ Y_w + D_e @ D)
    errors = [fault.error for fault in (*plant.sensor_faults, *plant.actuator_faults)]
    weights = 1.0 / np.concatenate([plant.state_errors, errors])[:, None]
    return StateSpace(A_o + sloped @ observer.C_nu, B, weights * C_e, weights * direct)


def error_norm(
    plant: Plant, observer: ContinuousObserver, *, noise_path: NoisePath = "zeta", inputs: Inputs = "all"
) -> ErrorNorm:
    """Return the norm of an observer's error over all slope vertices.

    Parameters
    ----------
    plant, observer, noise_path
        As in :func:`error_system`.
    inputs : {"all", "disturbances"}
        Against [w; w'; fa'], or against [w; w'] alone with every fault constant.

    Raises
    ------
    ModelError
        As :func:`error_system`.
    InfeasibleError
        Too many slopes vary.
    """
    norms: list[ErrorNorm] = []
    kept = 2 * (len(plant.disturbances) + len(plant.noises))
    for slopes in slope_vertices(plant):
        A, B, C, D = published_error_system(plant, observer, slopes, noise_path=noise_path)
        used = slice(None) if inputs == "all" else slice(kept)
        norm = hinf_norm(A, B[:, used], C, D[:, used], discrete=False)
        pole = float(np.max(np.linalg.eigvals(A).real))
        norms.append(ErrorNorm(norm.lower, norm.omega / (2.0 * math.pi), tuple(slopes.tolist()), pole))
    worst = max(norms, key=lambda norm: norm.value)
    return replace(worst, pole_max=max(norm.pole_max for norm in norms))


def argument_rows(plant: Plant) -> FloatArray:
    """Return H: the arguments of all nonlinearities, one after the other, are H x (arguments, n)."""
    return np.vstack([np.zeros((0, len(plant.states))), *(g.rows for g in plant.nonlinearities)])


def slope_matrix(plant: Plant, slopes: FloatArray) -> FloatArray:
    """Return Delta (m, arguments): g moves by Delta times the change of the arguments."""
    counts = [len(g.arguments) for g in plant.nonlinearities]
    owner = np.repeat(np.eye(len(counts)), counts, axis=1)
    return np.asarray(owner * slopes, dtype=np.float64)


def _coordinates(
    plant: Plant, observer: ContinuousObserver, rows: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return X (ns, n), Y_a (ns, a1) and Y_s (ns, a2) of the module docstring."""
    n, ns = len(plant.states), len(observer.A)
    a1, a2 = len(plant.actuator_faults), len(plant.sensor_faults)
    ne = n + a2 + a1
    errors, I_n = np.eye(ne), np.eye(n)
    seen = np.vstack([observer.C[:ne], observer.C_nu])
    direct = np.vstack([observer.D_y[:ne], observer.D_nu])
    wanted = np.vstack([errors[:, :n], rows])
    driven = np.hstack([plant.B, plant.G, plant.c[:, None]])
    # vec(M X) = (M kron I) vec(X) and vec(X M) = (I kron M^T) vec(X) for X read row by row
    X = _solved(
        plant,
        observer,
        np.vstack(
            [
                np.kron(observer.A, I_n) - np.kron(np.eye(ns), plant.A.T),
                np.kron(seen, I_n),
                np.kron(np.eye(ns), driven.T),
            ]
        ),
        np.concatenate(
            [
                -(observer.B_y @ plant.C).ravel(),
                (wanted - direct @ plant.C).ravel(),
                np.hstack([observer.B_v, observer.B_g, observer.b[:, None]]).ravel(),
            ]
        )[:, None],
        "the states or the inputs",
    ).reshape(ns, n)
    stacked = np.vstack([observer.A, seen])
    no_rows = np.zeros((len(rows), a1))
    Y_a = _solved(
        plant,
        observer,
        stacked,
        np.vstack([X @ plant.E_f, errors[:, n + a2 :], no_rows]),
        "constant actuator faults",
    )
    through = np.vstack([errors[:, n : n + a2], np.zeros((len(rows), a2))]) - direct @ plant.D_f
    Y_s = _solved(plant, observer, stacked, np.vstack([-observer.B_y @ plant.D_f, through]), "constant sensor faults")
    return X, Y_a, Y_s


def _solved(plant: Plant, observer: ContinuousObserver, M: FloatArray, right: FloatArray, what: str) -> FloatArray:
    """Return the solution of M X = right, rows scaled to one; refuse where there is none."""
    size = np.linalg.norm(np.hstack([M, right]), axis=1, keepdims=True)
    size[size == 0.0] = 1.0
    solution, *_ = np.linalg.lstsq(M / size, right / size, rcond=None)
    miss = float(np.max(np.abs((M @ solution - right) / size), initial=0.0))
    if not miss <= _TOLERANCE * max(1.0, float(np.max(np.abs(solution), initial=0.0))):
        raise ModelError(f"{plant.name}: the error of the {observer.method} observer depends on {what}")
    return np.asarray(solution, dtype=np.float64)
