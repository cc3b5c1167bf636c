"""A custom vehicle from its model with free parameters to alarms: the reference arm with unknown stiffness and gain."""

import json
import math
import re
import tomllib
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fauio
from adapters.batch import Batch, messages
from adapters.errors import ModelError, TelemetryError
from adapters.logs.mcap_log import MessageLogWriter
from adapters.logs.recordings import packed
from adapters.simulation.arm import SCENARIOS, ArmFault, ArmRun, ArmScenario, simulate_arm
from adapters.simulation.arm_source import arm_messages
from gains.plants.model_file import read_model
from monitor.display import display_unit
from monitor.estimation.isolation_rule import BankRule
from monitor.fitting.fitted import FitRequest
from monitor.profile import UNEXPLAINED, read_profile
from monitor.vehicles.custom.fit import _alarms, custom_messages, fit_custom
from replay.fit import fit_profile
from replay.player import play

MODEL = Path(__file__).parent / "data" / "arm_free.toml"
TRUTH = {"stiffness": 48.6, "ratio": 19.5 / 48.6, "gain": 21.6}


@cache
def excited(phase: float) -> ArmRun:
    """Simulate the disturbed arm under a known torque of three frequencies; nobody may change the run."""

    def torque(t: float) -> float:
        return (
            0.25 * math.sin(1.3 * t + phase)
            + 0.2 * math.sin(4.1 * t + 1.0 + phase)
            + 0.2 * math.sin(9.0 * t + 3 * phase)
        )

    run = simulate_arm(ArmScenario((ArmFault("f_a", 0.0, math.inf, torque),)), 25.0, 100.0)
    return replace(run, u=run.f_a, f_a=0.0 * run.f_a)


def log(run: ArmRun) -> Callable[[], Iterable[Batch]]:
    return lambda: packed(arm_messages(run, 10**18))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Fit a profile on two healthy recordings with the command a user types."""
    work = tmp_path_factory.mktemp("custom")
    logs = [work / "monday.mcap", work / "tuesday.mcap"]
    for path, phase in zip(logs, (0.0, 2.0), strict=True):
        with MessageLogWriter(path) as writer:
            for batch in log(excited(phase))():
                for message in messages(batch):
                    writer.write(message)
    command = ["fit", "--vehicle", "custom", "--model", str(MODEL), *map(str, logs), "-o", str(work / "arm")]
    assert fauio.main(command) == 0
    return work / "arm"


@pytest.fixture(scope="module")
def arm(folder: Path) -> dict[str, Any]:
    report: dict[str, Any] = json.loads((folder / "fit.json").read_text())["observers"]["arm"]
    return report


@pytest.mark.long
def test_the_arms_parameters_are_found_within_a_few_standard_errors(arm: dict[str, Any]) -> None:
    for name, found in arm["parameters"].items():
        assert abs(found["value"] - TRUTH[name]) < 3.0 * found["standard_error"]
        assert found["standard_error"] < 0.02 * found["value"]
    assert arm["delay_s"] == 0.0


@pytest.mark.long
def test_the_arms_disturbance_and_noise_are_told_apart(folder: Path, arm: dict[str, Any]) -> None:
    plant = read_model(folder / "arm.model.toml")
    scales = {w.name: w.scale for w in (*plant.disturbances, *plant.noises)}
    assert scales == {**arm["disturbances"], **arm["noises"]}
    assert scales["link_force"] == pytest.approx(0.2 / math.sqrt(2.0), rel=0.25)
    assert scales["encoder_noise"] == pytest.approx(0.1 / math.sqrt(2.0), rel=0.1)
    assert scales["noise_link_sum"] < 0.01


@pytest.mark.long
def test_the_fitted_profile_detects_the_papers_faults_and_nothing_before(folder: Path) -> None:
    run = simulate_arm(SCENARIOS["case2"], 37.0, 100.0, "tracking")
    events = play(read_profile(folder), arm_messages(run, 10**18)).events
    found = [(event.channel, event.state, event.vehicle_time_ms / 1000) for event in events if event.state != "updated"]
    assert [(channel, state) for channel, state, _ in found] == [
        ("motor", "raised"),
        ("motor", "cleared"),
        ("encoder", "raised"),
        ("encoder", "cleared"),
    ]
    assert [time for *_, time in found] == pytest.approx([10.15, 20.7, 30.15, 35.8], abs=0.5)


@pytest.mark.long
def test_the_folder_holds_what_the_fit_is_worth(folder: Path, arm: dict[str, Any]) -> None:
    assert arm["validation"]["explained"]["simulation explains"]["link_sum"] > 0.99
    text = (folder / "fit.txt").read_text()
    assert "stiffness  48." in text
    assert "motor alarm from" in text
    assert "link_force 0.1" in text
    assert (folder / "fit.png").read_bytes().startswith(b"\x89PNG")
    profile = read_profile(folder)
    assert profile.vehicle == "custom"
    assert not profile.gate.require_armed


@pytest.mark.long
def test_what_will_be_detected_stands_beside_the_alarms(folder: Path, arm: dict[str, Any]) -> None:
    alarms = tomllib.loads((folder / "profile.toml").read_text())["observers"]["arm"]["alarms"]
    assert set(arm["capability"]) == set(alarms) == {"motor", "encoder"}
    for channel, one in arm["capability"].items():
        within, size = [(within, size) for within, size in one["smallest"] if size is not None][-1]
        factor, unit = display_unit(one["unit"])
        said = f"{100 * size:g} %" if one["loss"] else f"{factor * size:.3g} {unit}"
        assert alarms[channel]["sees"].endswith(f"{said} within {within:g} s")


@pytest.mark.long
def test_faults_that_cannot_be_estimated_together_get_a_bank(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # what a profile will detect is measured in other tests
    monkeypatch.setattr("replay.fit._measured", lambda fitted, *_: fitted)
    path, folder = tmp_path / "arm.toml", tmp_path / "profile"
    sensors = "".join(
        f'[[fault]]\nname = "{name}_sensor"\nkind = "sensor"\ninto = "{name}"\n\n'
        for name in ("encoder_rate", "link_sum")
    )
    known = re.sub(
        r"^(\w+) = \{ start.*", lambda found: f"{found[1]} = {TRUTH[found[1]]}", MODEL.read_text(), flags=re.M
    )
    path.write_text(known.replace("[[disturbance]]", sensors + "[[disturbance]]"))
    (fitted,) = fit_profile("custom", [log(excited(0.0)), log(excited(2.0))], folder, "arm", path).observers
    assert isinstance(fitted.isolation, BankRule)
    (observer,) = read_profile(folder).observers
    assert len(observer.gains) == len(fitted.isolation.hypotheses) == 4
    assert {rule.channel for rule in observer.alarms} == {channel.name for channel in observer.faults} | {UNEXPLAINED}
    run = simulate_arm(SCENARIOS["case2"], 37.0, 100.0, "tracking")
    events = play(read_profile(folder), arm_messages(run, 10**18)).events
    raised = [(event.channel, event.vehicle_time_ms / 1000) for event in events if event.state == "raised"]
    assert all(time > 10.0 for _, time in raised)
    assert next(time for channel, time in raised if channel == "motor") < 10.5
    assert [channel for channel, time in raised if time > 25.0] == ["encoder"]
    quiet = [np.zeros((5000, len(observer.faults) + 1))]
    critical = {found.rule.channel: found.rule.critical for found in _alarms(fitted, quiet, {"motor"})}
    assert critical["encoder"] < 0.1
    assert critical["motor"] == 1.0  # the error that matters to it


def test_a_custom_vehicle_needs_its_model_and_no_other_takes_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording, out = tmp_path / "empty.mcap", str(tmp_path / "profile")
    with MessageLogWriter(recording):
        pass
    assert fauio.main(["fit", "--vehicle", "custom", str(recording), "-o", out]) == 2
    assert "needs --model" in capsys.readouterr().err
    assert fauio.main(["fit", "--vehicle", "multirotor", "--model", str(MODEL), str(recording), "-o", out]) == 2
    assert "takes no --model" in capsys.readouterr().err


@pytest.mark.long
def test_recordings_that_move_nothing_are_refused_with_what_to_record(tmp_path: Path) -> None:
    idle = simulate_arm(SCENARIOS["healthy"], 20.0, 100.0)
    with pytest.raises(ModelError, match=r"'parameters\.gain' .*record manoeuvres that move torque") as caught:
        fit_profile("custom", [log(idle)], tmp_path / "arm", "arm", MODEL)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "arm").exists()


@pytest.mark.parametrize(
    ("old", "new", "error", "said"),
    [
        ("link_sum = { message", "sum = { message", ModelError, "'channels.sum' is no input or output"),
        ('name = "arm" } }\nencoder_rate', 'name = "leg" } }\nencoder_rate', TelemetryError, "recording 1 holds no"),
        ("require_armed = false", "require_arms = false", ValueError, "'phase.require_arms'"),
    ],
)
def test_mistakes_in_the_mapping_are_named(
    tmp_path: Path, old: str, new: str, error: type[ValueError], said: str
) -> None:
    path = tmp_path / "arm.toml"
    path.write_text(MODEL.read_text().replace(old, new))
    run = simulate_arm(SCENARIOS["healthy"], 1.0, 100.0)
    with pytest.raises(error, match=said):
        fit_custom(FitRequest("arm", [log(run)], model=path))


def test_a_recording_need_only_yield_the_models_messages() -> None:
    assert custom_messages(MODEL) >= {"DEBUG_FLOAT_ARRAY", "HEARTBEAT"}
