"""The baselines behind the same command: what each is worth, and why some have no solution."""

import json
from pathlib import Path

import pytest

import fauio


def designed(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, list[dict[str, object]]]:
    status = fauio.main(["design", *arguments, "--json"])
    return status, [json.loads(line) for line in capsys.readouterr().out.splitlines()]


def test_a_reconstruction_says_that_it_is_one_and_what_it_proves(capsys: pytest.CaptureFixture[str]) -> None:
    status, (found,) = designed(capsys, "arm-disturbed", "--method", "gao2022")
    assert status == 0
    assert found["certificate"]["holds"]
    assert 0.1362 <= found["norm"] <= found["sqrt_mu"] < 0.15
    assert "reconstruction" in found["notes"][0]


def test_chen_and_saif_have_no_solution_on_the_arm(capsys: pytest.CaptureFixture[str]) -> None:
    status, (found,) = designed(capsys, "arm", "--method", "chen2006")
    assert (status, found["status"]) == (3, "infeasible")
    assert "Lipschitz constant" in found["reason"]


def test_a_filter_runs_and_proves_nothing(capsys: pytest.CaptureFixture[str], tmp_path: object) -> None:
    status, (found,) = designed(capsys, "arm-disturbed", "--method", "ekf", "--rate", "100")
    assert status == 0
    assert found["sqrt_mu"] is None
    assert not found["certificate"]["holds"]
    assert found["poles_max_abs"] < 1.0


@pytest.mark.long
def test_one_command_compares_all_methods_on_one_model(capsys: pytest.CaptureFixture[str]) -> None:
    status, found = designed(capsys, "arm-disturbed", "--method", "all", "--rate", "100")
    assert status == 0
    methods = [(line["method"], line["domain"]) for line in found]
    assert methods[:2] == [("convex", "discrete"), ("convex", "continuous")]
    assert {method for method, _ in methods} == {
        *("convex", "theorem1", "theorem2", "gao2022", "gao2016", "chen2006", "zhang2008", "ekf")
    }
    continuous = {line["method"]: line for line in found if line["domain"] == "continuous"}
    certified = {name: line["sqrt_mu"] for name, line in continuous.items() if line["certificate"]["holds"]}
    assert min(certified, key=lambda name: certified[name]) == "convex"
    for line in continuous.values():
        assert line["norm"] is None or line["method"] in ("chen2006",) or line["norm"] >= 0.1362


@pytest.mark.long
def test_the_comparison_reads_as_a_table(capsys: pytest.CaptureFixture[str]) -> None:
    assert fauio.main(["design", "arm", "--method", "all"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["method", "sqrt(mu)", "norm", "floor", "status"]
    assert any(line.startswith("chen2006") and "Lipschitz" in line for line in lines)


def test_what_was_published_before_is_imported_by_its_commands_alone() -> None:
    root = Path(__file__).parent.parent
    packages = (path for name in ("adapters", "gains", "monitor", "replay") for path in (root / name).rglob("*.py"))
    importers = [path for path in packages if "gains.published" in path.read_text()]
    outside = [str(path.relative_to(root)) for path in importers if path.parent.name != "published"]
    assert outside == ["gains/commands.py"]
