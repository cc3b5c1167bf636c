"""``fauio design`` prints what the contract says and returns its exit statuses."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from gains_samples import integrator_with_drift

import fauio
from gains.plants.model_file import builtin_model, model_hash, write_model
from gains.synthesis.gains_file import read_gains


def test_design_prints_the_json_of_the_contract(capsys: pytest.CaptureFixture[str]) -> None:
    assert fauio.main(["design", "arm-disturbed", "--rate", "100", "--json"]) == 0
    output = capsys.readouterr().out
    found = json.loads(output)
    assert output.count("\n") == 1
    assert (found["model"], found["method"], found["domain"], found["rate_hz"]) == (
        "arm-disturbed",
        "convex",
        "discrete",
        100.0,
    )
    assert found["status"] == "optimal"
    assert found["norm"] <= found["sqrt_mu"] <= 0.1425
    assert found["gain_max_abs"] < 30.0
    assert found["poles_max_abs"] < 1.0
    assert found["certificate"]["holds"] is True
    assert found["certificate"]["margin"] > 0.0
    assert 0.0 < found["solve_s"] <= found["total_s"]


def test_design_prints_a_report_for_people_and_writes_the_gains(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "arm.json"
    assert fauio.main(["design", "arm", "--rate", "50", "-o", str(out)]) == 0
    output = capsys.readouterr().out
    assert output.startswith("arm: convex design at 50 Hz\n")
    assert "certificate         holds with margin" in output
    assert "H2 norm at most     " in output
    assert str(out) in output
    assert read_gains(out).model_hash == model_hash(builtin_model("arm"))


def test_another_fault_rate_gives_other_gains_for_the_same_model_file(tmp_path: Path) -> None:
    arguments = ["design", "arm-disturbed", "--rate", "100"]
    assert fauio.main([*arguments, "-o", str(tmp_path / "slow.json")]) == 0
    assert fauio.main([*arguments, "--fault-rate", "50", "-o", str(tmp_path / "fast.json")]) == 0
    slow, fast = read_gains(tmp_path / "slow.json"), read_gains(tmp_path / "fast.json")
    assert fast.report["sqrt_mu"] > slow.report["sqrt_mu"]
    assert not np.allclose(fast.L_i, slow.L_i, rtol=0.1)
    assert fast.model_hash == slow.model_hash
    assert fast.report["fault_rate"] == {"motor": 50.0}


def test_integrators_of_order_2_within_a_pole_radius_are_designed_and_read_back(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["design", "arm-disturbed", "--rate", "100", "--integrator-order", "2", "--pole-radius", "0.97"]
    assert fauio.main([*arguments, "--json", "-o", str(tmp_path / "ramp.json")]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["integrator_order"] == 2
    assert found["poles_max_abs"] <= 0.97
    assert found["floor"] <= found["norm"] <= found["sqrt_mu"]
    gains = read_gains(tmp_path / "ramp.json")
    assert gains.L_i.shape == (2, 3)
    assert gains.report["integrator_order"] == 2


def test_a_share_of_h2_lowers_its_bound_and_raises_the_other(capsys: pytest.CaptureFixture[str]) -> None:
    found = []
    for share in ("0", "0.5"):
        assert fauio.main(["design", "arm-disturbed", "--rate", "100", "--h2", share, "--json"]) == 0
        found.append(json.loads(capsys.readouterr().out))
    assert found[1]["h2"] < found[0]["h2"]
    assert found[1]["sqrt_mu"] > found[0]["sqrt_mu"]


def test_a_model_without_an_observer_is_reported_with_exit_status_3(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_model(integrator_with_drift(), tmp_path / "drift.toml")
    assert fauio.main(["design", str(tmp_path / "drift.toml"), "--json"]) == 3
    captured = capsys.readouterr()
    found = json.loads(captured.out)
    assert found["status"] == "infeasible"
    assert found["sqrt_mu"] is None
    assert found["certificate"] == {"holds": False, "margin": None, "proof": None, "slopes": 0}
    assert captured.err.startswith("fauio: drift: detectability of (L1 A_z, Cb) fails: 'gps_offset'")
    assert captured.err.count("\n") == 1


@pytest.mark.long
def test_a_failure_has_the_keys_of_a_success(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    drift = replace(
        integrator_with_drift(), domain="continuous", rate_hz=None, A=np.array([[0.0, 1.0], [0.0, -1.0]]), taps=(1.0,)
    )
    write_model(drift, tmp_path / "drift.toml")
    keys: dict[tuple[str, str], dict[bool, tuple[set[str], set[str]]]] = {}
    for model in ("arm-disturbed", str(tmp_path / "drift.toml")):
        assert fauio.main(["design", model, "--rate", "100", "--method", "all", "--json"]) == 0
        for line in capsys.readouterr().out.splitlines():
            found = json.loads(line)
            outcome = keys.setdefault((found["method"], found["domain"]), {})
            outcome[found["status"] == "optimal"] = set(found), set(found["certificate"])
    both = [outcome for outcome in keys.values() if len(outcome) == 2]
    assert len(both) >= 4
    assert all(outcome[True] == outcome[False] for outcome in both)


def test_all_slopes_can_be_proven_at_once(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["design", "arm-disturbed", "--rate", "100", "--vertex-free"]
    assert fauio.main([*arguments, "--json"]) == 0
    certificate = json.loads(capsys.readouterr().out)["certificate"]
    assert (certificate["proof"], certificate["slopes"]) == ("multipliers", 3)
    assert fauio.main(arguments) == 0
    assert ", for all slopes at once\n" in capsys.readouterr().out


@pytest.mark.long
def test_gains_are_kept_small_by_a_bound_and_a_price(capsys: pytest.CaptureFixture[str]) -> None:
    found = []
    for options in (["--gain-bound", "8"], ["--gain-weight", "1"], []):
        assert fauio.main(["design", "arm-disturbed", "--rate", "100", "--json", *options]) == 0
        found.append(json.loads(capsys.readouterr().out))
    assert found[0]["gain_max_abs"] <= 8.0
    assert found[1]["gain_max_abs"] < 0.5 * found[2]["gain_max_abs"]
    assert [one["gain_weight"] for one in found] == [1e-3, 1.0, 1e-3]
    assert fauio.main(["design", "arm-disturbed", "--rate", "100", "--gain-bound", "0.01"]) == 3
    assert "no gains within 0.01 were found; the smallest that were are" in capsys.readouterr().err


def test_gains_that_may_take_turns_share_the_matrix_of_a_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second = str(tmp_path / "first.json"), str(tmp_path / "second.json")
    arguments = ["design", "arm-disturbed", "--rate", "100"]
    assert fauio.main([*arguments, "-o", first]) == 0
    assert fauio.main([*arguments, "--gain-weight", "1", "--common-p", first, "-o", second]) == 0
    one, other = (read_gains(path).report["certificate"] for path in (first, second))
    assert one["P"] == other["P"]
    assert one["holds"]
    assert other["holds"]
    capsys.readouterr()
    for wrong, message in (
        (["arm-disturbed", "--rate", "50"], f"{first}: its rate is not that of arm-disturbed"),
        ([*arguments[1:], "--integrator-order", "2"], "arm-disturbed: the Lyapunov matrix is (6, 6), not (7, 7)"),
    ):
        assert fauio.main(["design", *wrong, "--common-p", first]) == 2
        assert capsys.readouterr().err.startswith(f"fauio: {message}")


def test_a_file_without_a_matrix_cannot_lend_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "old.json"
    assert fauio.main(["design", "arm", "--rate", "100", "-o", str(path)]) == 0
    document = json.loads(path.read_text())
    del document["report"]["certificate"]["P"]
    path.write_text(json.dumps(document))
    assert read_gains(path).K.shape == (5, 3)
    assert fauio.main(["design", "arm", "--rate", "100", "--common-p", str(path)]) == 2
    assert f"{path}: its certificate has no 'P'" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["check", "design"])
def test_a_model_with_free_parameters_is_sent_to_the_fit(
    command: str, data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = data / "arm_free.toml"
    assert fauio.main([command, str(path)]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"fauio: {path}: has free parameters (stiffness, ratio, gain)")
    assert f"fauio fit --vehicle custom --model {path} LOG ... -o PROFILE" in said
    assert said.count("\n") == 1


@pytest.mark.parametrize("options", [[], ["--method", "ekf"]])
def test_a_continuous_model_without_a_rate_is_designed_for_100_hz_and_that_is_said(
    options: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "gains.json"
    assert fauio.main(["design", "arm", *options, "--json", "-o", str(out)]) == 0
    captured = capsys.readouterr()
    assert captured.err == (
        "fauio: arm: designed for 100 samples per second; --rate HZ sets another rate, --continuous needs none\n"
    )
    assert json.loads(captured.out)["rate_hz"] == 100.0
    assert read_gains(out).rate_hz == 100.0
    assert fauio.main(["design", "arm", *options, "--json", "--rate", "100"]) == 0
    said = capsys.readouterr()
    assert said.err == ""
    assert json.loads(said.out).keys() == json.loads(captured.out).keys()


@pytest.mark.parametrize("options", [["--continuous"], ["--method", "theorem1"], ["--method", "gao2016"]])
def test_a_continuous_design_without_a_rate_stays_continuous(
    options: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    fauio.main(["design", "arm", *options, "--json"])
    captured = capsys.readouterr()
    assert "samples per second" not in captured.err
    assert json.loads(captured.out)["rate_hz"] is None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["missing.toml"], "fauio: missing.toml: no such file"),
        (["leg"], "fauio: leg: neither a file nor a built-in model"),
        (["arm", "--rate", "-5"], "fauio: arm: a rate of -5.0 Hz is not positive"),
        (["arm", "--rate", "10", "--pole-radius", "2"], "fauio: arm: a pole radius of 2.0"),
        (["arm", "--rate", "10", "--fault-rate", "0"], "fauio: arm: a fault rate of 0.0 per second"),
        (
            ["arm", "--rate", "10", "-o", "/nowhere/gains.json"],
            "fauio: /nowhere/gains.json: No such file or directory; does its folder exist?",
        ),
    ],
)
def test_bad_input_is_one_line_and_exit_status_2(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert fauio.main(["design", *arguments]) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith(message)
    assert captured.err.count("\n") == 1
    assert captured.out == ""


def test_gains_for_one_hypothesis_estimate_its_faults_and_know_the_whole_model(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "gains.json"
    assert fauio.main(["design", "arm", "--rate", "100", "--faults", "encoder", "-o", str(out)]) == 0
    gains = read_gains(out)
    assert gains.faults == ("encoder",)
    assert gains.model_hash == model_hash(builtin_model("arm"))
    assert fauio.main(["design", "arm", "--rate", "100", "--faults", "wheel"]) == 2
    assert "--faults names 'wheel'; the model has motor, encoder" in capsys.readouterr().err
