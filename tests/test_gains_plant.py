"""A plant checks shapes, names and numbers, and cannot be changed afterwards."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from gains_samples import multirotor, random_plant, sine

from adapters.errors import ModelError
from gains.analysis.augment import augment
from gains.plants.plant import Disturbance, Fault, Noise, Plant


def small(**changes: Any) -> Plant:
    fields: dict[str, Any] = {
        "name": "small",
        "states": ("a", "b"),
        "inputs": ("u",),
        "outputs": ("y", "z"),
        "A": np.zeros((2, 2)),
        "B": np.array([[1.0], [2.0]]),
        "C": np.eye(2),
    }
    return Plant(**(fields | changes))


def test_what_is_left_out_has_its_default() -> None:
    plant = small()
    assert plant.domain == "continuous"
    assert plant.c.tolist() == [0.0, 0.0]
    assert plant.G.shape == (2, 0)
    assert plant.state_errors.tolist() == [1.0, 1.0]
    assert plant.curves == ((1.0,),)
    assert not plant.bends.size
    assert np.array_equal(plant.B_r, plant.B)
    assert plant.E_f.shape == (2, 0)
    assert plant.D_1.shape == (2, 0)


def test_arrays_are_copied_and_read_only() -> None:
    A = np.zeros((2, 2))
    plant = small(A=A)
    A[0, 0] = 1.0
    assert plant.A[0, 0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        plant.A[0, 0] = 1.0


def test_fault_columns_are_gathered_by_kind_in_the_order_of_the_faults() -> None:
    faults = (Fault("s", "sensor", np.array([0.0, 1.0])), Fault("m", "actuator", input="u"))
    plant = small(faults=faults)
    assert plant.E_f.tolist() == [[1.0], [2.0]]
    assert plant.D_f.tolist() == [[0.0], [1.0]]
    assert [fault.name for fault in plant.actuator_faults] == ["m"]


def test_an_input_fault_may_repeat_its_column_of_B_but_not_another() -> None:
    assert small(faults=(Fault("m", "actuator", np.array([1.0, 2.0]), input="u"),)).E_f.tolist() == [[1.0], [2.0]]
    with pytest.raises(ModelError, match="its column is not that of the input 'u' in B"):
        small(faults=(Fault("m", "actuator", np.array([1.0, 1.0]), input="u"),))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"A": np.zeros((2, 3))}, "'A' is 2 x 3 but the names make it 2 x 2"),
        ({"B": np.array([[np.nan], [0.0]])}, "'B' holds a number that is not finite"),
        ({"C": [["x"]]}, "'C' is not a rectangular array of numbers"),
        ({"c": np.array([np.inf, 0.0])}, "'c' holds a number that is not finite"),
        ({"name": "two words"}, "'name' is 'two words'"),
        ({"states": ("a", "a")}, "'states' has the name 'a' twice"),
        ({"states": ("a", "default")}, "'states' has the name 'default'"),
        ({"outputs": ()}, "'outputs' is empty"),
        ({"inputs": ("1",)}, "'inputs' has the name '1'"),
        ({"domain": "digital"}, "'domain' is 'digital'"),
        ({"domain": "discrete"}, "'rate_hz' is missing or not positive"),
        ({"rate_hz": 10.0}, "'rate_hz' belongs to a discrete model"),
        ({"taps": (0.5, 0.5)}, "'taps' are delays in samples and need a discrete model"),
        ({"taps": (0.9,)}, r"'taps' add up to 0.9"),
        ({"taps": ()}, "'taps' is empty"),
        ({"curves": ((1.0,), (1.0,))}, "'curves' has 2 entries for 1 inputs"),
        ({"curves": ((0.0, 0.0),)}, "'curves.u' needs"),
        ({"bends": np.ones((2, 1, 2))}, "'bends' are known for the steps of a discrete model only"),
        ({"bends": np.ones((1, 1, 2))}, "'bends' is 1 x 1 x 2 but the names make it 2 x 1 x 2"),
        ({"state_errors": np.array([1.0, 0.0])}, "error.b is not positive"),
        ({"faults": (Fault("m", "motor", np.ones(2)),)}, "'kind' is 'motor'"),  # type: ignore[arg-type]
        ({"faults": (Fault("m", "actuator", np.ones(3)),)}, "fault 'm': into' is 3"),
        ({"faults": (Fault("m", "actuator", input="w"),)}, "there is no input 'w'"),
        ({"faults": (Fault("m", "sensor", input="u"),)}, "'input' belongs to an actuator fault"),
        ({"faults": (Fault("m", "actuator", np.ones(2), rate=0.0),)}, "'rate' is 0.0"),
        ({"faults": (Fault("m", "actuator", np.ones(2), error=np.nan),)}, "'error' is nan"),
        ({"faults": (Fault("m", "actuator", np.zeros(2)),)}, r"fault 'm': its direction \(E_f\) is zero"),
        ({"disturbances": (Disturbance("d", np.zeros(2)),)}, "disturbance 'd': 'into' is zero"),
        ({"noises": (Noise("w", np.ones(2), -1.0),)}, "noise 'w': 'scale' is -1.0"),
        ({"nonlinearities": (sine(np.ones(2)),), "G": np.zeros((2, 2))}, "'G' is 2 x 2 but"),
        ({"nonlinearities": (sine(np.ones(2), (1.0, -1.0)),), "G": np.ones((2, 1))}, "'slope' needs the lower"),
    ],
)
def test_what_cannot_be_is_refused_with_the_key_named(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ModelError, match=message):
        small(**changes)


@pytest.mark.parametrize("kind", ["actuator", "sensor"])
def test_no_observer_is_made_for_rank_deficient_fault_directions_and_the_fault_is_named(kind: Any) -> None:
    columns = (np.array([1.0, 2.0]), np.array([-1e-3, -2e-3]))
    faults = tuple(Fault(f"f{i}", kind, column) for i, column in enumerate(columns))
    with pytest.raises(ModelError, match=r"fault 'f1': .* a combination of those of 'f0': they cannot be told apart"):
        augment(small(faults=faults))


def test_directions_in_very_different_units_are_not_taken_for_dependent() -> None:
    columns = (np.array([1e-9, 0.0]), np.array([1.0, 1e6]))
    augment(small(faults=tuple(Fault(f"f{i}", "actuator", column) for i, column in enumerate(columns))))


def test_the_sample_plants_are_plants() -> None:
    assert multirotor().E_f.shape == (4, 4)
    assert replace(random_plant(1, 1, 1), name="other").name == "other"
