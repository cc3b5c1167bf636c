"""``fauio design`` in continuous time: the contract's JSON, gains that run, and one line for what does not fit."""

import json
from pathlib import Path

import pytest

import fauio
from adapters.simulation.arm import SCENARIOS, simulate_arm
from gains.plants.model_file import builtin_model, model_hash
from gains.synthesis.gains_file import read_gains
from monitor.estimation.affine import AffineObserver


def test_a_continuous_design_prints_the_json_of_the_contract(capsys: pytest.CaptureFixture[str]) -> None:
    assert fauio.main(["design", "arm-disturbed", "--continuous", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["model"], found["method"], found["domain"]) == ("arm-disturbed", "convex", "continuous")
    assert found["rate_hz"] is None
    assert found["status"] == "optimal"
    assert 0.1362 <= found["norm"] <= found["sqrt_mu"] <= 0.1453
    assert found["poles_max_re"] < 0.0
    assert "poles_max_abs" not in found
    assert found["certificate"]["holds"] is True
    assert found["gain_max_abs"] > 0.0
    assert 0.0 < found["solve_s"] <= found["total_s"]


@pytest.mark.parametrize(
    ("arguments", "least", "most"),
    [
        (["arm-disturbed", "--method", "theorem2", "--epsilon", "0.0112", "--delta", "5"], 0.63, 0.645),
        (["arm", "--method", "theorem1", "--beta", "100", "--epsilon", "0.1"], 0.0, 2.54e-4),
    ],
)
def test_the_theorems_are_continuous_designs(
    arguments: list[str], least: float, most: float, capsys: pytest.CaptureFixture[str]
) -> None:
    assert fauio.main(["design", *arguments, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["domain"] == "continuous"
    assert least <= found["sqrt_mu"] <= most
    assert found["norm"] <= found["sqrt_mu"]
    assert found["certificate"]["holds"] is True


def test_with_a_rate_the_gains_are_compiled_and_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "arm.json"
    assert fauio.main(["design", "arm-disturbed", "--continuous", "--rate", "50", "-o", str(out)]) == 0
    output = capsys.readouterr().out
    assert output.startswith("arm-disturbed: continuous convex design at 50 Hz\n")
    assert "slowest pole" in output
    gains = read_gains(out)
    assert gains.model_hash == model_hash(builtin_model("arm-disturbed"))
    assert gains.report["rate_hz"] == 50.0
    run = simulate_arm(SCENARIOS["case2"], 20.0, 50.0)
    found = AffineObserver([gains]).run(run.u, run.y)
    assert found.fault[-10, 0] == pytest.approx(2.0, abs=0.15)


def test_decay_rates_are_kept(capsys: pytest.CaptureFixture[str]) -> None:
    assert fauio.main(["design", "arm-disturbed", "--continuous", "--decay-rates", "0.5", "50", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert -50.0 <= found["poles_min_re"] <= found["poles_max_re"] <= -0.5


def test_a_theorem_without_a_solution_is_reported_with_exit_status_3(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["arm-disturbed", "--method", "theorem2", "--epsilon", "10", "--delta", "0.001"]
    assert fauio.main(["design", *arguments, "--json"]) == 3
    found = json.loads(capsys.readouterr().out)
    assert (found["domain"], found["status"], found["poles_max_re"]) == ("continuous", "infeasible", None)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--continuous", "-o", "gains.json"], "fauio: arm: gains that run need a rate in samples per second (--rate)"),
        (["--continuous", "--pole-radius", "0.9"], "fauio: arm: a pole radius belongs to a discrete design"),
        (["--continuous", "--rate", "-1"], "fauio: arm: a rate of -1.0 Hz is not positive"),
        (["--continuous", "--integrator-order", "2"], "fauio: arm: --integrator-order belongs to the discrete convex"),
        (["--method", "ekf", "--rate", "9", "--integrator-order", "2"], "fauio: arm: --integrator-order belongs to"),
        (["--continuous", "--h2", "0.5"], "fauio: arm: --h2 belongs to the discrete convex synthesis"),
        (["--continuous", "--beta", "3"], "fauio: arm: --beta belongs to theorem1 and theorem2"),
        (["--method", "theorem1", "--decay-rates", "1", "2"], "fauio: arm: --decay-rates belongs to the convex"),
        (["--rate", "9", "--decay-rates", "1", "2"], "fauio: arm: --decay-rates belongs to a continuous design"),
        (["--method", "theorem1", "--epsilon", "0"], "fauio: arm: epsilon is 0.0; it must be positive"),
    ],
)
def test_what_does_not_fit_is_one_line_and_exit_status_2(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert fauio.main(["design", "arm", *arguments]) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith(message)
    assert captured.err.count("\n") == 1
    assert captured.out == ""
