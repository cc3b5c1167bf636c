"""The reconstructed nonlinear unknown-input observer: infeasible on the arm, feasible for a weaker nonlinearity."""

from dataclasses import replace

import numpy as np
import pytest

from adapters.errors import InaccurateError, InfeasibleError
from gains.plants.model_file import builtin_model
from gains.plants.plant import Plant
from gains.published.chen2006 import design_chen2006
from gains.published.error_system import error_norm
from gains.synthesis.continuous_observer import compile_continuous
from monitor.estimation.affine import AffineObserver


def arm_with(lipschitz: float) -> Plant:
    plant = builtin_model("arm")
    return replace(plant, G=plant.G * lipschitz / 3.33)


@pytest.mark.parametrize("lipschitz", [0.5, 1.0, 3.33])
def test_the_arm_is_infeasible_and_the_message_gives_its_lipschitz_constant(lipschitz: float) -> None:
    with pytest.raises(InfeasibleError, match=f"Lipschitz constant {lipschitz:g} ") as caught:
        design_chen2006(arm_with(lipschitz))
    assert not isinstance(caught.value, InaccurateError)


@pytest.mark.parametrize("lipschitz", [0.0, 0.01, 0.1])
def test_a_weaker_nonlinearity_is_feasible_and_stable(lipschitz: float) -> None:
    plant = arm_with(lipschitz)
    observer = design_chen2006(plant)
    assert observer.sqrt_mu is None
    assert error_norm(plant, observer).pole_max < -0.1


def test_the_added_filter_reads_a_constant_fault() -> None:
    plant = arm_with(0.0)
    observer = design_chen2006(plant)
    gains = compile_continuous(observer, 100.0)
    # the arm at rest under f_a = 2 and f_s = 1, without gravity and with the torque that holds it there
    y = np.tile([1.0, 0.0, 0.0], (3000, 1))
    found = AffineObserver([gains]).run(np.full((3000, 1), -2.0), y)
    assert found.fault[-1] == pytest.approx([2.0, 1.0], abs=1e-3)


def test_faults_that_no_output_rate_shows_apart_are_refused() -> None:
    plant = builtin_model("arm")
    hidden = replace(plant.actuator_faults[0], input=None, column=np.array([1.0, 0.0, 0.0, 0.0]))
    with pytest.raises(InfeasibleError, match="rank"):
        design_chen2006(replace(plant, faults=(hidden, *plant.sensor_faults)))
