"""Other libraries beside ours, in one run on the same data: same work, and same answers where they should agree.

    python bench/peers.py            print the tables
    python bench/peers.py --json     print the same as JSON

Needs the extra ``bench``. Times are processor time a sample, the best of several runs on one core.
Answers that should agree and do not end the run with exit status 1.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import control
import numpy as np
from extended_kalman import ExtendedKalmanFilter
from filterpy.kalman import KalmanFilter
from numpy.typing import NDArray
from observer_cases import Case, joined, linear_case, ordered_step
from scipy.signal import dlsim

from gains.identification.simulation import linearised
from gains.plants.discretise import discretise
from gains.plants.model_file import builtin_model
from gains.plants.plant import Plant
from gains.published.kalman import design_ekf, filter_model
from gains.synthesis.certificate import certify
from gains.synthesis.compilation import compile_gains
from gains.synthesis.convex import design_convex
from monitor.estimation.affine import AffineObserver

RATE_HZ, COUNT, REPEATS = 100.0, 5_000, 3
FAULT_RATE = 20.0
AGREE = 1e-9

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Flight:
    """A run of the linear arm: torque (N, 1), outputs (N, 3), true faults [f_a, f_s] (N, 2)."""

    u: Array
    y: Array
    faults: Array


def linear_arm() -> Plant:
    """Return the disturbed arm linearised at rest and sampled, its faults as fast as in bench/paper.py."""
    arm = builtin_model("arm-disturbed")
    arm = replace(arm, faults=tuple(replace(fault, rate=FAULT_RATE) for fault in arm.faults))
    plant = linearised(arm, np.zeros((1, len(arm.states))))
    return discretise(replace(plant, G=np.zeros((len(plant.states), 0)), nonlinearities=()), RATE_HZ)


def flight(plant: Plant) -> Flight:
    """Simulate the plant with white noise, a torque lost between samples 1000 and 3000, an offset from 2000 on."""
    rng = np.random.default_rng(0)
    k = np.arange(COUNT)
    u = np.sin(0.02 * k)[:, None]
    faults = np.column_stack([-0.3 * u[:, 0] * ((k >= 1000) & (k < 3000)), 0.2 * (k >= 2000)])
    x, y = np.zeros(len(plant.states)), np.empty((COUNT, len(plant.outputs)))
    for i in k:
        y[i] = plant.C @ x + plant.D_f @ faults[i, 1:] + 0.01 * plant.D_1 @ rng.normal(size=plant.D_1.shape[1])
        x = plant.A @ x + plant.B @ u[i] + plant.E_f @ faults[i, :1] + plant.c
        x = x + 0.01 * plant.E_1 @ rng.normal(size=plant.E_1.shape[1])
    return Flight(u, y, faults)


def timed(run: Callable[[], Array], count: int) -> tuple[Array, float]:
    """Return what a run finds and the microseconds it takes for each of its samples."""
    found, best = run(), np.inf
    for _ in range(REPEATS):
        started = time.process_time()
        run()
        best = min(best, time.process_time() - started)
    return found, float(best / count * 1e6)


def kalman_filters() -> dict[str, Any]:
    """Compare Kalman filters of the augmented state, and our observer: estimates of [x; f_a; f_s]."""
    plant = linear_arm()
    data, model = flight(plant), filter_model(plant)
    n, p, na = len(plant.states), len(plant.outputs), len(model.A)
    order = [*range(n), na - 1, *range(n, na - 1)]
    drive = np.vstack([plant.B, np.zeros((na - n, 1))])
    steady = design_ekf(plant)
    design = design_convex(plant, RATE_HZ, gain_weight=1e-6)
    convex = compile_gains(plant, design, certify(plant, design))
    started = ExtendedKalmanFilter(plant)
    started.restart(data.y[0])

    def theirs(full: bool) -> Array:
        filtered = KalmanFilter(dim_x=na, dim_z=p, dim_u=1)
        filtered.F, filtered.H, filtered.B, filtered.Q, filtered.R = model.A, model.C, drive, model.Q, model.R
        filtered.x, filtered.P = started._predicted[:, None].copy(), started._Sigma.copy()
        filtered.K = np.vstack([steady.K, steady.L_p])
        if not full:
            filtered.x = (steady.initial_matrix @ np.concatenate([data.u[0], data.y[0], [1.0]]))[:, None]
        found = np.empty((COUNT, na))
        for k in range(COUNT):
            if full:
                filtered.update(data.y[k][:, None])
                found[k] = filtered.x[:, 0]
                filtered.predict(u=data.u[k][:, None])
            else:
                filtered.update_steadystate(data.y[k][:, None])
                found[k] = filtered.x[:, 0]
                filtered.predict_steadystate(u=data.u[k][:, None])
        return found[:, order]

    def ours() -> Array:
        filtered, found = ExtendedKalmanFilter(plant), np.empty((COUNT, na))
        filtered.restart(data.y[0])
        for k in range(COUNT):
            filtered.step(data.u[k], data.y[k])
            found[k, :n], found[k, n:] = filtered.x, filtered.fault
        return found

    def estimated(gains: Any) -> Array:
        run = AffineObserver([gains]).run(data.u, data.y)
        return np.hstack([run.x[:, 0], run.fault])

    ways: dict[str, tuple[Callable[[], Array], str | None]] = {
        "filterpy, full": (lambda: theirs(True), None),
        "ours, full (gains.published.kalman)": (ours, "filterpy, full"),
        "filterpy, steady state": (lambda: theirs(False), None),
        "ours, steady state": (lambda: estimated(steady), "filterpy, steady state"),
        "our observer (convex)": (lambda: estimated(convex), None),
    }
    found: dict[str, Any] = {}
    estimates: dict[str, Array] = {}
    for name, (run, like) in ways.items():
        estimates[name], us = timed(run, COUNT)
        error = estimates[name][1:, n:] - np.column_stack([data.faults[:-1, 0], data.faults[1:, 1]])
        found[name] = {
            "us": us,
            "f_a": float(np.sqrt(np.mean(error[:, 0] ** 2))),
            "f_s": float(np.sqrt(np.mean(error[:, 1] ** 2))),
            "like": like,
            "difference": None if like is None else difference(estimates[name], estimates[like]),
        }
    return found


def simulations(case: Case) -> dict[str, Any]:
    """Compare simulations of one linear recursion: its estimates."""
    gains, step = case.gains, ordered_step(case.gains)
    ns = len(gains.initial_matrix)
    A, B = np.split(step[:ns], [ns], axis=1)
    C, D = np.split(step[ns:], [ns], axis=1)
    w = np.column_stack([case.u, case.y, np.ones(len(case.u))])
    start, step_s = gains.initial_matrix @ w[0], 1.0 / gains.rate_hz
    system = control.ss(A, B, C, D, step_s)
    times = np.arange(len(w)) * step_s
    ways: dict[str, Callable[[], Array]] = {
        "python-control, forced_response": lambda: (
            np.asarray(control.forced_response(system, times, w.T, start).outputs).T
        ),
        "scipy.signal.dlsim": lambda: np.asarray(dlsim((A, B, C, D, step_s), w, x0=start)[1]),
        "ours": lambda: np.hstack(joined(AffineObserver([gains]).run(case.u, case.y))),
    }
    found, first = {}, None
    for name, run in ways.items():
        estimates, us = timed(run, len(w))
        first = estimates if first is None else first
        found[name] = {"us": us, "difference": difference(estimates, first)}
    return found


def difference(found: Array, expected: Array) -> float:
    """Return the largest difference relative to the largest estimate."""
    return float(np.abs(found - expected).max() / np.abs(expected).max())


def text(found: dict[str, Any]) -> str:
    lines = [
        "## Kalman filters of the augmented state, linear arm at 100 Hz",
        "",
        "| filter | us a sample | RMSE of f_a | RMSE of f_s | difference from |",
        "|---|---|---|---|---|",
    ]
    for name, row in found["kalman"].items():
        same = "" if row["like"] is None else f"{row['like']}: {row['difference']:.1e}"
        lines.append(f"| {name} | {row['us']:.2f} | {row['f_a']:.4f} | {row['f_s']:.4f} | {same} |")
    lines += [
        "",
        "## Simulations of one recursion, 12 states and 10 faults",
        "",
        "| simulation | us a sample | difference from the first |",
        "|---|---|---|",
    ]
    lines += [f"| {name} | {row['us']:.2f} | {row['difference']:.1e} |" for name, row in found["simulation"].items()]
    return "\n".join([*lines, ""])


def main() -> int:
    parser = argparse.ArgumentParser(description="Compare with other libraries.")
    parser.add_argument("--json", action="store_true", help="print JSON instead of Markdown")
    as_json = parser.parse_args().json
    found = {"kalman": kalman_filters(), "simulation": simulations(linear_case(COUNT))}
    sys.stdout.write(json.dumps(found, indent=1) + "\n" if as_json else text(found))
    rows = [row for table in found.values() for row in table.values() if row["difference"] is not None]
    return int(any(not row["difference"] <= AGREE for row in rows))


if __name__ == "__main__":
    sys.exit(main())
