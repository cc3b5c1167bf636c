"""Batched simulation against other integrators."""

from dataclasses import replace

import numpy as np
import pytest
import scipy
from gains_samples import dynamics_of

from adapters.errors import ModelError
from gains.identification.simulation import Stepper, linearised
from gains.plants.model_file import builtin_model
from gains.plants.plant import Plant


def run(plant: Plant, u: np.ndarray, start: np.ndarray, rate_hz: float, hold: str = "first") -> np.ndarray:
    stepper = Stepper([dynamics_of(plant)], rate_hz, hold)
    drives = stepper.drives(u[None])
    x = [np.array(start)[None, None]]
    for drive in drives:
        x.append(stepper.step(x[-1], drive))
    return np.array(x)[:, 0, 0]


@pytest.mark.parametrize("hold", ["first", "zero"])
def test_the_arm_moves_as_a_general_integrator_says(hold: str) -> None:
    plant, rate_hz = builtin_model("arm"), 100.0
    t = np.arange(200) / rate_hz
    u = 0.5 * np.sin(3.0 * t)[:, None]

    def torque(time: float) -> float:
        if hold == "first":
            return float(np.interp(time, t, u[:, 0]))
        return float(u[min(int(time * rate_hz + 1e-9), len(u) - 1), 0])

    def slope(time: float, x: np.ndarray) -> np.ndarray:
        return plant.A @ x + plant.B[:, 0] * torque(time) + plant.G[:, 0] * np.sin(x[2])

    start = np.array([0.5, 0.0, 0.6, 0.0])
    exact = scipy.integrate.solve_ivp(slope, (0.0, t[-1]), start, t_eval=t, rtol=1e-9, atol=1e-10, max_step=0.005).y.T
    assert run(plant, u, start, rate_hz, hold) == pytest.approx(exact, abs=2e-4)


def test_a_stiff_linear_plant_is_stepped_exactly() -> None:
    plant = Plant("lag", ("a", "b"), (), ("a",), np.array([[-5000.0, 1.0], [0.0, -0.1]]), np.zeros(0), np.eye(1, 2))
    found = run(plant, np.zeros((50, 0)), np.array([1.0, 1.0]), 50.0)
    assert found[-1] == pytest.approx(scipy.linalg.expm(plant.A * 49 / 50.0) @ [1.0, 1.0], rel=1e-9)


def test_discrete_plants_step_as_written() -> None:
    plant = Plant(
        "d", ("a",), ("u",), ("a",), np.eye(1) * 0.9, np.eye(1), np.eye(1), "discrete", 10.0, curves=((1.0, 0.5),)
    )
    assert run(plant, np.array([[2.0], [0.0]]), np.array([1.0]), 10.0)[1] == pytest.approx([0.9 + 2.0 + 0.5 * 4.0])
    with pytest.raises(ModelError, match="10 Hz"):
        Stepper([dynamics_of(plant)], 20.0, "first")


def test_the_linearised_arm_hangs_by_the_slope_of_gravity() -> None:
    plant = builtin_model("arm")
    down, up = (linearised(plant, np.array([[0.0, 0.0, angle, 0.0]])).A[3, 2] for angle in (0.0, np.pi))
    assert (down, up) == pytest.approx((-19.5 - 3.33, -19.5 + 3.33))


def test_a_plant_that_explodes_is_refused() -> None:
    plant = replace(builtin_model("arm"), A=np.eye(4) * 1e30)
    with pytest.raises(ModelError, match="grows without bound"):
        Stepper([dynamics_of(plant)], 1.0, "first")
