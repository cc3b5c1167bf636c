"""Errors are lines for a terminal, whatever names they quote, and stay so on their way between processes."""

import pickle
from pathlib import Path

import pytest

import fauio
from adapters.errors import ModelError, ProfileError, TelemetryError

HOSTILE = "\x1b[31mred\r\n'axis' is\u202e fine\x00"
SHOWN = "?[31mred??'axis' is? fine?"


@pytest.mark.parametrize("kind", [TelemetryError, ModelError, ProfileError])
def test_what_an_error_quotes_adds_no_line_and_no_control_character(kind: type[ValueError]) -> None:
    error = kind(f"a.toml: '{HOSTILE}' is unknown")
    again = pickle.loads(pickle.dumps(error))  # noqa: S301 - our own
    assert str(error) == str(again) == f"a.toml: '{SHOWN}' is unknown"


def test_several_mistakes_are_a_line_each() -> None:
    error = ProfileError("one", "two\nthree")
    assert str(error) == str(pickle.loads(pickle.dumps(error))) == "one\ntwo?three"  # noqa: S301 - our own


def test_a_model_whose_names_hold_line_ends_is_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = (Path(__file__).parent.parent / "gains" / "models" / "arm.toml").read_text()
    path = tmp_path / "arm.toml"
    path.write_text(model.replace('"link_angle"', '"link\\nangle"'))
    assert fauio.main(["design", str(path)]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert "link?angle" in line


def test_a_file_whose_name_would_command_the_terminal_is_named_without_that(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "\x1b[2J.tlog.xz"
    convert = ["convert", str(path), "-o", str(tmp_path / "out.mcap")]
    root = Path(__file__).parent.parent
    replay = ["replay", str(root / "replay" / "data" / "quad"), str(path)]
    assert fauio.main(convert) == fauio.main(replay) == 2
    path.write_bytes((root / "tests" / "data" / "copter_5s.tlog.xz").read_bytes())
    assert fauio.main(replay) == 0
    path.write_bytes(path.read_bytes()[:1000])
    fauio.main(replay)
    said = capsys.readouterr()
    assert "?[2J.tlog" in said.out
    assert "?[2J.tlog" in said.err
    assert "\x1b" not in said.out + said.err
