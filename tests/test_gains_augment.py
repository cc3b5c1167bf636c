"""The augmentation and the error system agree with a plant and a textbook observer simulated side by side."""

from dataclasses import replace

import numpy as np
import pytest
from gains_samples import random_plant, sine

from adapters.errors import InfeasibleError
from gains.analysis.augment import (
    LARGEST_VERTEX_COUNT,
    SAMPLE_COUNT,
    augment,
    error_model,
    sampled_vertices,
    slope_vertices,
    sloped_dynamics,
)
from gains.plants.discretise import discretise
from gains.plants.model_file import builtin_model


def test_L1_T_plus_F_Cb_is_the_identity() -> None:
    for seed in range(20):
        plant = random_plant(seed, 1, 1, decades=3)
        found = augment(plant)
        nz = len(found.L1)
        identity = found.L1 @ np.eye(len(plant.states), nz) + found.F @ found.C_b
        size = np.concatenate([plant.state_errors, [1.0 / np.abs(plant.D_f).max()]])
        np.testing.assert_allclose(identity * size / size[:, None], np.eye(nz), atol=1e-10)


def test_a_moved_left_inverse_is_one_too() -> None:
    for seed in range(10):
        plant = random_plant(seed, 1, 1)
        found = augment(plant)
        n, nz = len(plant.states), len(found.L1)
        assert found.W1.shape == (len(plant.outputs) - 1, n)
        Y = np.random.default_rng(seed).normal(size=(nz + 1, len(found.W1)))
        other, T = found.moved(Y), np.eye(n, nz)
        np.testing.assert_allclose(other.L1 @ T + other.F @ other.C_b, np.eye(nz), atol=1e-10)
        np.testing.assert_allclose(other.L_q @ T + other.F_q @ other.C_b, 0.0, atol=1e-10)


def test_with_unit_errors_and_outputs_it_is_the_plain_pseudo_inverse() -> None:
    plant = builtin_model("arm")
    stacked = np.vstack([np.eye(4, 5), np.hstack([plant.C, plant.D_f])])
    found = augment(plant)
    np.testing.assert_allclose(np.hstack([found.L1, found.F]), np.linalg.pinv(stacked), atol=1e-14)


def test_the_augmentation_follows_a_change_of_units() -> None:
    plant = random_plant(5, 1, 1)
    x, y = 10.0 ** np.arange(len(plant.states)), 10.0 ** -np.arange(len(plant.outputs), dtype=float)
    faults = tuple(replace(f, column=f.column * (x if f.kind == "actuator" else y)) for f in plant.faults)
    other = replace(
        plant,
        A=x[:, None] * plant.A / x,
        C=y[:, None] * plant.C / x,
        state_errors=x * plant.state_errors,
        faults=faults,
    )
    found, expected = augment(other), augment(plant)
    z = np.append(x, 1.0)
    np.testing.assert_allclose(found.L1, z[:, None] * expected.L1 / x, rtol=1e-9)
    np.testing.assert_allclose(found.F, z[:, None] * expected.F / y, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("seed", range(5))
def test_the_error_system_is_what_plant_and_textbook_observer_do(seed: int, order: int) -> None:
    rng = np.random.default_rng(seed)
    plant = random_plant(seed, 1, 1)
    found = augment(plant, order)
    found = found.moved(rng.normal(size=(len(found.L1) + order, len(found.W1))))
    model = error_model(plant, found, order)
    n, p, nz = len(plant.states), len(plant.outputs), len(found.L1)
    K, L_i, L_p = rng.normal(size=(nz, p)), rng.normal(size=(order, p)), rng.normal(size=(1, p))
    N = found.L1 @ found.A_z - K @ found.C_b
    J = N @ found.F + K
    steps = 12
    f_a, f_s, v = (
        rng.normal(size=(steps + 2, 1)),
        rng.normal(size=(steps, 1)),
        rng.normal(size=(steps, len(plant.inputs))),
    )
    w1, w2 = rng.normal(size=(steps, 2)), rng.normal(size=(steps, 2))
    scale1 = np.array([d.scale for d in plant.disturbances])
    scale2 = np.array([d.scale for d in plant.noises])
    x, eta, own = rng.normal(size=n), rng.normal(size=nz), rng.normal(size=order)
    errors, inputs, outputs = [], [], []
    for k in range(steps):
        y = plant.C @ x + plant.D_f @ f_s[k] + plant.D_1 @ (scale2 * w2[k])
        zeta, q = eta + found.F @ y, own + found.F_q @ y
        fault = np.append(f_a[k], (f_a[k + 1] - f_a[k]) * plant.rate_hz)
        yt = y - found.C_b @ zeta
        fa = q[:1] + L_p @ yt
        errors.append(np.concatenate([np.append(x, f_s[k]) - zeta, fault[:order] - q]))
        outputs.append(np.concatenate([np.append(x, f_s[k]) - zeta, f_a[k] - fa]) * model.weights)
        driven = plant.B @ v[k] + plant.c + plant.E_f @ fa
        eta = N @ eta + J @ y + found.L1 @ driven
        own = q + np.append(q[1:] / plant.rate_hz, 0.0) + found.L_q @ (plant.A @ zeta[:n] + driven) + L_i @ yt
        x = plant.A @ x + plant.B @ v[k] + plant.c + plant.E_f @ f_a[k] + plant.E_1 @ (scale1 * w1[k])
        if k + 1 < steps:
            step = np.diff(f_a[k : k + 1 + order, 0], order) * plant.rate_hz**order / plant.actuator_faults[0].rate
            inputs.append(np.concatenate([w1[k], w2[k], w1[k + 1], w2[k + 1], step]))
    injection = model.injection(K, L_i, L_p)
    C_e, D_e = model.output(L_p)
    for k in range(steps - 1):
        after = (model.A[0] - injection @ model.C) @ errors[k] + (model.B - injection @ model.D) @ inputs[k]
        np.testing.assert_allclose(after, errors[k + 1], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(C_e @ errors[k] + D_e @ inputs[k], outputs[k], rtol=1e-9, atol=1e-9)


def test_a_vertex_is_the_plant_with_its_nonlinearity_replaced_by_the_slope() -> None:
    plant = discretise(builtin_model("arm"), 100.0)
    found = augment(plant)
    model = error_model(plant, found)
    assert model.slopes.tolist() == [[-1.0], [1.0]]
    for A, slope in zip(model.A, (-1.0, 1.0), strict=True):
        linear = replace(
            plant,
            A=plant.A + slope * plant.G @ plant.H,
            nonlinearities=(),
            G=np.zeros(0),
            faults=tuple(
                replace(f, ahead=np.zeros(0), input=None, column=f.column + slope * plant.G @ f.ahead)
                if f.kind == "actuator"
                else replace(f, ahead=np.zeros(0))
                for f in plant.faults
            ),
        )
        np.testing.assert_allclose(A, error_model(linear, augment(linear)).A[0], atol=1e-15)


def test_constant_slopes_do_not_multiply_vertices() -> None:
    plant = random_plant(2, 1, 0, nonlinear=3)
    slopes = [(-1.0, 1.0), (0.5, 0.5), (0.0, 2.0)]
    rows = [g.rows[0] for g in plant.nonlinearities]
    plant = replace(plant, nonlinearities=tuple(sine(row, pair) for row, pair in zip(rows, slopes, strict=True)))
    assert slope_vertices(plant).tolist() == [[-1, 0.5, 0], [-1, 0.5, 2], [1, 0.5, 0], [1, 0.5, 2]]


def test_too_many_vertices_are_refused() -> None:
    plant = random_plant(2, 1, 0, nonlinear=11)
    with pytest.raises(InfeasibleError, match=rf"11 slopes vary, .* at most {LARGEST_VERTEX_COUNT} .*--vertex-free"):
        slope_vertices(plant)


def test_every_vertex_is_the_mean_plus_what_its_slopes_differ_by() -> None:
    plant = random_plant(3, 1, 1, nonlinear=3)
    slopes = [(-1.0, 3.0), (0.5, 0.5), (0.0, 2.0)]
    rows = [g.rows[0] for g in plant.nonlinearities]
    plant = replace(plant, nonlinearities=tuple(sine(row, pair) for row, pair in zip(rows, slopes, strict=True)))
    model = error_model(plant, augment(plant))
    assert (model.G.shape[1], len(model.H)) == (2, 2)
    for A, delta in zip(model.A, [(-1, -1), (-1, 1), (1, -1), (1, 1)], strict=True):
        np.testing.assert_allclose(A, model.mean + model.G * delta @ model.H, atol=1e-14)


def test_a_sample_of_many_vertices_is_the_same_each_time_and_holds_the_extremes() -> None:
    plant = random_plant(2, 1, 0, nonlinear=12)
    sample = sampled_vertices(plant)
    assert sample.shape == (SAMPLE_COUNT, 12)
    assert set(sample.ravel()) == {-1.0, 1.0}
    assert sample[:2].tolist() == [[-1.0] * 12, [1.0] * 12]
    assert np.array_equal(sample, sampled_vertices(plant))
    dynamics, slopes = sloped_dynamics(plant, sampled=True)
    assert len(dynamics) == len(slopes) == SAMPLE_COUNT + 1
    assert not np.any(slopes[0])


def test_a_sample_of_few_vertices_is_all_of_them() -> None:
    plant = random_plant(2, 1, 0, nonlinear=6)
    assert np.array_equal(sampled_vertices(plant), slope_vertices(plant))
