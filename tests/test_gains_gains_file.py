"""A gains file reads back to the same bits, and a damaged one is refused in one line."""

import json
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gains_samples import multirotor, random_plant

from adapters.errors import ModelError
from gains.plants.plant import Plant
from gains.synthesis.certificate import certify
from gains.synthesis.compilation import compile_gains
from gains.synthesis.convex import design_convex
from gains.synthesis.gains_file import Gains, read_gains, write_gains


def compiled(plant: Plant, integrator_order: int = 1) -> Gains:
    design = design_convex(plant, integrator_order=integrator_order)
    return compile_gains(plant, design, certify(plant, design))


@pytest.fixture(scope="module")
def gains() -> Gains:
    return compiled(random_plant(31, 1, 1, nonlinear=1))


@pytest.mark.parametrize(
    ("plant", "order"),
    [
        (multirotor(), 1),
        (random_plant(34, 1, 1), 2),
        (random_plant(32, 0, 1), 1),
        (random_plant(33, 1, 0, nonlinear=2), 1),
    ],
)
def test_gains_read_back_to_the_same_bits(plant: Plant, order: int, tmp_path: Path) -> None:
    expected = compiled(plant, order)
    write_gains(expected, tmp_path / "gains.json")
    found = read_gains(tmp_path / "gains.json")
    for field in fields(Gains):
        one, other = getattr(found, field.name), getattr(expected, field.name)
        if isinstance(other, np.ndarray):
            assert one.shape == other.shape
            assert one.tobytes() == np.ascontiguousarray(other).tobytes()
        else:
            assert one == other


def test_the_file_is_readable_json_with_a_row_to_a_line(gains: Gains, tmp_path: Path) -> None:
    write_gains(gains, tmp_path / "gains.json")
    text = (tmp_path / "gains.json").read_text()
    assert json.loads(text)["model"] == "random"
    assert len(text.splitlines()) > len(gains.step_matrix)
    assert text.isascii()


def change(key: str, value: Any) -> Callable[[dict[str, Any]], None]:
    return lambda document: document.__setitem__(key, value)


def rows(key: str, edit: Callable[[list[list[Any]]], None]) -> Callable[[dict[str, Any]], None]:
    return lambda document: edit(document[key]["rows"])


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (change("format", 3), "'format' is not 2"),
        (lambda document: document.pop("K"), "'K' is missing"),
        (change("model", 3), "'model' is not text"),
        (change("states", ["x0"]), "where the names make it"),
        (change("faults", ["one", 2]), "'faults' is not a list of names"),
        (change("fault_kinds", ["sensor", "actuator"]), "'fault_kinds' is not actuator faults first"),
        (change("fault_inputs", [9, None]), "'fault_inputs' names an input that does not exist"),
        (change("fault_inputs", [True, None]), "'fault_inputs' is not a list of indices"),
        (change("fault_units", []), "differ in length"),
        (change("rate_hz", -1.0), "'rate_hz' is not positive"),
        (change("rate_hz", float("nan")), "'rate_hz' is not a finite number"),
        (change("rate_hz", 10**400), "'rate_hz' is not a finite number"),
        (change("input_taps", ["a"]), "'input_taps' is not a finite number"),
        (change("input_taps", []), "where the names make it|not"),
        (change("L_p", 3), "'L_p' is not a matrix"),
        (change("L_p", {"shape": [1, 1], "rows": [[1.0]]}), "'L_p' is .* where the names make it"),
        (change("K", {"shape": [2], "rows": [[1.0]]}), "'K' is not a matrix"),
        (
            rows("step_matrix", lambda rows: rows[0].__setitem__(0, float("inf"))),
            "'step_matrix' is not a matrix of finite numbers",
        ),
        (rows("step_matrix", lambda rows: rows[0].__setitem__(0, "1")), "'step_matrix' is not a matrix of finite"),
        (rows("step_matrix", lambda rows: rows[0].pop()), "'step_matrix' is not a matrix"),
        (rows("initial_matrix", lambda rows: rows.pop()), "'initial_matrix' is not a matrix"),
        (
            change("nonlinearities", [{"expression": "open(v)", "arguments": ["v"]}]),
            r"'open\(v\)' calls something else",
        ),
        (change("nonlinearities", [{"expression": "sin(v)"}]), "an entry without arguments"),
        (change("nonlinearities", []), "where the names make it"),
    ],
)
def test_a_damaged_file_is_refused_in_one_line(
    gains: Gains, damage: Callable[[dict[str, Any]], None], message: str, tmp_path: Path
) -> None:
    path = tmp_path / "gains.json"
    write_gains(gains, path)
    document = json.loads(path.read_text())
    damage(document)
    path.write_text(json.dumps(document))
    with pytest.raises(ModelError, match=message) as caught:
        read_gains(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe", b"[" * 100_000, b"3", b"null", b"[]"])
def test_what_is_no_gains_file_is_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "gains.json").write_bytes(content)
    with pytest.raises(ModelError, match=r"gains.json: (not JSON|'format' is not 2)"):
        read_gains(tmp_path / "gains.json")


def test_a_missing_or_a_huge_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="cannot be read: No such file"):
        read_gains(tmp_path / "gains.json")
    with (tmp_path / "gains.json").open("wb") as file:
        file.truncate(1 << 30)
    with pytest.raises(ModelError, match="larger than 16 MiB"):
        read_gains(tmp_path / "gains.json")
