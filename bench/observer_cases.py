"""What bench/observer.py runs: observers, the textbook's loop over their equations, and the recursion in C."""

from __future__ import annotations

import ctypes
import math
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from gains.analysis.augment import augment, error_model
from gains.plants.discretise import discretise
from gains.plants.model_file import builtin_model
from gains.plants.plant import Disturbance, Fault, Noise, Plant
from gains.synthesis.certificate import Certificate, certify
from gains.synthesis.compilation import compile_gains
from gains.synthesis.convex import design_convex
from gains.synthesis.design import Design, observer_matrices
from gains.synthesis.gains_file import Gains
from monitor.estimation.observer import ObserverRun

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from random_gains import random_gains

Array = NDArray[np.float64]
SOURCE = Path(__file__).with_name("recursion.c")


class Estimates(NamedTuple):
    """Estimates of one observer over N samples: x (N, n), fault (N, a1 + a2) and residual (N, p)."""

    x: Array
    fault: Array
    residual: Array


def joined(run: ObserverRun) -> Estimates:
    """Return the estimates of the single hypothesis of a run."""
    return Estimates(run.x[:, 0], run.fault, run.residual[:, 0])


@dataclass(frozen=True)
class Case:
    """An observer, the discrete plant it is of, and signals to run it on, (N, s) and (N, p)."""

    name: str
    plant: Plant
    gains: Gains
    u: Array
    y: Array


def arm_case(count: int) -> Case:
    """Return the arm's observer at 100 Hz on the paper's second case, repeated."""
    from adapters.simulation.arm import SCENARIOS, simulate_arm

    plant = builtin_model("arm-disturbed")
    design = design_convex(plant, 100.0, gain_weight=1e-6)
    run = simulate_arm(SCENARIOS["case2"], 50.0, 100.0)
    times = -(-count // len(run.u))
    u, y = np.tile(run.u, (times, 1))[:count], np.tile(run.y, (times, 1))[:count]
    return Case("arm", discretise(plant, 100.0), compile_gains(plant, design, certify(plant, design)), u, y)


def linear_case(count: int, states: int = 12, actuators: int = 5, sensors: int = 5) -> Case:
    """Return a linear observer with injection gains of a Kalman filter: made in no time, certified for nothing."""
    plant = linear_plant(states, actuators, sensors)
    augmentation = augment(plant)
    model = error_model(plant, augmentation)
    Sigma = scipy.linalg.solve_discrete_are(
        model.A[0].T, model.C.T, model.B @ model.B.T, model.D @ model.D.T, s=model.B @ model.D.T
    )
    L = np.linalg.solve(
        model.C @ Sigma @ model.C.T + model.D @ model.D.T, (model.A[0] @ Sigma @ model.C.T + model.B @ model.D.T).T
    ).T
    nz, p = augmentation.F.shape
    design = Design(
        method="convex",
        rate_hz=100.0,
        gains=observer_matrices(augmentation, L[:nz], L[nz:], np.zeros((actuators, p))),
        P=np.eye(len(L)),
        mu=math.inf,
    )
    unproven = Certificate(True, "vertices", 0, math.nan, math.nan, math.nan, math.nan, math.nan)
    rng = np.random.default_rng(0)
    u, y = rng.normal(size=(count, actuators)), rng.normal(size=(count, states))
    name = f"linear, {states} states, {actuators + sensors} faults"
    return Case(name, plant, compile_gains(plant, design, unproven), u, y)


def linear_plant(states: int, actuators: int, sensors: int) -> Plant:
    """Return a stable discrete plant with a sensor for each state and random faults."""
    rng = np.random.default_rng(states)
    unit = np.eye(states)
    return Plant(
        name="linear",
        domain="discrete",
        rate_hz=100.0,
        states=tuple(f"x{i}" for i in range(states)),
        inputs=tuple(f"u{i}" for i in range(actuators)),
        outputs=tuple(f"y{i}" for i in range(states)),
        A=0.95 * np.linalg.qr(rng.normal(size=(states, states)))[0],
        B=rng.normal(size=(states, actuators)),
        C=unit,
        faults=(
            *(Fault(f"actuator{i}", "actuator", rng.normal(size=states)) for i in range(actuators)),
            *(Fault(f"sensor{i}", "sensor", unit[i]) for i in range(sensors)),
        ),
        disturbances=tuple(Disturbance(f"d{i}", unit[i], 0.1) for i in range(states)),
        noises=tuple(Noise(f"w{i}", unit[i], 0.1) for i in range(states)),
    )


def random_case(count: int, states: int, outputs: int, faults: int, nonlinear: int = 0) -> Case:
    """Return an observer with random matrices of given sizes; there is no plant that it would be of."""
    gains = random_gains(states, states, outputs, faults, inputs=4, nonlinearities=("sin(v)",) * nonlinear)
    rng = np.random.default_rng(0)
    return Case("random", linear_plant(1, 0, 0), gains, rng.normal(size=(count, 4)), rng.normal(size=(count, outputs)))


def ordered_step(gains: Gains) -> Array:
    """Return the rows of an observer's step matrix as [s+; x^; fa^; fs^; yt], the order of its estimates."""
    n, a, ns = len(gains.states), len(gains.faults), len(gains.initial_matrix)
    a1 = gains.fault_kinds.count("actuator")
    fs, fa = ns + n + np.arange(a - a1), ns + n + a - a1 + np.arange(a1)
    return gains.step_matrix[np.concatenate([np.arange(ns + n), fa, fs, np.arange(ns + n + a, len(gains.step_matrix))])]


def textbook(case: Case) -> Callable[[Array, Array], Estimates]:
    """Return the loop over samples that writes the observer's equations as they stand in the theory."""
    plant, gains = case.plant, case.gains
    n, a1 = len(plant.states), len(plant.actuator_faults)
    A, C_b = plant.A, augment(plant).C_b
    N, J, L1, F, L_p, L_i = gains.N, gains.J, gains.L1, gains.F, gains.L_p, gains.L_i
    moved = bool(gains.L_q.size)
    L_q, F_q = (gains.L_q, gains.F_q) if moved else (np.zeros((len(L_i), n)), np.zeros_like(L_i))
    B, c, G, E_f = plant.B, plant.c, plant.G, plant.E_f
    H, H_v, h, H_f = plant.H, plant.H_known[:, :-1], plant.H_known[:, -1], plant.H_f
    nonlinear = bool(plant.nonlinearities)

    def run(u: Array, y: Array) -> Estimates:
        start = gains.initial_matrix @ np.concatenate([u[0], y[0], [1.0]])
        eta, q = start[: len(N)], start[len(N) : len(N) + a1]
        found = Estimates(np.empty((len(u), n)), np.empty((len(u), len(gains.faults))), np.empty_like(y))
        for k in range(len(u)):
            zeta = eta + F @ y[k]
            yt = y[k] - C_b @ zeta
            if moved:
                q = q + F_q @ y[k]
            fa = q + L_p @ yt
            x = zeta[:n]
            force = B @ u[k] + c + E_f @ fa
            if nonlinear:
                force = force + G @ np.sin(H @ x + H_v @ u[k] + h + H_f @ q)
            eta = N @ eta + J @ y[k] + L1 @ force
            q = q + L_i @ yt
            if moved:
                q = q + L_q @ (A @ x + force)
            found.x[k] = x
            found.fault[k] = np.concatenate([fa, zeta[n:]])
            found.residual[k] = yt
        return found

    return run


def in_c(case: Case, folder: Path) -> Callable[[Array, Array], Estimates] | None:
    """Return the recursion compiled with ``cc -O2``, or None where there is no compiler."""
    compiler = shutil.which("cc")
    if compiler is None:
        return None
    library = folder / "recursion.so"
    if not library.exists():
        command = [compiler, "-O2", "-shared", "-fPIC", "-o", library, SOURCE, "-lm"]
        subprocess.run(command, check=True)  # noqa: S603  # our own source, the system's compiler
    function = ctypes.CDLL(str(library)).run
    gains, rows = case.gains, ordered_step(case.gains)
    step, arguments = np.ascontiguousarray(rows.T), np.ascontiguousarray(gains.argument_matrix.T)
    s, p, m, ns = len(gains.inputs), len(gains.outputs), len(gains.nonlinearities), len(gains.initial_matrix)
    ends = np.cumsum([len(gains.states), len(gains.faults)]).tolist()
    sizes = [ctypes.c_long(size) for size in (ns, s, p, m, len(rows))]

    def run(u: Array, y: Array) -> Estimates:
        state = gains.initial_matrix @ np.concatenate([u[0], y[0], [1.0]])
        out = np.empty((len(u), len(rows) - ns))
        arrays = [ctypes.c_void_p(array.ctypes.data) for array in (step, arguments, state, u, y)]
        failed = function(*sizes, *arrays, ctypes.c_long(len(u)), ctypes.c_void_p(out.ctypes.data))
        assert not failed
        return Estimates(*np.split(out, ends, axis=1))

    return run
