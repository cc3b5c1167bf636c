"""A plane learned from flights that are known exactly."""

import numpy as np
import pytest
from simulated_vehicles import DELAY_S, LAG_S, PITCH, RATE_HZ, ROLL, THRUST, YAW, flight

from adapters.errors import ModelError
from gains.identification.axes import AxesFit
from gains.identification.regression import lagged
from gains.identification.segment import Segment
from gains.synthesis.certificate import certify
from gains.synthesis.compilation import compile_gains
from gains.synthesis.convex import design_convex
from gains.synthesis.gains_file import Gains
from monitor.estimation.affine import AffineObserver
from monitor.vehicles.plane.fit import identify_surfaces
from monitor.vehicles.plane.transform import SurfaceInputs


@pytest.fixture(scope="module")
def fit() -> AxesFit:
    return identify_surfaces([flight(1), flight(2)], RATE_HZ, SurfaceInputs.inputs)


@pytest.fixture(scope="module")
def gains(fit: AxesFit) -> Gains:
    plant = fit.plant("plane")
    design = design_convex(plant, RATE_HZ)
    return compile_gains(plant, design, certify(plant, design))


def test_every_surface_gets_its_own_coefficients(fit: AxesFit) -> None:
    found = [(axis.a, axis.b) for axis in fit.axes]
    assert np.array(found) == pytest.approx(np.array([ROLL, PITCH, YAW, THRUST]), rel=0.03, abs=1e-9)
    assert [axis.model.actuator for axis in fit.axes] == list(SurfaceInputs.actuators)
    assert all(verdict.excited for verdict in fit.excitation)


def test_the_timing_is_what_the_transform_takes(fit: AxesFit) -> None:
    parameters = fit.parameters()
    assert parameters == {
        f"{name}_{key}": value for name in SurfaceInputs.actuators for key, value in (("delay_s", 0.04), ("lag_s", 0.1))
    }
    SurfaceInputs(parameters | {"reference_speed": 20.0, "minimum_speed": 10.0}, RATE_HZ, RATE_HZ)
    assert (LAG_S, DELAY_S) == (0.1, 0.04)


def test_a_fault_is_the_surfaces_own_column(fit: AxesFit) -> None:
    plant = fit.plant("plane")
    assert [fault.input for fault in plant.faults] == list(SurfaceInputs.actuators)
    assert np.array_equal(plant.E_f, plant.B[:, :4])
    assert plant.outputs == SurfaceInputs.outputs


def test_the_observer_names_the_surface_and_what_it_lacks(gains: Gains) -> None:
    healthy = flight(5)
    lost = 0.2
    y = healthy.y.copy()
    effect = np.zeros(len(y))
    for k in range(1200, len(y) - 1):
        effect[k + 1] = ROLL[0] * effect[k] + ROLL[1] * lost
    y[:, 0] += effect
    u = healthy.u.copy()
    for column in range(4):
        u[:, column] = lagged(u[:, column], DELAY_S, LAG_S, RATE_HZ)
    fault = AffineObserver([gains]).run(u, y).fault
    assert fault[1300:].mean(axis=0) == pytest.approx([lost, 0.0, 0.0, 0.0], abs=0.01)
    assert fault[100:1200].mean(axis=0) == pytest.approx(np.zeros(4), abs=0.01)


def test_a_surface_that_did_not_move_is_not_watched_and_the_manoeuvre_is_named() -> None:
    fit = identify_surfaces([flight(1, idle="elevator")], RATE_HZ, SurfaceInputs.inputs)
    verdict = fit.excitation[1]
    assert (verdict.actuator, verdict.excited) == ("elevator", False)
    assert "pull up and push over" in verdict.advice
    assert [fault.name for fault in fit.plant("plane").faults] == ["aileron", "rudder", "throttle"]


def test_a_rudder_that_only_follows_the_aileron_is_not_watched() -> None:
    fit = identify_surfaces([flight(1, mixed=True)], RATE_HZ, SurfaceInputs.inputs)
    assert [verdict.excited for verdict in fit.excitation] == [True, True, False, True]
    assert "rudder alone" in fit.excitation[2].advice


def test_outputs_that_drive_nothing_are_refused() -> None:
    rng = np.random.default_rng(0)
    real = flight(1)
    u = real.u.copy()
    u[:, :4] = rng.normal(scale=0.1, size=(len(u), 4))
    with pytest.raises(ModelError, match=r"check (that this|which) servo output"):
        identify_surfaces([Segment(u, rng.normal(size=real.y.shape))], RATE_HZ, SurfaceInputs.inputs)
