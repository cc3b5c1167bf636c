"""The library does what typed_api.py, the example of its use that mypy checks, expects of it."""

import subprocess
import sys
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
import typed_api

from gains.plants.model_file import load_model

ROOT = Path(__file__).parent.parent
QUAD = ROOT / "replay/data/quad"
FLIGHT = ROOT / "replay/data/copter_motor1.tlog.xz"


def test_a_recording_is_read_replayed_and_fed_message_by_message() -> None:
    assert set(typed_api.rates_of(FLIGHT)) == {"ATTITUDE", "HIGHRES_IMU"}
    raised = [event.channel for event in typed_api.alarms_of(QUAD, FLIGHT) if event.state == "raised"]
    assert raised == ["motor1"]
    times = [time_ns for time_ns, _ in islice(typed_api.estimates_of(QUAD, FLIGHT, "motors"), 100)]
    assert len(times) == 100
    assert sorted(times) == times


def test_gains_are_designed_written_and_run(tmp_path: Path) -> None:
    gains = typed_api.gains_of("arm", 100.0, tmp_path / "arm.gains.json")
    still = typed_api.step_by_step(gains, np.zeros((50, len(gains.inputs))), np.zeros((50, len(gains.outputs))))
    assert still == [0.0] * 50
    plant = load_model("arm")
    assert [fault.rate for fault in typed_api.faster(plant, tmp_path / "arm.toml").faults] == [
        2.0 * fault.rate for fault in plant.faults
    ]


def test_waiting_for_an_alarm_of_nobody_ends() -> None:
    assert typed_api.listen("tcp/127.0.0.1:1", 0.1) is None


@pytest.mark.long  # as `make lint` does
def test_its_use_is_fully_typed() -> None:
    command = [sys.executable, "-m", "mypy", "--config-file", "pyproject.toml", "tests/typed_api.py"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
