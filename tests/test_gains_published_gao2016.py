"""The reconstructed augmented-state observer: feasible without decoupling only."""

from dataclasses import replace

import numpy as np
import pytest

from adapters.errors import InfeasibleError
from gains.plants.model_file import builtin_model
from gains.published.error_system import error_norm, published_error_system
from gains.published.gao2016 import design_gao2016


def test_without_decoupling_the_bound_lies_where_it_was_seen_and_the_norm_confirms_it() -> None:
    plant = builtin_model("arm-disturbed")
    for decay in (0.0, 0.3):
        observer = design_gao2016(plant, decay=decay)
        assert observer.sqrt_mu is not None
        assert 0.13628 < observer.sqrt_mu < 0.324
        found = error_norm(plant, observer, noise_path="all", inputs="disturbances")
        assert found.confirms(observer.sqrt_mu)
        assert found.pole_max <= -decay


def test_decoupling_the_disturbance_is_infeasible_on_the_arm() -> None:
    with pytest.raises(InfeasibleError, match="decoupled"):
        design_gao2016(builtin_model("arm-disturbed"), decouple=True)


def test_a_decoupled_disturbance_does_not_touch_the_error() -> None:
    plant = builtin_model("arm-disturbed")
    plant = replace(plant, faults=plant.sensor_faults)
    observer = design_gao2016(plant, decouple=True)
    system = published_error_system(plant, observer, np.array([0.5]), noise_path="all")
    assert np.max(np.abs(system.B[:, 0])) < 1e-6 * np.max(np.abs(system.B))


def test_a_sensor_fault_that_moves_is_a_disturbance_to_it() -> None:
    plant = builtin_model("arm-disturbed")
    system = published_error_system(plant, design_gao2016(plant), np.array([0.0]))
    assert np.max(np.abs(system.B[:, -1])) > 0.1


def test_a_model_without_faults_is_refused() -> None:
    with pytest.raises(InfeasibleError, match="has none"):
        design_gao2016(replace(builtin_model("arm-disturbed"), faults=()))
