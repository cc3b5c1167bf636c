"""A disk that takes no more: each command says which file it could not write, and what was there before stays."""

from __future__ import annotations

import resource
from collections.abc import Sequence
from pathlib import Path

import pytest

import fauio

QUAD = Path(__file__).parent.parent / "replay" / "data" / "quad"
LOG = Path(__file__).parent / "data" / "copter_5s.tlog.xz"
FAULTY = LOG.with_name("copter_motor3_090.tlog.xz")
REPLAY = ("replay", str(QUAD), str(LOG))
COMMANDS = [
    (*REPLAY, "-o", "out.mcap"),
    ("replay", str(QUAD), str(FAULTY), "--alarms", "out.jsonl"),
    (*REPLAY, "--table", "out.csv"),
    ("simulate", "arm", "--duration", "1", "-o", "out.mcap"),
]
MORE = [
    (*REPLAY, "--report", "out.html"),
    (*REPLAY, "--rrd", "out.rrd"),
    ("convert", str(LOG), "-o", "out.mcap"),
    ("design", "arm-disturbed", "-o", "out.gains.json"),
]


LIMIT = (10, resource.getrlimit(resource.RLIMIT_FSIZE)[1])


def full_disk_status(command: Sequence[str]) -> int:
    """Run a command where no file may grow beyond ten bytes; return its exit status."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, LIMIT)
    try:
        return fauio.main(list(command))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize(
    "command",
    [*COMMANDS, *(pytest.param(command, marks=pytest.mark.long) for command in MORE)],
    ids=lambda command: f"{command[0]} {command[-2]} {command[-1]}",
)
def test_the_file_that_could_not_be_written_is_named(
    command: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert full_disk_status(command) == 2
    assert f"{command[-1]}: " in capsys.readouterr().err.splitlines()[-1]


def test_gains_that_were_there_stay_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    gains = tmp_path / "arm.gains.json"
    gains.write_text("as designed on monday")
    monkeypatch.chdir(tmp_path)
    assert full_disk_status(["design", "arm", "--rate", "100", "-o", gains.name]) == 2
    assert gains.read_text() == "as designed on monday"
    assert list(tmp_path.iterdir()) == [gains]
