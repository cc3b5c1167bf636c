"""A rover learned from rides that are known exactly."""

import numpy as np
import pytest
from simulated_vehicles import DRIVE, RATE_HZ, STEERING, ride

from adapters.errors import ModelError
from gains.identification.segment import Segment
from monitor.vehicles.rover.fit import identify_drive
from monitor.vehicles.rover.transform import DriveInputs


def test_steering_and_throttle_are_recovered_also_in_reverse() -> None:
    fit = identify_drive([ride(1), ride(2)], RATE_HZ, DriveInputs.inputs)
    assert [axis.a for axis in fit.axes] == pytest.approx([STEERING[0], DRIVE[0]], abs=0.02)
    assert [axis.b for axis in fit.axes] == pytest.approx([STEERING[1], DRIVE[1]], rel=0.03)
    assert fit.curves["steering_cubic"] == pytest.approx(0.0, abs=0.01)
    assert all(verdict.excited for verdict in fit.excitation)


@pytest.mark.parametrize("cubic", [-0.2, 0.15])
def test_the_steerings_curve_is_learned_through_noise(cubic: float) -> None:
    fit = identify_drive([ride(3, cubic=cubic, noise=0.02)], RATE_HZ, DriveInputs.inputs)
    assert fit.curves["steering_cubic"] == pytest.approx(cubic, abs=0.03)
    gain = fit.axes[0].b / (1.0 - fit.axes[0].a)
    assert gain == pytest.approx(STEERING[1] / (1.0 - STEERING[0]), rel=0.03)


def test_two_sides_turn_a_rover_at_every_speed() -> None:
    ridden = ride(3, cubic=0.15, noise=0.02, differential=True)
    fit = identify_drive([ridden], RATE_HZ, DriveInputs.inputs, differential=True)
    assert fit.curves["steering_cubic"] == pytest.approx(0.15, abs=0.03)
    assert fit.axes[0].b == pytest.approx(STEERING[1], rel=0.05)


def test_the_transform_takes_what_was_learned() -> None:
    fit = identify_drive([ride(3, cubic=-0.2)], RATE_HZ, DriveInputs.inputs)
    DriveInputs(fit.parameters() | {"reference_speed": 1.0, "minimum_speed": 0.3}, RATE_HZ, RATE_HZ)


def test_a_fault_is_the_actuators_own_column() -> None:
    plant = identify_drive([ride(1)], RATE_HZ, DriveInputs.inputs).plant("rover")
    assert [fault.name for fault in plant.faults] == ["steering", "throttle"]
    assert np.array_equal(plant.E_f, plant.B[:, :2])


def test_a_ride_straight_ahead_leaves_the_steering_unwatched_and_says_what_to_drive() -> None:
    fit = identify_drive([ride(1, straight=True, noise=0.01)], RATE_HZ, DriveInputs.inputs)
    assert [verdict.excited for verdict in fit.excitation] == [False, True]
    assert "slalom" in fit.excitation[0].advice
    assert [fault.name for fault in fit.plant("rover").faults] == ["throttle"]


def test_outputs_that_drive_nothing_are_refused() -> None:
    rng = np.random.default_rng(0)
    real = ride(1)
    with pytest.raises(ModelError, match=r"check (that this|which) servo output"):
        identify_drive(
            [Segment(rng.normal(size=real.u.shape), rng.normal(size=real.y.shape))], RATE_HZ, DriveInputs.inputs
        )
