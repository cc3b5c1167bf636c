"""The command line as a stranger meets it: overview, help, examples, pipes, interrupts."""

from __future__ import annotations

import argparse
import json
import shlex
import signal
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from daemons import ENVIRONMENT, FAUIO, free_ports
from desks import lay_out
from loopback import until

import fauio

# What runs for ever, needs a monitor or takes long is started by tests of its own.
NOT_RUN = ("record", "run", "watch", "alarms", "console", "demo", "fit", "detectability", "notify")
AS_JSON = (
    "fauio replay quad/ flights/copter_5s.tlog.xz --json",
    "fauio convert flights/copter_5s.tlog.xz -o short.mcap --json",
    "fauio info flights/copter_5s.tlog.xz --json",
    "fauio info quad/ --json",
    "fauio info arm.toml --json",
    "fauio inject flights/copter_5s.tlog.xz --channel baro --kind bias --size 8 --start 2 -o baro.mcap --json",
    "fauio design arm --rate 100 --json",
    "fauio check arm --json",
    "fauio simulate arm -o arm.mcap --duration 1 --json",
    "fauio schema",
)


def parsers(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    """Yield a parser and those of all its commands."""
    yield parser
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                yield from parsers(command)


def examples(parser: argparse.ArgumentParser) -> list[str]:
    lines = (parser.epilog or "").splitlines()
    return [line.removeprefix(fauio.EXAMPLE) for line in lines if line.startswith(fauio.EXAMPLE)]


PARSERS = list(parsers(fauio.build_parser()))
COMMANDS = PARSERS[1:]
EXAMPLES = [example for parser in COMMANDS for example in examples(parser)]


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("desk")
    lay_out(folder)
    (folder / "recordings").mkdir()
    return folder


@pytest.fixture(autouse=True)
def plain_terminal(desk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(desk)
    monkeypatch.setenv("COLUMNS", "80")


def test_each_command_says_its_purpose_its_options_and_an_example() -> None:
    for parser in COMMANDS:
        assert parser.description, parser.prog
        assert examples(parser), parser.prog
        for action in parser._actions:
            assert action.help or isinstance(action, argparse._SubParsersAction), (parser.prog, action.option_strings)


def test_numbers_say_their_unit_or_default() -> None:
    for action in (action for parser in COMMANDS for action in parser._actions if action.type in (float, int)):
        assert action.metavar or action.choices, action
        signs = ("second", "(", "per ", "largest", "of theorem", "rate")
        assert any(sign in (action.help or "") for sign in signs), action


def test_help_fits_a_terminal_of_80_columns_without_colours() -> None:
    for parser in PARSERS:
        text = parser.format_help()
        assert "\x1b" not in text
        for line in text.splitlines():
            assert len(line) <= 80 or line.startswith(fauio.EXAMPLE), line


def test_each_example_is_understood() -> None:
    parser = fauio.build_parser()
    for example in EXAMPLES:
        assert callable(parser.parse_args(shlex.split(example)[1:]).handler)
        assert len(example) <= 110


@pytest.mark.parametrize("example", [one for one in EXAMPLES if shlex.split(one)[1] not in NOT_RUN])
def test_each_example_on_files_runs_as_typed(example: str, capsys: pytest.CaptureFixture[str]) -> None:
    words = shlex.split(example)[1:]
    # others run with a bus, or start several processes (test_replay_many_logs.py)
    if "--zenoh" in words or "--jobs" in words:
        return
    status = fauio.main(words)
    said = capsys.readouterr()
    assert status == 0 or (words[0] == "doctor" and status == 2), said.err
    assert said.out or words[0] == "simulate"


@pytest.mark.parametrize("command", AS_JSON)
def test_json_is_one_object_and_nothing_else_on_stdout(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert fauio.main(shlex.split(command)[1:]) == 0
    said = capsys.readouterr()
    assert isinstance(json.loads(said.out), dict)
    assert "\r" not in said.err


@pytest.mark.parametrize("words", [[], ["help"], ["--help"]], ids=" ".join)
def test_the_overview_shows_first_steps_and_each_command_once(
    words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stop:
        fauio.main(words)
    assert stop.value.code == 0
    text = capsys.readouterr().out
    assert text.index("first steps:") < text.index("your vehicle:")
    names = {parser.prog.split()[1] for parser in COMMANDS}
    assert names == {name for group in fauio._GROUPS.values() for name in group}
    for name in names:
        assert text.count(f"\n  {name} ") == 1


def test_help_with_a_command_is_that_commands_help(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        fauio.main(["help", "alarms", "ack"])
    assert capsys.readouterr().out.startswith("usage: fauio alarms ack")


@pytest.mark.parametrize("command", ["fauio schema", "fauio --help", "fauio info flights/copter_5s.tlog.xz"])
def test_a_closed_pipe_ends_a_command_without_a_word(command: str, desk: Path) -> None:
    process = subprocess.Popen(
        [*FAUIO, *shlex.split(command)[1:]], stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=ENVIRONMENT, cwd=desk
    )
    assert process.stdout is not None
    process.stdout.close()
    _, said = process.communicate()
    assert (process.returncode, said) == (0, b"")


def test_an_interrupt_ends_a_command_with_130_without_a_traceback(desk: Path) -> None:
    process = subprocess.Popen(
        [*FAUIO, "replay", "quad/", "flight.tlog", "--speed", "4", "--verbose"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=ENVIRONMENT | {"PYTHONUNBUFFERED": "1"},
        cwd=desk,
        text=True,
    )
    assert process.stdout is not None
    assert "motor1" in process.stdout.readline()
    process.send_signal(signal.SIGINT)
    _, said = process.communicate()
    assert (process.returncode, said) == (130, "")


def test_a_monitor_that_hears_nothing_names_the_link(desk: Path) -> None:
    (port,), (udp,) = free_ports(1), free_ports(1, socket.SOCK_DGRAM)
    link = f"udpin:127.0.0.1:{udp}"
    command = [*FAUIO, "run", "quad/", "--mavlink", link, "--listen", f"tcp/127.0.0.1:{port}"]
    with (desk / "said").open("w") as said:
        process = subprocess.Popen(command, stderr=said, env=ENVIRONMENT, cwd=desk)
    try:
        until(lambda: "no telemetry yet" in (desk / "said").read_text())
    finally:
        process.send_signal(signal.SIGINT)
        status = process.wait(20)
    lines = [json.loads(line) for line in (desk / "said").read_text().splitlines()]
    assert [line["link"] for line in lines if line["event"] == "no telemetry yet"] == [link]
    assert status == 130
