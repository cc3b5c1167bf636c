"""The paper's theorems, corrected, give the bounds that their inequalities can give, and gains that obey them."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from gains_samples import assert_proven, continuous_plant, multirotor

from adapters.errors import InfeasibleError, ModelError
from gains.plants.model_file import builtin_model
from gains.plants.plant import Nonlinearity
from gains.published.theorem import Theorem, design_theorem
from gains.synthesis.continuous_observer import compile_continuous, designed_observer

LONG = pytest.mark.long


def test_theorem_2_bounds_the_disturbed_arm_far_above_its_norm() -> None:
    plant = builtin_model("arm-disturbed")
    design = design_theorem(plant, "theorem2", beta=100.0, epsilon=0.0112, delta=5.0)
    certificate = assert_proven(plant, design)
    assert 0.63 <= design.sqrt_mu <= 0.645
    assert certificate.norm < 0.2
    assert np.array_equal(design.gains.L_i, design.gains.L_p)
    nz = len(design.gains.K)
    assert not design.P[:nz, nz:].any()


def test_theorem_1_is_stopped_below_the_printed_bound() -> None:
    plant = builtin_model("arm")
    design = design_theorem(plant, "theorem1", beta=100.0, epsilon=0.1)
    certificate = assert_proven(plant, design)
    assert design.sqrt_mu <= 2.54e-4
    assert certificate.poles_max < -0.1
    assert any("the bound was stopped at 0.00025" in note for note in design.notes)
    compile_continuous(designed_observer(plant, design), 10.0)


def test_theorem_1_has_no_least_bound() -> None:
    plant = builtin_model("arm")
    for bound in (1e-2, 1e-3):
        design = design_theorem(plant, "theorem1", epsilon=0.1, smallest_sqrt_mu=bound)
        assert_proven(plant, design)
        assert design.sqrt_mu == pytest.approx(bound)


@pytest.mark.long
def test_beta_cancels() -> None:
    plant = builtin_model("arm-disturbed")
    one, hundred = (design_theorem(plant, "theorem2", beta=beta) for beta in (1.0, 100.0))
    assert one.sqrt_mu == pytest.approx(hundred.sqrt_mu, rel=1e-6)


def test_a_constant_slope_is_no_uncertainty() -> None:
    plant = builtin_model("arm-disturbed")
    g = plant.nonlinearities[0]
    constant = replace(plant, nonlinearities=(replace(g, slopes=np.array([[0.5, 0.5]])),))
    linear = replace(plant, A=plant.A + 0.5 * plant.G @ g.rows, G=np.zeros((4, 0)), nonlinearities=())
    bounds = [design_theorem(each, "theorem2").sqrt_mu for each in (constant, linear)]
    assert bounds[0] == pytest.approx(bounds[1], rel=1e-3)


def product(rows: Any, slopes: Any) -> Nonlinearity:
    count = len(rows)
    names = ("a", "b", "c")[:count]
    box = np.tile([-1.0, 1.0], (count, 1))
    return Nonlinearity("sin(" + " + ".join(names) + ")", names, np.array(rows), np.array(slopes), box)


@pytest.mark.long
@pytest.mark.parametrize("theorem", ["theorem1", "theorem2"])
def test_several_nonlinearities_of_several_arguments_share_a_multiplier(theorem: Theorem) -> None:
    plant = builtin_model("arm-disturbed" if theorem == "theorem2" else "arm")
    plant = replace(
        plant,
        G=np.array([[0.0, 0.0], [0.0, 0.3], [0.0, 0.0], [-0.3, 0.0]]),
        nonlinearities=(
            product([[0.0, 0.0, 1.0, 0.0]], [[-1.0, 1.0]]),
            product([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 1.0, 0.0, 0.0]], [[-1, 1], [-1, 1], [0.2, 0.2]]),
        ),
    )
    assert_proven(plant, design_theorem(plant, theorem, epsilon=0.1, delta=5.0))


@pytest.mark.parametrize(
    ("actuators", "sensors"),
    [(1, 0), (0, 1), pytest.param(1, 1, marks=LONG), pytest.param(2, 0, marks=LONG)],
)
def test_any_number_of_faults_is_handled(actuators: int, sensors: int) -> None:
    proven = 0
    for seed in range(3):
        plant = continuous_plant(seed, actuators, sensors)
        try:
            assert_proven(plant, design_theorem(plant, "theorem2", epsilon=0.1, delta=1.0))
            proven += 1
        except InfeasibleError as error:
            assert "theorem2" in str(error)
    assert proven >= 1


def test_scalars_without_a_solution_are_said_to_have_none() -> None:
    with pytest.raises(InfeasibleError, match=r"theorem2 has no solution with epsilon 10 and delta 0\.001"):
        design_theorem(builtin_model("arm-disturbed"), "theorem2", epsilon=10.0, delta=1e-3)


def test_more_vertices_than_can_be_listed_are_refused() -> None:
    plant = builtin_model("arm")
    many = product([[1.0, 0.0, 0.0, 0.0]] * 3, [[-1.0, 1.0]] * 3)
    plant = replace(plant, G=np.zeros((4, 4)), nonlinearities=(many,) * 4)
    with pytest.raises(InfeasibleError, match="12 slopes vary"):
        design_theorem(plant, "theorem1")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"theorem": "theorem2", "beta": 0.0}, "beta is 0.0; it must be positive"),
        ({"theorem": "theorem2", "epsilon": -1.0}, "epsilon is -1.0; it must be positive"),
        ({"theorem": "theorem2", "delta": float("nan")}, "delta is nan; it must be positive"),
        ({"theorem": "theorem1"}, "theorem1 knows no disturbances or noise"),
    ],
)
def test_what_does_not_fit_is_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ModelError, match=message):
        design_theorem(builtin_model("arm-disturbed"), **arguments)


def test_a_discrete_model_is_refused() -> None:
    with pytest.raises(ModelError, match="the model is discrete"):
        design_theorem(multirotor(), "theorem2")
