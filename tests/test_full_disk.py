"""A disk that takes no more: each command says which file it could not write, and what was there before stays."""

from __future__ import annotations

import resource
import subprocess
from pathlib import Path

import pytest
from daemons import ENVIRONMENT, FAUIO

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


def on_a_full_disk(command: tuple[str, ...], folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a command in a folder whose files may not grow beyond a few bytes."""
    return subprocess.run(
        [*FAUIO, *command],
        cwd=folder,
        env={**ENVIRONMENT, "PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (10, 10)),
    )


@pytest.mark.parametrize(
    "command",
    [*COMMANDS, *(pytest.param(command, marks=pytest.mark.long) for command in MORE)],
    ids=lambda command: f"{command[0]} {command[-2]} {command[-1]}",
)
def test_the_file_that_could_not_be_written_is_named(command: tuple[str, ...], tmp_path: Path) -> None:
    done = on_a_full_disk(command, tmp_path)
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert f"{command[-1]}: " in done.stderr.splitlines()[-1]


def test_gains_that_were_there_stay_whole(tmp_path: Path) -> None:
    gains = tmp_path / "arm.gains.json"
    gains.write_text("as designed on monday")
    assert on_a_full_disk(("design", "arm-disturbed", "-o", gains.name), tmp_path).returncode == 2
    assert gains.read_text() == "as designed on monday"
    assert list(tmp_path.iterdir()) == [gains]
