"""The reconstructed adaptive estimator: actuator faults only."""

from dataclasses import replace

import numpy as np
import pytest

from adapters.errors import InfeasibleError
from adapters.simulation.arm import ArmScenario, make_fault, simulate_arm
from gains.plants.model_file import builtin_model
from gains.published.error_system import error_norm
from gains.published.zhang2008 import design_zhang2008
from gains.synthesis.continuous_observer import compile_continuous
from monitor.estimation.affine import AffineObserver


def test_a_sensor_fault_is_refused_by_name() -> None:
    with pytest.raises(InfeasibleError, match="'encoder' is a sensor fault"):
        design_zhang2008(builtin_model("arm"))


def test_without_sensor_faults_it_is_feasible_and_reads_an_actuator_fault() -> None:
    plant = builtin_model("arm")
    plant = replace(plant, faults=plant.actuator_faults)
    observer = design_zhang2008(plant)
    assert error_norm(plant, observer).pole_max < -0.4
    scenario = ArmScenario((make_fault("f_a", "step", 5.0, 20.0, 2.0),), disturbed=False)
    run = simulate_arm(scenario, 20.0, 100.0)
    found = AffineObserver([compile_continuous(observer, 100.0)]).run(run.u, run.y)
    assert found.fault[-1, 0] == pytest.approx(2.0, abs=0.01)
    assert np.max(np.abs(found.fault[:400])) < 0.01


def test_a_fault_that_no_output_rate_shows_is_infeasible() -> None:
    plant = builtin_model("arm")
    hidden = replace(plant.actuator_faults[0], input=None, column=np.array([0.0, 0.0, 1.0, -1.0]))
    with pytest.raises(InfeasibleError, match="cannot be met"):
        design_zhang2008(replace(plant, faults=(hidden,)))
