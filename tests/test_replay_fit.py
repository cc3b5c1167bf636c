"""A fit over a profile that exists: nothing that a person edited is lost."""

from __future__ import annotations

from pathlib import Path

import pytest

import fauio
from monitor.profile import read_profile
from replay.fit import replace_kept


@pytest.mark.long
def test_a_profile_that_is_fitted_again_is_kept_as_it_was_edited(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "rover"
    folder.mkdir()
    (folder / "profile.toml").write_text("# edited\n")
    log = data / "rover_healthy_manual.tlog.xz"
    assert fauio.main(["fit", "--vehicle", "rover", str(log), "-o", str(folder)]) == 0
    assert (folder / "profile.toml.before").read_text() == "# edited\n"
    said = f"{folder}/profile.toml is written anew; what stood there, edited or not, is {folder}/profile.toml.before"
    assert f"fauio: {said}\n" in capsys.readouterr().err
    assert read_profile(folder).name == "rover"


def test_a_profile_that_is_fitted_to_the_same_is_not_set_aside(tmp_path: Path) -> None:
    path = tmp_path / "profile.toml"
    assert replace_kept(path, "a = 1\n") is None
    assert replace_kept(path, "a = 1\n") is None
    assert replace_kept(path, "a = 2\n") == tmp_path / "profile.toml.before"
    assert [one.read_text() for one in sorted(tmp_path.iterdir())] == ["a = 2\n", "a = 1\n"]
