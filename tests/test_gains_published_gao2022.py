"""The reconstructed fast adaptive observer: bounds confirmed by the norm of its gains."""

import numpy as np
import pytest
from gains_samples import multirotor

from adapters.errors import InfeasibleError
from adapters.simulation.arm import SCENARIOS, simulate_arm
from gains.plants.model_file import builtin_model
from gains.published.error_system import error_norm
from gains.published.gao2022 import design_gao2022
from gains.synthesis.continuous_observer import compile_continuous
from monitor.estimation.affine import AffineObserver


@pytest.mark.parametrize(("sigma", "bound"), [(1.0, 0.633), (10.0, 0.145)])
def test_the_bound_is_that_of_the_reconstruction_and_the_norm_confirms_it(sigma: float, bound: float) -> None:
    plant = builtin_model("arm-disturbed")
    observer = design_gao2022(plant, sigma)
    assert observer.sqrt_mu == pytest.approx(bound, rel=0.015)
    assert error_norm(plant, observer, noise_path="all").confirms(observer.sqrt_mu)
    assert observer.sqrt_mu > 0.13628


@pytest.mark.long
def test_the_sweep_takes_the_smallest_bound_and_its_gains_run_on_samples() -> None:
    plant = builtin_model("arm-disturbed")
    observer = design_gao2022(plant)
    assert observer.sqrt_mu < 0.148
    run = simulate_arm(SCENARIOS["case2"], 20.0, 100.0)
    found = AffineObserver([compile_continuous(observer, 100.0)]).run(run.u, run.y)
    assert found.fault[1500, 0] == pytest.approx(2.0, abs=0.05)


def test_a_sigma_that_is_not_positive_is_refused() -> None:
    with pytest.raises(InfeasibleError, match="sigma"):
        design_gao2022(builtin_model("arm-disturbed"), -1.0)


def test_a_discrete_model_is_refused() -> None:
    with pytest.raises(ValueError, match="continuous"):
        design_gao2022(multirotor())


def test_the_law_is_that_of_the_form() -> None:
    observer = design_gao2022(builtin_model("arm-disturbed"), 10.0)
    assert observer.matrices is not None
    assert observer.matrices.L_i == pytest.approx(10.0 * observer.matrices.L_p)
    assert np.all(np.isfinite(observer.A))
