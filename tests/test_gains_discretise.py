"""Sampling is exact for signals held over the sample."""

from dataclasses import replace

import numpy as np
import pytest
from gains_samples import multirotor
from scipy.integrate import solve_ivp

from adapters.errors import ModelError
from gains.plants.discretise import discretise
from gains.plants.model_file import builtin_model


def test_held_signals_move_the_sampled_plant_as_they_move_the_continuous_one() -> None:
    rng = np.random.default_rng(1)
    plant = replace(builtin_model("arm-disturbed"), c=rng.normal(size=4))
    sampled = discretise(plant, 20.0)
    x, v, g, f, w = rng.normal(size=4), *(rng.normal(size=1) for _ in range(4))

    def rate(t: float, state: np.ndarray) -> np.ndarray:
        return plant.A @ state + plant.B @ v + plant.c + plant.G @ g + plant.E_f @ f + plant.E_1 @ w

    expected = solve_ivp(rate, (0.0, 0.05), x, rtol=1e-11, atol=1e-12).y[:, -1]
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
