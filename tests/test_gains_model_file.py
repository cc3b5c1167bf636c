"""Model files read back what was written, and every mistake in one is a line that names file and key."""

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gains_samples import PRINTED, multirotor, random_plant
from hypothesis import assume, given
from hypothesis import strategies as st

from adapters.errors import ModelError
from adapters.toml_tables import LARGEST_BYTES
from gains.plants.discretise import discretise
from gains.plants.model_file import (
    BUILTIN_MODELS,
    builtin_model,
    load_model,
    model_hash,
    read_model,
    write_model,
)
from gains.plants.plant import Disturbance, Fault, Noise, Nonlinearity, Plant

TEXT = """
name = "small"
domain = "discrete"
rate_hz = 50
states = ["angle", "rate"]
inputs = ["torque", "brake"]
outputs = ["encoder"]
taps = [0.5, 0.5]
curves = { torque = [1.0, 0.25] }
offset = { rate = -0.5 }

[A]
angle = { angle = 1.0, rate = 0.02 }
rate = { rate = 0.9 }

[B]
rate = { torque = 0.1, brake = -0.2 }

[C]
encoder = "angle"

[bends]
angle = { brake = [0.0, 0.5] }

[[nonlinearity]]
expression = "sin(v)"
arguments = { v = { angle = 2.0 } }
into = { rate = -0.3 }
range = { v = [-1.0, 1.0] }

[[fault]]
name = "motor"
kind = "actuator"
input = "torque"
rate = 2.0
error = 0.1
unit = "N m"

[[disturbance]]
name = "push"
into = "rate"
scale = 0.01

[[noise]]
name = "jitter"
into = { encoder = 0.001 }

[error]
default = 0.5
angle = 0.01
"""


def assert_equal(found: Any, expected: Any) -> None:
    """Compare plants and their parts field by field."""
    if isinstance(expected, np.ndarray):
        assert np.array_equal(found, expected)
    elif isinstance(expected, tuple):
        assert len(found) == len(expected)
        for one, other in zip(found, expected, strict=True):
            assert_equal(one, other)
    elif isinstance(expected, Plant | Fault | Disturbance | Noise | Nonlinearity):
        for field in fields(expected):
            assert_equal(getattr(found, field.name), getattr(expected, field.name))
    else:
        assert found == expected


def read(text: str, folder: Path) -> Plant:
    path = folder / "model.toml"
    path.write_text(text)
    return read_model(path)


def numbers(size: float = 1e6) -> st.SearchStrategy[float]:
    return st.floats(-size, size, allow_subnormal=True)


@st.composite
def plants(draw: st.DrawFn) -> Plant:
    name = st.from_regex(r"[A-Za-z][A-Za-z0-9_-]{0,6}", fullmatch=True).filter(lambda text: text != "default")
    n, s, p, m = draw(st.integers(1, 3)), draw(st.integers(0, 2)), draw(st.integers(1, 3)), draw(st.integers(0, 1))

    def names(count: int) -> tuple[str, ...]:
        return tuple(draw(st.lists(name, min_size=count, max_size=count, unique=True)))

    def matrix(*shape: int) -> np.ndarray:
        size = int(np.prod(shape))
        return np.array(draw(st.lists(numbers(), min_size=size, max_size=size))).reshape(shape)

    states, inputs, outputs = names(n), names(s), names(p)
    sizes, texts = st.floats(1e-6, 1e6), st.text(st.characters(categories=["L", "N", "P", "S", "Zs"]), max_size=8)
    texts = texts.filter(str.isprintable)
    kinds = draw(st.lists(st.sampled_from(["actuator", "sensor", "input"]), max_size=3))
    if not inputs:
        kinds = [kind for kind in kinds if kind != "input"]
    discrete = draw(st.booleans())
    try:
        return Plant(
            name=draw(name),
            description=draw(texts),
            domain="discrete" if discrete else "continuous",
            rate_hz=draw(sizes) if discrete else None,
            states=states,
            inputs=inputs,
            outputs=outputs,
            A=matrix(n, n),
            B=matrix(n, s),
            C=matrix(p, n),
            c=matrix(n),
            G=matrix(n, m),
            nonlinearities=(
                Nonlinearity(
                    "a*b + sin(a)", ("a", "b"), matrix(2, n), np.array([[-4, 5], [-2, 3]]), np.array([[-2, 3], [-3, 4]])
                ),
            )
            * m,
            faults=tuple(
                Fault(
                    name=f"f{i}",
                    kind="sensor" if kind == "sensor" else "actuator",
                    column=np.zeros(0) if kind == "input" else matrix(p if kind == "sensor" else n),
                    rate=draw(sizes),
                    error=draw(sizes),
                    unit=draw(texts),
                    input=draw(st.sampled_from(inputs)) if kind == "input" else None,
                )
                for i, kind in enumerate(kinds)
            ),
            disturbances=tuple(Disturbance(f"d{i}", matrix(n), draw(sizes)) for i in range(draw(st.integers(0, 2)))),
            noises=tuple(Noise(f"w{i}", matrix(p), draw(sizes)) for i in range(draw(st.integers(0, 2)))),
            state_errors=np.array(draw(st.lists(sizes, min_size=n, max_size=n))),
            taps=(0.25, 0.75) if discrete and draw(st.booleans()) else (1.0,),
            curves=tuple((1.0, draw(numbers())) for _ in inputs),
            bends=np.array([draw(numbers()) if discrete else 0.0 for _ in range(2 * n * s)]).reshape(n, s, 2),
        )
    except ModelError:
        assume(False)
        raise


@given(plants())
def test_a_model_reads_back_equal_to_what_was_written(tmp_path_factory: pytest.TempPathFactory, plant: Plant) -> None:
    path = tmp_path_factory.mktemp("models") / "model.toml"
    if plant.nonlinearities and not plant.G.any():
        return
    write_model(plant, path)
    found = read_model(path)
    assert_equal(found, plant)
    assert model_hash(found) == model_hash(plant)


@pytest.mark.parametrize("name", BUILTIN_MODELS)
def test_the_built_in_models_are_the_papers_arm(name: str) -> None:
    plant = load_model(name)
    for key in ("A", "B", "G", "C", "D_f"):
        assert getattr(plant, key).tolist() == PRINTED[key]
    assert plant.E_f.tolist() == PRINTED["B"]
    assert plant.nonlinearities[0].rows.tolist() == [[0, 0, 1, 0]]
    assert plant.nonlinearities[0].slopes.tolist() == [[-1, 1]]
    if name == "arm-disturbed":
        assert plant.E_1.tolist() == PRINTED["E_1"]
        assert plant.D_1.tolist() == PRINTED["D_1"]
    else:
        assert not plant.disturbances
        assert not plant.noises


def test_tables_by_name_shorthands_and_defaults_mean_what_they_say(tmp_path: Path) -> None:
    plant = read(TEXT, tmp_path)
    assert plant.A.tolist() == [[1.0, 0.02], [0.0, 0.9]]
    assert plant.B.tolist() == [[0.0, 0.0], [0.1, -0.2]]
    assert plant.C.tolist() == [[1.0, 0.0]]
    assert plant.c.tolist() == [0.0, -0.5]
    assert plant.curves == ((1.0, 0.25), (1.0,))
    assert plant.bends.tolist() == [[[0.0, 0.0], [0.0, 0.5]], [[0.0, 0.0], [0.0, 0.0]]]
    assert plant.B_r.tolist() == [[0.0, 0.0, 1.0], [0.1, -0.2, 0.0]]
    assert plant.E_f.tolist() == [[0.0], [0.1]]
    assert plant.E_1.tolist() == [[0.0], [1.0]]
    assert plant.state_errors.tolist() == [0.01, 0.5]
    assert plant.nonlinearities[0].slopes[0] == pytest.approx([np.cos(1.0), 1.0], rel=1e-4)


def test_the_hash_follows_the_content_and_not_the_looks(tmp_path: Path) -> None:
    plant = read(TEXT, tmp_path)
    nested = TEXT.replace("[A]\nangle = { angle = 1.0, rate = 0.02 }\nrate = { rate = 0.9 }", "")
    nested = nested.replace("\nname", "# a comment\nA = [[1, 2e-2], [0, 0.90]]\nname", 1)
    assert model_hash(read(nested, tmp_path)) == model_hash(plant)
    assert model_hash(replace(plant, description="other")) == model_hash(plant)
    assert model_hash(read(TEXT.replace("0.02 }", "0.020000000000000004 }"), tmp_path)) != model_hash(plant)
    assert model_hash(read(TEXT.replace("rate = 2.0", "rate = 3.0"), tmp_path)) != model_hash(plant)


@pytest.mark.parametrize("plant", [multirotor(), random_plant(3, 1, 1), discretise(builtin_model("arm"), 30.0)])
def test_discrete_models_survive_the_file_to_the_last_bit(plant: Plant, tmp_path: Path) -> None:
    write_model(plant, tmp_path / "model.toml")
    assert_equal(read_model(tmp_path / "model.toml"), plant)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('name = "small"', "", "'name' is missing"),
        ('name = "small"', 'name = 3', "'name' is 3, which is not text in quotes"),
        ('name = "small"', 'name = "a\\nb"', "'name' is not one line of text"),
        ("rate_hz = 50", "rate = 50", "'rate' is not a key of this table; did you mean 'rate_hz'"),
        ("rate_hz = 50", "rate_hz = nan", "'rate_hz' is nan, which is not a finite number"),
        ("rate_hz = 50", "rate_hz = true", "'rate_hz' is true, which is not a number"),
        ('"discrete"', '"sampled"', "'domain' is \"sampled\"; it must be 'continuous' or 'discrete'"),
        ('states = ["angle", "rate"]', 'states = "angle"', "'states' is \"angle\", which is not a list"),
        ('states = ["angle", "rate"]', 'states = ["angle", "angle"]', "'C.encoder'|'states' has the name|there is no 'rate'"),  # noqa: E501 - a table of mistakes reads best with one to a line
        ("angle = { angle = 1.0, rate = 0.02 }", "angle = { angle = 1.0, speed = 0.02 }", "'A.angle.speed': there is no 'speed'; there are angle, rate"),  # noqa: E501 - a table of mistakes reads best with one to a line
        ("angle = { angle = 1.0, rate = 0.02 }", "angle = { angle = inf }", "'A.angle.angle' is inf, which is not a finite number"),  # noqa: E501
        ("angle = { angle = 1.0, rate = 0.02 }", "angle = [1.0]", "'A.angle' has 1 numbers for angle, rate"),
        ("rate = { torque = 0.1, brake = -0.2 }", "speed = { torque = 0.1 }", "'B.speed': there is no 'speed'"),
        ("taps =", "A = [[1, 0], [0]]\ntaps =", "not valid TOML"),
        ('encoder = "angle"', "encoder = 3", "'C.encoder' is not a list of numbers"),
        ("taps = [0.5, 0.5]", "taps = [0.5, 0.6]", "'taps' add up to 1.1"),
        ("curves = { torque", "curves = { motor", "'curves.motor': there is no 'motor'"),
        ("angle = { brake", "angle = { motor", "'bends.angle.motor': there is no 'motor'"),
        ("angle = { brake", "speed = { brake", "'bends.speed' is not a key of this table"),
        ("offset = { rate", "offset = { speed", "'offset.speed': there is no 'speed'"),
        ('"sin(v)"', '"sin(w)"', r"'nonlinearity\[0\].expression': 'sin\(w\)' has the unknown name 'w'"),
        ('"sin(v)"', '"v**-1"', r"has no value, or a pole"),
        ("range = { v = [-1.0, 1.0] }", "slope = { v = [-1.0, 0.5] }", "is 1 at v = 0, above the declared 0.5"),
        ("range = { v = [-1.0, 1.0] }", "range = { v = [1.0, -1.0] }", r"'nonlinearity\[0\].range.v' is \[1, -1\]"),
        ("range = { v = [-1.0, 1.0] }", "range = { w = [-1.0, 1.0] }", "there is no 'w'"),
        ("range = { v = [-1.0, 1.0] }", "slope = {}", r"'nonlinearity\[0\].slope.v' is missing"),
        ("arguments = { v = { angle = 2.0 } }", "arguments = { v = { speed = 2.0 } }", r"'nonlinearity\[0\].arguments.v.speed'"),  # noqa: E501 - a table of mistakes reads best with one to a line
        ("arguments = { v = { angle = 2.0 } }", "", r"'nonlinearity\[0\].arguments' is not a table of rows"),
        ("into = { rate = -0.3 }", "", r"'nonlinearity\[0\].into' is missing or zero"),
        ('kind = "actuator"', 'kind = "motor"', r"'fault\[0\].kind' is \"motor\""),
        ('input = "torque"', 'input = "throttle"', "fault 'motor': there is no input 'throttle'; there are torque, brake"),  # noqa: E501 - a table of mistakes reads best with one to a line
        ('input = "torque"', "", r"'fault\[0\].into': give either"),
        ('input = "torque"', 'input = "torque"\ninto = "rate"', r"'fault\[0\].into': give either"),
        ("error = 0.1", "error = -0.1", "fault 'motor': 'error' is -0.1"),
        ("[[fault]]", "[fault]", "'fault' is a single table; write"),
        ('into = "rate"\nscale', 'into = "speed"\nscale', r"'disturbance\[0\].into': there is no 'speed'"),
        ("scale = 0.01", "size = 0.01", r"'disturbance\[0\].size' is not a key of this table"),
        ("scale = 0.01", "scale = -1", "disturbance 'push': 'scale' is -1"),
        ("into = { encoder = 0.001 }", "", "noise 'jitter': 'into' is zero"),
        ("angle = 0.01", "speed = 0.01", "'error.speed' is not a key of this table; known here: angle, default, rate"),
        ("angle = 0.01", "angle = 0", "error.angle is not positive"),
        ("[A]", "[A", r"model.toml:12: not valid TOML at column"),
        ("[A]", "[B]\n[A]", "not valid TOML"),
    ],
)  # fmt: skip
def test_a_mistake_is_one_line_with_file_and_key(old: str, new: str, message: str, tmp_path: Path) -> None:
    assert old in TEXT
    with pytest.raises(ModelError, match=message) as caught:
        read(TEXT.replace(old, new, 1), tmp_path)
    assert str(caught.value).startswith(str(tmp_path / "model.toml"))
    assert "\n" not in str(caught.value)
    assert caught.value.exit_status == 2


def test_files_that_are_no_models_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"missing.toml: no such file"):
        read_model(tmp_path / "missing.toml")
    with pytest.raises(ModelError, match="not a file"):
        read_model(tmp_path)
    with pytest.raises(
        ModelError, match=r"neither a file nor a built-in model; the built-in models are arm, arm-disturbed"
    ):
        load_model("leg")
    (tmp_path / "bytes.toml").write_bytes(b"name = '\xff'")
    with pytest.raises(ModelError, match="not valid TOML: byte 8 is no UTF-8"):
        read_model(tmp_path / "bytes.toml")
    (tmp_path / "deep.toml").write_text("a = " + "[" * 100_000)
    with pytest.raises(ModelError, match="nested too deeply"):
        read_model(tmp_path / "deep.toml")


def test_a_huge_file_is_refused_without_reading_it(tmp_path: Path) -> None:
    path = tmp_path / "huge.toml"
    with path.open("wb") as file:
        file.truncate(1 << 30)
    with pytest.raises(ModelError, match=f"1073741824 bytes is more than the {LARGEST_BYTES} that are read"):
        read_model(path)


def test_a_huge_whole_number_is_no_number(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"'rate_hz' is 1000.*, which is not a finite number"):
        read(TEXT.replace("rate_hz = 50", "rate_hz = 1" + "0" * 400), tmp_path)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("[[1, 0, 0]]", "'C' is 1 x 3 but the names make it 1 x 2"),
        ("[[1, 0], [0]]", "'C' is not a rectangular array of numbers"),
        ("[[1, nan]]", r"'C\[0\]\[1\]' is nan, which is not a finite number"),
        ('[["1", 0]]', r"'C\[0\]\[0\]' is .1., which is not a number"),
        ("[1, 0]", r"'C\[0\]' is not a list of numbers"),
        ("3", "'C' is neither a list of rows nor a table of rows by name"),
    ],
)
def test_a_matrix_in_lists_has_the_shape_of_the_names(rows: str, message: str, tmp_path: Path) -> None:
    text = TEXT.replace('[C]\nencoder = "angle"', "").replace("taps =", f"C = {rows}\ntaps =")
    with pytest.raises(ModelError, match=message):
        read(text, tmp_path)


def test_a_sampled_plant_is_written_and_read_back_with_what_it_looks_ahead(tmp_path: Path) -> None:
    arm = builtin_model("arm-disturbed")
    (g,) = arm.nonlinearities
    arm = replace(arm, c=np.ones(4), nonlinearities=(replace(g, rates=np.array([2.0])),))
    plant = discretise(arm, 20.0)
    write_model(plant, tmp_path / "sampled.toml")
    again = read_model(tmp_path / "sampled.toml")
    assert model_hash(again) == model_hash(plant)
    assert np.array_equal(again.H_f, plant.H_f)
    assert np.array_equal(again.H_known, plant.H_known)
    assert again.nonlinearities[0].rates.tolist() == [2.0]
