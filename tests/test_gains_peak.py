"""No error is ever larger than its bound in users' units, and some signals come close to it."""

from dataclasses import replace

import numpy as np
import pytest
from gains_samples import DESIGNS, random_plant
from hypothesis import given, settings
from hypothesis import strategies as st
from test_gains_discretise import swung

from adapters.errors import InfeasibleError
from gains.analysis.augment import augment, error_model
from gains.plants.discretise import discretise
from gains.plants.model_file import builtin_model
from gains.plants.plant import FloatArray, Plant
from gains.synthesis.certificate import certify
from gains.synthesis.compilation import compile_gains
from gains.synthesis.convex import design_convex
from gains.synthesis.design import Design
from gains.synthesis.peak import largest_bounds, peak_bounds
from monitor.estimation.affine import AffineObserver


def driven(plant: Plant, design: Design, w: FloatArray, steps: FloatArray) -> FloatArray:
    """Return the errors [x~; f_s~; fa~] of a plant from w (N, q) and df_a (N, a1) of size one, slopes at random."""
    inverse = design.gains.inverse(augment(plant))
    model = error_model(plant, inverse)
    injection = model.injection(design.gains.K, design.gains.L_i, design.gains.L_p)
    C, D = (matrix / model.weights[:, None] for matrix in model.output(design.gains.L_p))
    B = model.B - injection @ model.D
    q, rng = w.shape[1], np.random.default_rng(0)
    error = -inverse_noise(model.B, q) @ w[0]
    errors = []
    for k in range(len(w) - 1):
        inputs = np.concatenate([w[k], w[k + 1], steps[k]])
        errors.append(C @ error + D @ inputs)
        A = model.A[rng.integers(len(model.A))] - injection @ model.C
        error = A @ error + B @ inputs
    return np.array(errors)


def inverse_noise(B: FloatArray, q: int) -> FloatArray:
    """Return F D: what the noise of the first sample makes of the error."""
    return -B[:, q : 2 * q]


@settings(deadline=None, derandomize=True, max_examples=DESIGNS)
@given(st.integers(0, 10_000), st.sampled_from([(1, 0), (0, 1), (1, 1), (2, 1)]), st.integers(0, 1))
def test_no_error_exceeds_its_bound(seed: int, faults: tuple[int, int], nonlinear: int) -> None:
    plant = random_plant(seed, *faults, nonlinear=nonlinear)
    try:
        design = design_convex(plant)
    except InfeasibleError:
        return
    bounds = peak_bounds(plant, design)
    if bounds is None:
        assert nonlinear
        return
    most = np.array([bound["at_most"] for bound in bounds.values()])
    rng = np.random.default_rng(seed)
    q, a1 = len(plant.disturbances) + len(plant.noises), len(plant.actuator_faults)
    for _ in range(3):
        w, steps = np.sign(rng.normal(size=(400, q))), np.sign(rng.normal(size=(400, a1)))
        assert np.all(np.abs(driven(plant, design, w, steps)) <= most * (1.0 + 1e-9))


def test_the_worst_signals_come_close_to_the_bound() -> None:
    plant = random_plant(8, 1, 1)
    design = design_convex(plant)
    bounds = peak_bounds(plant, design)
    assert bounds is not None
    q, count = len(plant.disturbances) + len(plant.noises), 300
    # the signs of the response to each input, in the other direction of time, add up to the bound
    for i, bound in enumerate(bounds.values()):
        w, steps = np.zeros((count + 1, q)), np.zeros((count + 1, 1))
        for j in range(q + 1):
            pulse, still = (np.zeros((count + 1, q)), np.zeros((count + 1, 1)))
            (pulse if j < q else still)[0, j if j < q else 0] = 1.0
            signs = np.sign(driven(plant, design, pulse, still)[:, i])[::-1]
            (w if j < q else steps)[:count, j if j < q else 0] = signs
        assert np.max(np.abs(driven(plant, design, w, steps)[:, i])) == pytest.approx(bound["at_most"], rel=1e-3)


@pytest.mark.parametrize("rate", [10.0, pytest.param(50.0, marks=pytest.mark.long)])
def test_with_its_rate_stated_bound_and_certificate_hold_for_the_true_arm(rate: float) -> None:
    arm = builtin_model("arm-disturbed")
    states, inputs, along = swung(arm, rate, 30.0)
    bare = discretise(arm, rate)
    predicted = states @ bare.H[0] + inputs * bare.H_known[0, 0]
    strays = float(np.max(np.abs(along - predicted[:, None])))
    (g,) = arm.nonlinearities
    arm = replace(arm, nonlinearities=(replace(g, rates=np.array([2.0 * strays * rate])),))
    design, plant = design_convex(arm, rate), discretise(arm, rate)
    gains = compile_gains(arm, design, certify(arm, design))
    bounds = gains.report["error_bounds"]
    run = AffineObserver([gains]).run(inputs[:, None], states @ arm.C.T)
    unheld = [w for w in plant.disturbances if w.name.startswith("unheld")]
    for channel, error in (("motor", run.fault[:, 0]), ("encoder", run.fault[:, 1])):
        own = sum(part for cause, part in bounds[channel]["from"].items() if cause.startswith("unheld"))
        assert 1e-4 < np.max(np.abs(error)) <= own
    left_out = (
        states[1:] - states[:-1] @ plant.A.T - np.outer(inputs[:-1], plant.B) - np.sin(predicted[:-1, None]) @ plant.G.T
    )
    w = np.linalg.solve(np.column_stack([w.scale * w.column for w in unheld]), left_out.T)
    energy = np.sum((run.x[:, 0] - states) ** 2) + np.sum(run.fault**2)
    assert energy <= design.mu * np.sum(w**2)


def test_of_the_designs_of_a_bank_the_largest_bound_of_each_fault_counts() -> None:
    reports = [
        {"faults": ["motor", "gyro"], "error_bounds": {"motor": {"at_most": 1.0}, "gyro": {"at_most": 2.0}}},
        {"faults": ["motor"], "error_bounds": {"motor": {"at_most": 3.0}}},
    ]
    assert largest_bounds(reports) == {"motor": 3.0, "gyro": 2.0}
    # a bound that one of them does not prove holds for none; gains files may come from anywhere
    for damaged in ({"faults": ["gyro"]}, {"faults": ["gyro"], "error_bounds": {"gyro": {"at_most": "2"}}}):
        assert largest_bounds([*reports, damaged]) == {"motor": 3.0}
