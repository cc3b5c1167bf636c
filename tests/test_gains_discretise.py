"""Sampling is exact for signals held over the sample, and what it leaves out of nonlinearities is bounded."""

from dataclasses import replace

import numpy as np
import pytest
import scipy
from gains_samples import multirotor

from adapters.errors import ModelError
from gains.plants.discretise import discretise
from gains.plants.model_file import builtin_model
from gains.plants.plant import FloatArray, Plant
from gains.synthesis.certificate import certify
from gains.synthesis.compilation import compile_gains
from gains.synthesis.convex import design_convex
from monitor.estimation.affine import AffineObserver


def test_held_signals_move_the_sampled_plant_as_they_move_the_continuous_one() -> None:
    rng = np.random.default_rng(1)
    plant = replace(builtin_model("arm-disturbed"), c=rng.normal(size=4))
    sampled = discretise(plant, 20.0)
    x, v, g, f, w = rng.normal(size=4), *(rng.normal(size=1) for _ in range(4))

    def rate(t: float, state: np.ndarray) -> np.ndarray:
        return plant.A @ state + plant.B @ v + plant.c + plant.G @ g + plant.E_f @ f + plant.E_1 @ w

    expected = scipy.integrate.solve_ivp(rate, (0.0, 0.05), x, rtol=1e-11, atol=1e-12).y[:, -1]
    found = sampled.A @ x + sampled.B @ v + sampled.c + sampled.G @ g + sampled.E_f @ f + sampled.E_1 @ w
    np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-9)


def test_an_input_fault_keeps_the_column_of_its_input() -> None:
    sampled = discretise(builtin_model("arm"), 100.0)
    assert sampled.domain == "discrete"
    assert sampled.rate_hz == 100.0
    assert np.array_equal(sampled.E_f, sampled.B)
    assert np.array_equal(sampled.C, builtin_model("arm").C)


def test_a_discrete_model_stays_as_it_is_at_its_own_rate_and_has_no_other() -> None:
    plant = multirotor()
    assert discretise(plant, 100.0) is plant
    with pytest.raises(ModelError, match="discrete at 100 Hz and cannot run at 50 Hz"):
        discretise(plant, 50.0)


@pytest.mark.parametrize("rate", [0.0, -1.0, float("nan"), float("inf")])
def test_a_rate_that_is_none_is_refused(rate: float) -> None:
    with pytest.raises(ModelError, match="is not positive"):
        discretise(builtin_model("arm"), rate)


def test_a_model_that_explodes_within_a_sample_is_refused() -> None:
    plant = builtin_model("arm")
    with pytest.raises(ModelError, match="grows without bound"):
        discretise(replace(plant, A=1e6 * np.eye(4)), 1.0)


def swung(plant: Plant, rate_hz: float, seconds: float, steps: int = 40) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return x (N, n), u (N,) and g along each sample (N, 2 steps + 1) of the true arm, by Runge-Kutta."""
    h, x = 1.0 / rate_hz / steps, np.zeros(4)
    states, inputs, along = [], [], []

    def rate(state: FloatArray, v: float) -> FloatArray:
        return plant.A @ state + plant.B[:, 0] * v + plant.G[:, 0] * np.sin(state[2])

    for k in range(round(seconds * rate_hz)):
        v, seen = float(np.sin(0.3 * k / rate_hz)), [x[2]]
        states.append(x)
        inputs.append(v)
        for _ in range(steps):
            first = rate(x, v)
            second = rate(x + 0.5 * h * first, v)
            middle = x + 0.5 * h * second
            third = rate(middle, v)
            x = x + h / 6.0 * (first + 2.0 * second + 2.0 * third + rate(x + h * third, v))
            seen += [middle[2], x[2]]
        along.append(seen)
    return np.array(states), np.array(inputs), np.array(along)


@pytest.mark.parametrize(
    ("rate", "held", "middle"),
    [
        (10.0, 0.060, 0.013),
        pytest.param(20.0, 0.095, 0.007, marks=pytest.mark.long),
        pytest.param(100.0, 0.024, 4e-4, marks=pytest.mark.long),
    ],
)
def test_nonlinearities_in_the_middle_of_a_sample_follow_the_true_arm(rate: float, held: float, middle: float) -> None:
    arm = builtin_model("arm-disturbed")
    states, inputs, _ = swung(arm, rate, 40.0, 8)
    sampled = discretise(arm, rate)
    first = tuple(replace(g, rows=arm.H, ahead=np.zeros(0)) for g in sampled.nonlinearities)
    largest = []
    for plant in (sampled, replace(sampled, nonlinearities=first)):
        design = design_convex(plant, free_inverse=False)
        observer = AffineObserver([compile_gains(plant, design, certify(plant, design))])
        largest.append(np.max(np.abs(observer.run(inputs[:, None], states @ arm.C.T).fault[:, 0])))
    assert largest[0] < middle
    assert largest[1] > held


@pytest.mark.parametrize("rate", [10.0, pytest.param(50.0, marks=pytest.mark.long)])
def test_what_a_sample_leaves_out_of_a_nonlinearity_is_a_disturbance_of_its_stated_size(rate: float) -> None:
    arm = builtin_model("arm-disturbed")
    states, inputs, along = swung(arm, rate, 20.0)
    bare = discretise(arm, rate)
    predicted = states @ bare.H[0] + np.outer(inputs, bare.H_known[0, :1])[:, 0]
    moves = float(np.max(np.abs(along - predicted[:, None]))) * 2.0 * rate
    (g,) = arm.nonlinearities
    plant = discretise(replace(arm, nonlinearities=(replace(g, rates=np.array([moves])),)), rate)
    unheld = [w for w in plant.disturbances if w.name.startswith("unheld")]
    assert len(unheld) == 4
    left_out = (
        states[1:] - states[:-1] @ plant.A.T - np.outer(inputs[:-1], plant.B) - np.sin(predicted[:-1, None]) @ plant.G.T
    )
    shares = np.linalg.solve(np.column_stack([w.scale * w.column for w in unheld]), left_out.T)
    assert np.max(np.linalg.norm(shares, axis=0)) <= 1.0
    assert len(discretise(arm, rate).disturbances) == 1
