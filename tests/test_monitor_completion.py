"""Completion in real shells: commands, options, choices, and files by what a command takes."""

import argparse
import os
import pty
import re
import select
import shlex
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from fauio import build_parser
from monitor.console.completion import SHELLS, completion_script

FILES = ("monday.tlog", "tuesday.ulg.xz", "00000012.BIN", "monthly.md", "arm.toml", "arm.md", "fast.gains.json")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Make a folder as users have it: a profile, recordings, a model, other files."""
    (tmp_path / "work" / "quad").mkdir(parents=True)
    for name in FILES:
        (tmp_path / "work" / name).touch()
    return tmp_path / "work"


def script(shell: str, folder: Path) -> Path:
    path = folder.parent / f"_fauio.{shell}"
    path.write_text(completion_script(build_parser(), shell))
    return path


def bash(folder: Path, line: str) -> set[str]:
    """Return what bash offers for the last word of a line: its own function for ``fauio``, as TAB calls it."""
    words = line.split(" ")
    code = f"""
        source {shlex.quote(str(script("bash", folder)))}
        COMP_WORDS=({shlex.join(words)}); COMP_CWORD={len(words) - 1}
        completer=$(complete -p fauio); completer=${{completer##*-F }}
        ${{completer%% *}} fauio {shlex.quote(words[-1])} {shlex.quote(words[-2])}
        printf '%s\\n' "${{COMPREPLY[@]}}"
    """
    done = subprocess.run(["bash", "--norc", "-c", code], cwd=folder, capture_output=True, text=True, check=True)
    # compopt is for an interactive line alone
    assert {line for line in done.stderr.splitlines() if "compopt" not in line} == set()
    return set(done.stdout.split())


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("fauio rep", {"replay"}),
        ("fauio fit --vehicle ", {"multirotor", "plane", "rover", "inertial", "custom"}),
        ("fauio replay quad --fail", {"--fail-on-alarm"}),
        ("fauio alarms ", {"ack", "shelve", "unshelve", "reset"}),
        ("fauio simulate arm --scenario case", {"case1", "case2", "case3"}),
        ("fauio replay ", {"quad"}),
        ("fauio replay quad ", {"quad", "monday.tlog", "tuesday.ulg.xz", "00000012.BIN"}),
        ("fauio replay quad monday.tlog --dark tue", {"tuesday.ulg.xz"}),
        ("fauio run --config ", {"quad", "arm.toml"}),
        ("fauio design arm.toml --common-p ", {"quad", "fast.gains.json"}),
        ("fauio info ", {"quad", *FILES}),
    ],
)
def test_bash_completes_what_a_command_takes(folder: Path, line: str, offered: set[str]) -> None:
    assert bash(folder, line) == offered


def test_every_command_is_completed_in_every_shell(folder: Path) -> None:
    below = next(one for one in build_parser()._actions if isinstance(one, argparse._SubParsersAction))
    commands = set(below.choices)
    assert {"fit", "replay", "run", "completion"} <= commands
    for shell in SHELLS:
        assert commands <= set(re.findall(r"\w+", script(shell, folder).read_text()))


@pytest.mark.system
def test_fish_completes_commands_choices_and_recordings(folder: Path) -> None:
    def offered(line: str) -> set[str]:
        code = f"source {shlex.quote(str(script('fish', folder)))}; complete -C {shlex.quote(line)}"
        environment = os.environ | {"HOME": str(folder.parent)}
        done = subprocess.run(["fish", "-N", "-c", code], cwd=folder, env=environment, capture_output=True, check=True)
        return {line.split("\t")[0] for line in done.stdout.decode().splitlines()}

    assert offered("fauio rep") == {"replay"}
    assert offered("fauio fit --vehicle ro") == {"rover"}
    assert offered("fauio replay quad ") == {"quad/", "monday.tlog", "tuesday.ulg.xz", "00000012.BIN"}


@pytest.mark.system
@pytest.mark.parametrize(
    ("typed", "shown"),
    [
        ("fauio rep", "fauio replay"),
        ("fauio fit --vehicle ro", "fauio fit --vehicle rover"),
        ("fauio replay quad mon", "fauio replay quad monday.tlog"),
        ("fauio design ar", "fauio design arm.toml"),
    ],
)
def test_zsh_completes_a_line_typed_at_a_terminal(folder: Path, typed: str, shown: str) -> None:
    script("zsh", folder).rename(folder.parent / "_fauio")
    setup = f"fpath+=({shlex.quote(str(folder.parent))})\nautoload -Uz compinit; compinit -u -D"
    complete_in_zsh(folder, setup, typed, shown)


@pytest.mark.system
def test_zsh_completes_in_a_shell_that_has_evaluated_the_script(folder: Path) -> None:
    setup = f'autoload -Uz compinit; compinit -u -D\neval "$(cat {shlex.quote(str(script("zsh", folder)))})"'
    complete_in_zsh(folder, setup, "fauio rep", "fauio replay")


def complete_in_zsh(folder: Path, setup: str, typed: str, shown: str) -> None:
    (folder.parent / ".zshrc").write_text(f"{setup}\nPS1='ready> '\n")
    with terminal(["zsh", "-i"], folder, {"ZDOTDIR": str(folder.parent), "TERM": "dumb"}) as keyboard:
        assert "ready> " in read_until(keyboard, "ready> ")
        os.write(keyboard, f"{typed}\t".encode())
        assert shown in read_until(keyboard, shown)


@contextmanager
def terminal(command: list[str], folder: Path, environment: dict[str, str]) -> Iterator[int]:
    """Run an interactive program, yield the other end of its terminal."""
    ours, theirs = pty.openpty()
    process = subprocess.Popen(
        command,
        cwd=folder,
        env=os.environ | environment,
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
        start_new_session=True,
    )
    os.close(theirs)
    try:
        yield ours
    finally:
        process.kill()
        process.wait()
        os.close(ours)


def read_until(terminal: int, text: str) -> str:
    """Return what a terminal shows, as soon as it shows the text; all it shows within 20 s where it does not."""
    shown, until = "", time.monotonic() + 20
    while text not in shown and (left := until - time.monotonic()) > 0:
        if select.select([terminal], [], [], left)[0]:
            shown += os.read(terminal, 4096).decode().replace("\a", "")
    return shown
