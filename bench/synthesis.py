"""How long the convex discrete-time synthesis takes, beside the theory's inequality handed straight to Clarabel.

    python bench/synthesis.py [--straight-multirotor]

Prints a Markdown table for the arm from 10 Hz to 1 kHz and for a multirotor of 12 states, 4 motors and 3 sloped
nonlinearities. "Straight" is min mu under the unreduced inequality of gains/synthesis/certificate.py at every vertex,
in the user's units, Clarabel at its defaults: for the multirotor that takes very long and is left out unless asked for.
"""

from __future__ import annotations

import sys
import time
import warnings
from pathlib import Path

import clarabel
import cvxpy as cp
import numpy as np
from scipy.sparse import csc_matrix

from gains.analysis.augment import augment, error_model
from gains.plants.discretise import discretise
from gains.plants.model_file import builtin_model
from gains.plants.plant import Plant
from gains.synthesis.certificate import certify
from gains.synthesis.convex import design_convex

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from gains_samples import flying_multirotor

ARM_RATES = (10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0)
MULTIROTOR_RATE = 50.0


def straight(plant: Plant, rate_hz: float) -> tuple[float, str]:
    """Return Clarabel's time in seconds for the unreduced inequality, and its status with sqrt(mu)."""
    discrete = discretise(plant, rate_hz)
    model = error_model(discrete, augment(discrete))
    (na, nw), p, a1 = model.B.shape, len(model.C), model.a1
    P, R = cp.Variable((na, na), symmetric=True), cp.Variable((na, p))
    L_p, mu = cp.Variable((a1, p)), cp.Variable()
    into_f = np.eye(na)[:, na - a1 :]
    C_e = np.diag(model.weights) @ (np.eye(na) - into_f @ (L_p @ model.C))
    D_e = np.diag(model.weights) @ (-into_f @ (L_p @ model.D))
    PB, zero = P @ model.B - R @ model.D, np.zeros
    constraints = []
    for vertex in model.A:
        PA = P @ vertex - R @ model.C
        rows = [
            [P, PA, PB, zero((na, na))],
            [PA.T, P, zero((na, nw)), C_e.T],
            [PB.T, zero((nw, na)), mu * np.eye(nw), D_e.T],
            [zero((na, na)), C_e, D_e, np.eye(na)],
        ]
        constraints.append(cp.bmat(rows) >> 0)
    data, _, _ = cp.Problem(cp.Minimize(mu), constraints).get_problem_data(cp.CLARABEL)
    cones = [clarabel.PSDTriangleConeT(size) for size in data["dims"].psd]
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    empty = np.zeros((len(data["c"]),) * 2)
    started = time.perf_counter()
    solver = clarabel.DefaultSolver(csc_matrix(empty), data["c"], csc_matrix(data["A"]), data["b"], cones, settings)
    solution = solver.solve()
    bound = np.sqrt(max(solution.obj_val, 0.0))
    return time.perf_counter() - started, f"{solution.status}, {bound:.5f}"


def main() -> None:
    cases = [(builtin_model("arm-disturbed"), rate, True) for rate in ARM_RATES]
    cases.append((flying_multirotor(), MULTIROTOR_RATE, "--straight-multirotor" in sys.argv[1:]))
    print("| plant | Hz | total s | solver s | sqrt(mu) | certified | straight s | straight result |")
    print("|---|---|---|---|---|---|---|---|")
    for plant, rate, compared in cases:
        design = design_convex(plant, rate)
        holds = "yes" if certify(plant, design).holds else "no"
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            seconds, result = straight(plant, rate) if compared else (float("nan"), "not run")
        times = f"{design.total_s:.2f} | {design.solve_s:.2f}"
        print(f"| {plant.name} | {rate:g} | {times} | {design.sqrt_mu:.5f} | {holds} | {seconds:.2f} | {result} |")


if __name__ == "__main__":
    main()
