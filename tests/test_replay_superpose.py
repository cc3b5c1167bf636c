"""Superposed faults: what they add is the difference between the plant with them and without."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from gains.plants.plant import Fault, Nonlinearity, Plant
from monitor.estimation.input_curve import effect_of_command
from monitor.fitting.superpose import effect_change, fault_response

TAPS = (0.5, 0.3, 0.2)
CURVE = (0.8, 0.4)
SWING = Nonlinearity("sin(v)", ("v",), np.array([[1.0, 0.5]]), np.array([[-1.0, 1.0]]), np.array([[-np.inf, np.inf]]))


def plant(*, swinging: bool) -> Plant:
    """Return two coupled states, both measured, with an actuator, a push and a sensor fault."""
    return Plant(
        name="toy",
        domain="discrete",
        rate_hz=100.0,
        states=("a", "b"),
        inputs=("drive", "brake"),
        outputs=("a", "sum"),
        A=np.array([[0.9, 0.1], [-0.2, 0.8]]),
        B=np.array([[0.1, 0.0], [0.3, -0.2]]),
        C=np.array([[1.0, 0.0], [1.0, 1.0]]),
        G=np.array([[0.0], [0.3]]) if swinging else np.zeros(0),
        nonlinearities=(SWING,) if swinging else (),
        taps=TAPS,
        curves=(CURVE, (1.0, 0.0)),
        faults=(
            Fault("drive", "actuator", input="drive"),
            Fault("push", "actuator", np.array([0.0, 1.0])),
            Fault("gauge", "sensor", np.array([0.0, 2.0])),
        ),
    )


def simulated(
    toy: Plant, u: NDArray[np.float64], push: float, gauge: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Step the toy's equations as written; return states (N, n) and outputs (N, p)."""
    v = effect_of_command(np.array(toy.curves), u)
    x, states, outputs = np.array([0.3, -0.4]), [], []
    for k in range(len(u)):
        states.append(x)
        outputs.append(toy.C @ x + np.array([0.0, 2.0]) * gauge)
        delayed = np.sum([tap * v[k - d] for d, tap in enumerate(TAPS) if k >= d], axis=0)
        swing = toy.G @ np.sin(SWING.rows @ x) if toy.nonlinearities else 0.0
        x = toy.A @ x + toy.B @ delayed + np.array([0.0, 1.0]) * push + swing
    return np.array(states), np.array(outputs)


def commands(seed: int) -> NDArray[np.float64]:
    return np.random.default_rng(seed).uniform(0.0, 1.0, (40, 2))


@given(st.integers(0, 2**32 - 1), st.floats(0.0, 1.0), st.floats(-5.0, 5.0), st.floats(-5.0, 5.0))
def test_faults_of_a_linear_plant_add_up_to_the_plant_with_all_of_them(
    seed: int, loss: float, push: float, gauge: float
) -> None:
    toy, u = plant(swinging=False), commands(seed)
    f = effect_change(u[:, 0], (1.0 - loss) * u[:, 0], np.array(CURVE), TAPS)
    added = (
        fault_response(toy, "drive", f)
        + fault_response(toy, "push", np.full(40, push))
        + fault_response(toy, "gauge", np.full(40, gauge))
    )
    _, healthy = simulated(toy, u, 0.0, 0.0)
    _, faulty = simulated(toy, u * [1.0 - loss, 1.0], push, gauge)
    np.testing.assert_allclose(healthy + added, faulty, atol=1e-9)


@given(st.integers(0, 2**32 - 1), st.floats(-5.0, 5.0))
def test_a_nonlinear_plant_is_followed_along_its_healthy_states(seed: int, push: float) -> None:
    toy, u = plant(swinging=True), commands(seed)
    x, healthy = simulated(toy, u, 0.0, 0.0)
    _, faulty = simulated(toy, u, push, 0.0)
    np.testing.assert_allclose(healthy + fault_response(toy, "push", np.full(40, push), x), faulty, atol=1e-9)
