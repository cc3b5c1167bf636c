"""The floor is what disturbances can hide, and no design is below it."""

import math
from dataclasses import replace

import numpy as np
import pytest
from gains_samples import integrator_with_drift, multirotor

from gains.analysis.floor import floor_sqrt_mu
from gains.plants.model_file import builtin_model


def test_the_disturbed_arm_has_the_floor_of_the_theory() -> None:
    floor = floor_sqrt_mu(builtin_model("arm-disturbed"))
    assert floor.value == pytest.approx(0.13628, abs=5e-6)
    assert floor.omega == 0.0


@pytest.mark.parametrize("slope", [-1.0, -0.3, 0.0, 1.0])
def test_the_floor_of_the_disturbed_arm_does_not_depend_on_the_slope(slope: float) -> None:
    plant = builtin_model("arm-disturbed")
    (gravity,) = plant.nonlinearities
    plant = replace(plant, nonlinearities=(replace(gravity, slopes=np.array([[slope, slope]])),))
    assert floor_sqrt_mu(plant).value == pytest.approx(0.13628, abs=5e-6)


def test_the_sampled_floor_counts_a_constant_disturbance_in_both_samples() -> None:
    plant = builtin_model("arm-disturbed")
    # at rest the middle of a sample is predicted without gravity, wrong by its effect within half of it
    for rate, share in ((10.0, 5e-3), (1000.0, 1e-5)):
        assert floor_sqrt_mu(plant, rate).value == pytest.approx(0.136284 / math.sqrt(2.0), rel=share)


def test_nothing_hides_where_nothing_disturbs() -> None:
    assert floor_sqrt_mu(builtin_model("arm")).value == 0.0


def test_the_floor_is_infinite_where_a_fault_hides_by_itself() -> None:
    assert floor_sqrt_mu(integrator_with_drift()).value == math.inf


def test_a_scale_of_the_disturbances_scales_the_floor() -> None:
    plant = multirotor()
    half = replace(plant, disturbances=tuple(replace(w, scale=0.5 * w.scale) for w in plant.disturbances))
    half = replace(half, noises=tuple(replace(w, scale=0.5 * w.scale) for w in plant.noises))
    assert 0.0 < floor_sqrt_mu(half).value < floor_sqrt_mu(plant).value
