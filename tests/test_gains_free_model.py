"""Model files with free parameters: what may be an expression, and one-line errors."""

from pathlib import Path

import numpy as np
import pytest
from gains_samples import dynamics_of

from adapters.errors import ModelError
from gains.identification.free_model import FreeModel, read_free_model
from gains.plants.model_file import builtin_model, read_model, write_model

TEXT = """
name = "cart"
states = ["position", "speed"]
inputs = ["force"]
outputs = ["position"]
[parameters]
mass = { start = 2.0, min = 0.5, max = 8.0 }
drag = { start = 0.3, min = 0.0 }
spring = 4.0
[A]
position = { speed = 1.0 }
speed = { position = "-spring / mass" }
[B]
speed = { force = "1 / mass" }
[C]
position = "position"
[[nonlinearity]]
expression = "tanh(drag * v)"
arguments = { v = "speed" }
into = { speed = "-1 / mass" }
[[fault]]
name = "push"
kind = "actuator"
input = "force"
[[disturbance]]
name = "wind"
into = "speed"
scale = "0.1 / mass"
[channels.force]
message = "F"
field = "f"
[phase]
require_armed = false
"""


def read(folder: Path, text: str = TEXT) -> FreeModel:
    path = folder / "cart.toml"
    path.write_text(text)
    return read_free_model(path)


def test_expressions_become_the_numbers_of_their_parameters(tmp_path: Path) -> None:
    plant = read(tmp_path).plant([4.0, 0.5])
    assert plant.A.tolist() == [[0.0, 1.0], [-1.0, 0.0]]
    assert plant.B.tolist() == [[0.0], [0.25]]
    assert plant.disturbances[0].scale == pytest.approx(0.025)
    assert plant.nonlinearities[0].slopes[0] == pytest.approx([0.0, 0.5], abs=1e-6)


def test_free_and_fixed_parameters_are_told_apart(tmp_path: Path) -> None:
    model = read(tmp_path)
    assert [(p.name, p.start, p.low, p.high) for p in model.parameters] == [
        ("mass", 2.0, 0.5, 8.0),
        ("drag", 0.3, 0.0, np.inf),
    ]
    assert model.fixed == {"spring": 4.0}


def test_channels_and_phase_are_kept_for_others(tmp_path: Path) -> None:
    model = read(tmp_path)
    assert model.file.root.table("channels").raw("force") == {"message": "F", "field": "f"}
    assert model.file.root.raw("phase") == {"require_armed": False}


def test_the_equations_for_simulation_are_those_of_the_plant(tmp_path: Path) -> None:
    model = read(tmp_path)
    quick, plant = model.dynamics([4.0, 0.5]), dynamics_of(model.plant([4.0, 0.5]))
    for name in ("A", "B", "C", "c", "G", "curves"):
        assert np.array_equal(getattr(quick, name), getattr(plant, name))
    v = np.array([[0.3, -2.0]])
    values = [np.array([[value]]) for value in quick.parameters]
    assert quick.functions[0]([v, *values]) == pytest.approx(plant.functions[0]([v]))


def test_the_fitted_plant_is_a_plain_model(tmp_path: Path) -> None:
    plant = read(tmp_path).plant([4.0, 0.5])
    write_model(plant, tmp_path / "plain.toml")
    assert np.array_equal(read_model(tmp_path / "plain.toml").A, plant.A)


def test_a_plain_model_is_one_without_free_parameters(tmp_path: Path) -> None:
    write_model(builtin_model("arm"), tmp_path / "arm.toml")
    model = read_free_model(tmp_path / "arm.toml")
    assert model.parameters == ()
    assert np.array_equal(model.plant([]).A, builtin_model("arm").A)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("spring = 4.0", "spring = 4.0\nlength = 1.0", "'parameters.length' is used nowhere"),
        ("spring = 4.0", "", "unknown name 'spring'"),
        ("start = 2.0, ", "", "'parameters.mass.start' is missing"),
        ("start = 2.0", "start = 20.0", "not between 0.5 and 8"),
        ("spring = 4.0", "spring = 4.0\npi = 1.0", "'parameters.pi'"),
        ('"1 / mass"', '"1 / (mass - 2)"', "has no value at mass = 2"),
        ('"1 / mass"', '"mass.real"', "not allowed"),
        ("v = ", "mass = ", "also the name of a parameter"),
        ("start = 2.0,", "start = 2.0, typo = 1,", "'parameters.mass.typo'"),
    ],
)
def test_mistakes_are_named_in_one_line(tmp_path: Path, old: str, new: str, said: str) -> None:
    with pytest.raises(ModelError) as caught:
        read(tmp_path, TEXT.replace(old, new, 1))
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)
    assert str(tmp_path) in str(caught.value)
