"""The library does what typed_api.py, the example of its use whose types `make lint` checks, and its page say."""

import doctest
import re
from pathlib import Path

import numpy as np
import pytest
import typed_api

import fauio
import replay.api
from gains.plants.model_file import load_model

ROOT = Path(__file__).parent.parent
QUAD = ROOT / "replay/data/quad"
FLIGHT = ROOT / "replay/data/copter_motor1.tlog.xz"


def test_a_recording_is_read_replayed_and_run_batch_by_batch() -> None:
    assert set(typed_api.rates_of(FLIGHT)) == {"ATTITUDE", "HIGHRES_IMU"}
    raised = [event.channel for event in typed_api.alarms_of(QUAD, FLIGHT) if event.state == "raised"]
    assert raised == ["motor1"]
    estimates, _ = next(typed_api.estimates_of(QUAD, FLIGHT, "motors"))
    assert estimates.shape[1] == 7 and np.isfinite(estimates).all()


def test_gains_are_designed_written_and_read(tmp_path: Path) -> None:
    assert typed_api.gains_of("arm", 100.0, tmp_path / "arm.gains.json").faults == ("motor", "encoder")
    plant = load_model("arm")
    assert [fault.rate for fault in typed_api.faster(plant, tmp_path / "arm.toml").faults] == [
        2.0 * fault.rate for fault in plant.faults
    ]


def test_waiting_for_an_alarm_of_nobody_ends() -> None:
    assert typed_api.listen("tcp/127.0.0.1:1", 0.1) is None


def test_each_name_of_the_library_is_there_and_says_what_it_is() -> None:
    for name in fauio.__all__:
        assert getattr(fauio, name).__doc__
    assert set(fauio.__all__) <= set(dir(fauio))
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        _ = fauio.nonsense


def test_the_page_names_all_of_it_and_its_examples_are_right(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = (ROOT / "docs/library.md").read_text()
    assert [name for name in fauio.__all__ if f"`{name}" not in page] == []
    monkeypatch.chdir(tmp_path)
    (tmp_path / "replay").symlink_to(ROOT / "replay")
    names: dict[str, object] = {}
    for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL):
        exec(compile(block, "docs/library.md", "exec"), names)  # noqa: S102 - our own page
    shown = re.findall(r"^# prints (.*)$", page, re.MULTILINE)
    assert capsys.readouterr().out.splitlines() == shown


def test_the_examples_of_docstrings_are_right(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    assert doctest.testmod(replay.api, extraglobs={"fauio": fauio}).failed == 0
