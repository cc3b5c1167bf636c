"""Where all faults together cannot be estimated, each admissible hypothesis gets its own observer."""

from dataclasses import replace

import numpy as np
import pytest
from gains_samples import hexacopter, integrator_with_drift

from adapters.errors import InfeasibleError
from gains.analysis.estimability import estimability
from gains.plants.model_file import builtin_model
from gains.plants.plant import Fault
from gains.synthesis.bank import admissible_hypotheses, design_bank
from gains.synthesis.certificate import certify


@pytest.mark.long
def test_every_single_motor_of_the_hexacopter_is_a_hypothesis_with_a_certified_observer() -> None:
    bank = design_bank(hexacopter())
    assert [hypothesis.faults for hypothesis in bank] == [(f"motor{i}",) for i in range(1, 7)]
    for faults, plant, design in bank:
        assert tuple(fault.name for fault in plant.faults) == faults
        assert plant.B.shape == (4, 6)
        assert certify(plant, design).holds


def test_six_motors_have_twelve_largest_sets_that_can_be_estimated_together() -> None:
    assert len(estimability(hexacopter()).sets) == 12


def test_a_continuous_plant_is_sampled() -> None:
    motor, encoder = design_bank(builtin_model("arm-disturbed"), 100.0)
    assert (motor.faults, encoder.faults) == (("motor",), ("encoder",))
    assert motor.design.rate_hz == 100.0


def test_a_fault_that_can_never_be_estimated_is_no_hypothesis() -> None:
    plant = integrator_with_drift()
    with pytest.raises(InfeasibleError, match="no fault can be estimated even when it is the only one"):
        admissible_hypotheses(plant)
    faults = (*plant.faults, Fault("motor", "actuator", np.array([0.0, 1.0])))
    assert admissible_hypotheses(replace(plant, faults=faults)) == (("motor",),)
