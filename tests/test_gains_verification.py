"""A gains file is verified from itself alone, and one that was tampered with is refused."""

import json
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gains_samples import DESIGNS, random_plant
from hypothesis import given, settings
from hypothesis import strategies as st

import fauio
from adapters.errors import InfeasibleError, ModelError
from gains.plants.model_file import builtin_model
from gains.synthesis.certificate import certify
from gains.synthesis.compilation import compile_gains
from gains.synthesis.convex import design_convex
from gains.synthesis.gains_file import write_gains
from gains.synthesis.verification import _is_positive, verify_gains


@pytest.fixture(scope="module")
def document(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    plant = builtin_model("arm-disturbed")
    design = design_convex(plant, 100.0)
    path = tmp_path_factory.mktemp("gains") / "arm.json"
    write_gains(compile_gains(plant, design, certify(plant, design)), path)
    return dict(json.loads(path.read_text()))


@pytest.mark.parametrize(
    "options",
    [
        ["arm-disturbed", "--rate", "10", "--integrator-order", "2"],
        ["arm-disturbed", "--rate", "100", "--vertex-free"],
        ["arm-disturbed", "--rate", "100", "--continuous"],
        ["arm-disturbed", "--rate", "10", "--noise-once"],
        pytest.param(["arm-disturbed", "--rate", "100", "--continuous", "--noise-once"], marks=pytest.mark.long),
        ["arm", "--rate", "100", "--method", "theorem1"],
    ],
)
def test_a_certificate_is_verified_from_its_file_alone(
    options: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "gains.json"
    assert fauio.main(["design", *options, "-o", str(path)]) == 0
    capsys.readouterr()
    assert fauio.main(["check", str(path)]) == 0
    output = capsys.readouterr().out
    assert output.startswith(f"{path}: certificate verified in exact arithmetic: sqrt(mu) = ")
    assert output.count("\n") == 1
    assert fauio.main(["check", str(path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["status"] == "verified"


@settings(deadline=None, derandomize=True, max_examples=DESIGNS)
@given(st.integers(0, 10_000), st.sampled_from([(1, 0), (0, 1), (1, 1), (2, 1)]), st.integers(0, 2))
def test_designs_of_random_plants_are_verified(
    tmp_path_factory: pytest.TempPathFactory, seed: int, faults: tuple[int, int], nonlinear: int
) -> None:
    plant = random_plant(seed, *faults, nonlinear=nonlinear, decades=2.0)
    try:
        design = design_convex(plant)
    except InfeasibleError:
        return
    path = tmp_path_factory.mktemp("gains") / "random.json"
    write_gains(compile_gains(plant, design, certify(plant, design)), path)
    verified = verify_gains(path)
    assert verified.sqrt_mu == design.sqrt_mu
    assert verified.floor is not None
    assert verified.floor <= verified.sqrt_mu


def scaled(*keys: str, factor: float) -> Callable[[dict[str, Any]], None]:
    """Return what scales the first number below a key that is not zero."""

    def change(document: dict[str, Any]) -> None:
        found: Any = document
        for key in keys[:-1]:
            found = found[key]
        if isinstance(found[keys[-1]], float):
            found[keys[-1]] *= factor
            return
        found = found[keys[-1]]["rows"] if isinstance(found[keys[-1]], dict) else found[keys[-1]]
        row = next(row for row in found if any(row))
        k = next(k for k, x in enumerate(row) if x)
        row[k] *= factor

    return change


def steeper(document: dict[str, Any]) -> None:
    document["report"]["certificate"]["plant"]["nonlinearity"][0]["slope"]["v"] = [-3.0, 3.0]


@pytest.mark.parametrize(
    ("tamper", "message"),
    [
        (scaled("K", factor=1.01), "does not hold for its gains"),
        (scaled("L_p", factor=1.01), "does not hold for its gains"),
        (scaled("L1", factor=1.01), "does not hold for its gains"),
        (scaled("step_matrix", factor=1.0001), "'step_matrix' runs but is not what is proven"),
        (scaled("initial_matrix", factor=1.0001), "'initial_matrix' runs but is not what is proven"),
        (scaled("report", "certificate", "mu", factor=0.9), "does not hold"),
        (scaled("report", "certificate", "P", factor=1.2), "does not hold"),
        (scaled("report", "certificate", "floor", factor=1.2), "it reports a floor of"),
        (scaled("report", "sqrt_mu", factor=0.9), "reports sqrt"),
        (steeper, "it reports a floor of"),
        (lambda document: document["report"]["certificate"].update(noise_once=True), "it reports a floor of"),
        (lambda document: document["report"]["certificate"].pop("P"), "has no 'P'"),
        (lambda document: document["report"]["certificate"].pop("plant"), "has no 'plant'"),
        (lambda document: document["report"]["certificate"].pop("mu"), "is damaged"),
    ],
)
def test_a_tampered_file_is_refused_in_one_line(
    document: dict[str, Any],
    tamper: Callable[[dict[str, Any]], None],
    message: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    changed = json.loads(json.dumps(document))
    tamper(changed)
    path = tmp_path / "gains.json"
    path.write_text(json.dumps(changed))
    assert fauio.main(["check", str(path)]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith(f"fauio: {path}: ")
    assert message in captured.err
    assert captured.err.count("\n") == 1


def test_a_file_of_the_first_layout_is_read_and_said_to_hold_no_proof(document: dict[str, Any], tmp_path: Path) -> None:
    old = json.loads(json.dumps(document)) | {"format": 1}
    for key in ("L_q", "F_q"):
        del old[key]
    old["report"]["certificate"] = {"holds": True, "margin": 1e-6}
    path = tmp_path / "gains.json"
    path.write_text(json.dumps(old))
    with pytest.raises(ModelError, match="has no 'P', so it cannot be verified from the file alone"):
        verify_gains(path)


@settings(deadline=None, derandomize=True)
@given(st.integers(0, 10_000), st.integers(1, 8), st.sampled_from([1e-3, 1e-9]))
def test_a_witness_is_given_for_positive_matrices_alone(seed: int, size: int, least: float) -> None:
    rng = np.random.default_rng(seed)
    root = np.array([[Fraction(x) for x in row] for row in rng.normal(size=(size, size)).tolist()], dtype=object)
    semidefinite = root[:, :-1] @ root[:, :-1].T if size > 1 else np.array([[Fraction(0)]], dtype=object)
    units = np.array([Fraction(10) ** int(k) for k in rng.integers(-6, 6, size)], dtype=object)
    identity = np.array([[Fraction(int(i == j)) for j in range(size)] for i in range(size)], dtype=object)
    positive = (semidefinite + Fraction(least) * identity) * units * units[:, None]
    negative = (semidefinite - Fraction(1e-40) * identity) * units * units[:, None]
    assert _is_positive(positive)
    assert not _is_positive(negative)
