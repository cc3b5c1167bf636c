"""The error system found from any observer is the one the theory writes down."""

from dataclasses import replace

import numpy as np
import pytest
from paper_gains import BETA, PRINTED

from adapters.errors import ModelError
from gains.analysis.augment import augment, slope_matrix
from gains.plants.model_file import builtin_model
from gains.plants.plant import Plant
from gains.published.error_system import error_norm, published_error_system
from gains.synthesis.continuous_observer import ContinuousObserver, fauio_observer


def printed(name: str) -> tuple[Plant, ContinuousObserver]:
    plant, law = builtin_model(name), BETA * PRINTED[name].L2
    return plant, fauio_observer(plant, PRINTED[name].K, law, law, "printed")


@pytest.mark.parametrize(("name", "norm"), [("arm", 2.16e-4), ("arm-disturbed", 0.1878)])
def test_the_printed_gains_have_the_norm_that_the_theory_states(name: str, norm: float) -> None:
    plant, observer = printed(name)
    assert error_norm(plant, observer, noise_path="all").value == pytest.approx(norm, rel=2e-3)


def test_the_printed_gains_have_the_poles_that_the_theory_states() -> None:
    plant, observer = printed("arm-disturbed")
    poles = np.sort(np.linalg.eigvals(published_error_system(plant, observer, np.array([0.5])).A).real)
    assert poles == pytest.approx([-33_280, -170, -12.26, -0.998, -0.998, -0.383], rel=0.01)


def test_it_is_similar_to_the_error_system_of_the_theory() -> None:
    rng = np.random.default_rng(0)
    plant = builtin_model("arm-disturbed")
    plant = replace(plant, faults=tuple(replace(fault, rate=3.0, error=0.5) for fault in plant.faults))
    K, L_i, L_p = rng.normal(size=(5, 3)), rng.normal(size=(1, 3)), rng.normal(size=(1, 3))
    found = published_error_system(plant, fauio_observer(plant, K, L_i, L_p, "any"), np.array([0.3]))
    a = augment(plant)
    injection = np.vstack([K + a.L1 @ plant.E_f @ L_p, L_i])
    C_a, D = np.hstack([a.C_b, np.zeros((3, 1))]), np.hstack([np.zeros((3, 1)), plant.D_1])
    A = np.zeros((6, 6))
    A[:5] = np.hstack([a.L1 @ a.A_z, a.L1 @ plant.E_f])
    A[:5, :4] += a.L1 @ plant.G * 0.3 @ plant.nonlinearities[0].rows
    A -= injection @ C_a
    E = np.hstack([plant.E_1, np.zeros((4, 1))])
    B = np.zeros((6, 5))
    B[:5, :2], B[:5, 2:4], B[5, 4] = a.L1 @ E, -a.F @ D, 3.0
    B[:, :2] -= injection @ D
    C = np.vstack([np.eye(6)[:5], np.eye(6)[5:] - L_p @ C_a])
    feedthrough = np.zeros((6, 5))
    feedthrough[5:, :2] = -L_p @ D
    weights = np.array([[1.0], [1.0], [1.0], [1.0], [2.0], [2.0]])
    for omega in (0.0, 0.7, 20.0):
        expected = C @ np.linalg.solve(1j * omega * np.eye(6) - A, B) + feedthrough
        response = found.C @ np.linalg.solve(1j * omega * np.eye(6) - found.A, found.B) + found.D
        assert response == pytest.approx(np.hstack([weights * expected, np.zeros((6, 1))]), abs=1e-9)


def test_a_sensor_fault_that_needs_no_assumption_has_no_column() -> None:
    plant, observer = printed("arm-disturbed")
    system = published_error_system(plant, observer, np.array([0.0]))
    assert np.max(np.abs(system.B[:, -1])) < 1e-9


@pytest.mark.parametrize("matrix", ["step", "output", "into"])
def test_an_observer_whose_error_depends_on_the_plant_is_refused(matrix: str) -> None:
    plant, observer = printed("arm-disturbed")
    with pytest.raises(ModelError, match="depends on"):
        published_error_system(plant, replace(observer, **{matrix: getattr(observer, matrix) + 0.1}), np.array([0.0]))


def test_slopes_of_several_arguments_belong_to_their_own_nonlinearity() -> None:
    g = builtin_model("arm").nonlinearities[0]
    two = replace(g, arguments=("a", "b"), rows=np.vstack([g.rows, g.rows]), slopes=np.tile(g.slopes, (2, 1)))
    plant = builtin_model("arm")
    two = replace(two, expression="sin(a)+b", ranges=np.tile(g.ranges, (2, 1)))
    plant = replace(plant, G=np.hstack([plant.G, plant.G]), nonlinearities=(two, g))
    assert slope_matrix(plant, np.array([1.0, 2.0, 3.0])).tolist() == [[1.0, 2.0, 0.0], [0.0, 0.0, 3.0]]
