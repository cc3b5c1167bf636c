"""The compiled map does what the observer's equations say, delays and nonlinearities included."""

from dataclasses import replace

import numpy as np
import pytest
from gains_samples import multirotor, random_plant

from adapters.errors import InaccurateError
from gains.analysis.augment import augment, integrators
from gains.plants.discretise import discretise
from gains.plants.model_file import builtin_model, model_hash
from gains.plants.plant import FloatArray, Plant
from gains.synthesis.certificate import certify
from gains.synthesis.compilation import compile_gains
from gains.synthesis.convex import design_convex
from gains.synthesis.design import Design
from gains.synthesis.gains_file import Gains


def bent(plant: Plant) -> Plant:
    """Return the plant with bends of every other state."""
    bends = np.random.default_rng(4).normal(size=(*plant.B.shape, 3))
    bends[::2] = 0.0
    return replace(plant, bends=bends)


PLANTS = {
    "arm": replace(builtin_model("arm-disturbed"), c=np.array([0.1, -0.2, 0.3, -0.4])),
    "delays": replace(random_plant(21, 1, 1, nonlinear=2), taps=(0.2, 0.5, -0.1, 0.4)),
    "bends": bent(random_plant(21, 1, 1, nonlinear=2)),
    "actuators": random_plant(22, 2, 0),
    "sensors": random_plant(23, 0, 2),
    "multirotor": multirotor(),
    "ramping": replace(random_plant(24, 2, 1, nonlinear=1), taps=(0.5, 0.3, 0.2)),
    "noise once": random_plant(25, 1, 1, nonlinear=1),
}
ORDERS = {"ramping": 2}


@pytest.fixture(scope="module", params=PLANTS)
def compiled(request: pytest.FixtureRequest) -> tuple[Plant, Design, Gains]:
    plant = PLANTS[request.param]
    order = ORDERS.get(request.param, 1)
    once = request.param == "noise once"
    design = design_convex(plant, plant.rate_hz or 100.0, integrator_order=order, noise_once=once)
    assert bool(design.gains.L_z.any()) is once
    assert len(design.gains.L_i) == order * len(design.gains.L_p)
    return plant, design, compile_gains(plant, design, certify(plant, design))


def effect(plant: Plant, u: FloatArray) -> FloatArray:
    """Return v = c1 u + c2 u^2 + ... of each input, and then the r of states with a bend."""
    v = [sum(c * x ** (d + 1) for d, c in enumerate(curve)) for x, curve in zip(u, plant.curves, strict=True)]
    bends = plant.bends[plant.bends.any(axis=(1, 2))]
    r = [sum(c * x ** (d + 1) for x, row in zip(v, rows, strict=True) for d, c in enumerate(row)) for rows in bends]
    return np.array([*v, *r])


def run_map(plant: Plant, gains: Gains, u: FloatArray, y: FloatArray) -> FloatArray:
    """Return [zeta^; fa^; yt] over time from the compiled matrices."""
    ns, outputs = len(gains.initial_matrix), []
    state = gains.initial_matrix @ np.concatenate([effect(plant, u[0]), y[0], [1.0]])
    for u_k, y_k in zip(u, y, strict=True):
        known = np.concatenate([state, effect(plant, u_k), y_k, [1.0]])
        out = gains.step_matrix @ np.concatenate([known, np.sin(gains.argument_matrix @ known)])
        state = out[:ns]
        outputs.append(out[ns:])
    return np.array(outputs)


def run_textbook(plant: Plant, design: Design, u: FloatArray, y: FloatArray) -> FloatArray:
    """Return [zeta^; fa^; yt] over time from the equations of the theory."""
    n, a2 = len(plant.states), len(plant.sensor_faults)
    T, C_b = np.eye(n, n + a2), np.hstack([plant.C, plant.D_f])
    v = np.array([effect(plant, u_k) for u_k in u])
    s, bent = len(plant.inputs), plant.bends.any(axis=(1, 2))
    a1, order = len(design.gains.L_p), design.integrator_order
    found = design.gains.inverse(augment(plant, order))
    start, outputs = np.linalg.pinv(plant.C) @ y[0], []
    eta, own = found.L1 @ start, found.L_q @ start
    chain = integrators(a1, order, design.rate_hz)
    for k, y_k in enumerate(y):
        filtered = sum((h * v[max(k - d, 0)] for d, h in enumerate(plant.taps)), start=np.zeros(v.shape[1]))
        zeta = eta + design.gains.F @ y_k
        yt = y_k - C_b @ zeta
        q = own + found.F_q @ y_k
        fa = q[:a1] + design.gains.L_p @ yt
        g = np.sin(plant.H @ T @ zeta + plant.H_known @ np.append(filtered[:s], 1.0) + plant.H_f @ q[:a1])
        drive = plant.B @ filtered[:s] + np.eye(n)[:, bent] @ filtered[s:] + plant.c + plant.G @ g + plant.E_f @ fa
        eta = design.gains.N @ eta + design.gains.J @ y_k + design.gains.L1 @ drive
        own = chain @ q + found.L_q @ (plant.A @ T @ zeta + drive) + design.gains.L_i @ yt
        published = zeta + design.gains.L_z @ yt if design.noise_once else zeta
        outputs.append(np.concatenate([published, fa, yt]))
    return np.array(outputs)


def test_the_compiled_map_equals_the_textbook_observer(compiled: tuple[Plant, Design, Gains]) -> None:
    plant, design, gains = compiled
    discrete = discretise(plant, design.rate_hz)
    rng = np.random.default_rng(3)
    u, y = rng.normal(size=(60, len(plant.inputs))), rng.normal(size=(60, len(plant.outputs)))
    expected = run_textbook(discrete, design, u, y)
    # without a floor, an innovation that f_s^ takes up whole would be compared with its own rounding
    scale = np.maximum(np.max(np.abs(expected), axis=0), 1e-3)
    np.testing.assert_allclose(run_map(discrete, gains, u, y) / scale, expected / scale, atol=1e-10)


def test_names_kinds_and_inputs_follow_the_plant(compiled: tuple[Plant, Design, Gains]) -> None:
    plant, design, gains = compiled
    faults = (*plant.actuator_faults, *plant.sensor_faults)
    assert gains.faults == tuple(fault.name for fault in faults)
    assert gains.fault_kinds == tuple(fault.kind for fault in faults)
    assert gains.fault_units == tuple(fault.unit for fault in faults)
    assert [None if i is None else plant.inputs[i] for i in gains.fault_inputs] == [fault.input for fault in faults]
    assert gains.model_hash == model_hash(plant)
    assert gains.rate_hz == design.rate_hz
    assert gains.input_curves.shape[0] == len(plant.inputs)
    assert gains.report["certificate"]["holds"]


def test_a_restart_explains_a_consistent_output_without_a_fault() -> None:
    plant = multirotor()
    design = design_convex(plant)
    gains = compile_gains(plant, design, certify(plant, design))
    y = np.array([[0.1, -0.2, 0.05, -9.8]])
    zeta, fa, yt = np.split(run_map(plant, gains, np.full((1, 4), 0.5), y)[0], [4, 8])
    np.testing.assert_allclose(zeta, y[0], atol=1e-12)
    np.testing.assert_allclose(fa, 0.0, atol=1e-12)
    np.testing.assert_allclose(yt, 0.0, atol=1e-12)


def arm_step(discrete: Plant, x: FloatArray, f_a: FloatArray) -> FloatArray:
    """Return x one sample later without inputs."""
    return discrete.A @ x + discrete.G @ np.sin(discrete.H @ x + discrete.H_f @ f_a) + discrete.E_f @ f_a


def test_the_estimates_of_the_arm_settle_on_constant_faults() -> None:
    plant = builtin_model("arm-disturbed")
    design = design_convex(plant, 100.0)
    gains = compile_gains(plant, design, certify(plant, design))
    discrete = discretise(plant, 100.0)
    x, outputs, f_a, f_s = np.array([0.1, 0.0, -0.1, 0.0]), [], np.array([0.3]), np.array([-0.2])
    for _ in range(2000):
        outputs.append(discrete.C @ x + discrete.D_f @ f_s)
        x = arm_step(discrete, x, f_a)
    estimate = run_map(discrete, gains, np.zeros((2000, 1)), np.array(outputs))[-1]
    assert estimate[4] == pytest.approx(f_s[0], abs=1e-6)
    assert estimate[5] == pytest.approx(f_a[0], abs=1e-6)
    np.testing.assert_allclose(estimate[6:], 0.0, atol=1e-6)


def test_a_ramping_fault_is_followed_without_the_lag_that_one_integrator_has() -> None:
    plant = builtin_model("arm-disturbed")
    discrete = discretise(plant, 100.0)
    x, outputs, steps, slope = np.zeros(4), [], 3000, 0.5
    f_a = slope * np.arange(steps) / 100.0
    for k in range(steps):
        outputs.append(discrete.C @ x)
        x = arm_step(discrete, x, f_a[[k]])
    lags = []
    for order in (1, 2):
        design = design_convex(plant, 100.0, integrator_order=order)
        gains = compile_gains(plant, design, certify(plant, design))
        estimate = run_map(discrete, gains, np.zeros((steps, 1)), np.array(outputs))
        lags.append((f_a - estimate[:, 5])[-100:] / slope)
    assert np.min(lags[0]) > 0.01  # seconds: at least a sample
    assert np.max(np.abs(lags[1])) < 1e-6


def test_gains_whose_certificate_does_not_hold_are_not_compiled() -> None:
    plant = multirotor()
    design = design_convex(plant)
    with pytest.raises(InaccurateError, match="certificate does not hold"):
        compile_gains(plant, design, replace(certify(plant, design), holds=False))
