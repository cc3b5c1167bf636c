"""Every command of the README, as typed, on files of the names it uses."""

from __future__ import annotations

import json
import re
import shlex
import signal
import socket
import subprocess
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest
from daemons import ENVIRONMENT, FAUIO, Flight, free_ports
from desks import ROOT, lay_out
from loopback import until
from test_fauio import EXAMPLES

import fauio

README = (ROOT / "README.md").read_text()
FOR_EVER = ("record", "run", "alarms", "console", "watch")
SLOW = ("demo", "detectability", "fit", "review")
RUN_ELSEWHERE = {tuple(shlex.split(example)[1:]) for example in EXAMPLES}
"""Examples of the command line's own help, which tests/test_fauio.py runs in each run of the suite."""


def code_lines() -> Iterator[str]:
    """Yield the lines of all code blocks, fenced or indented, without prompts and comments."""
    fenced = re.findall(r"^```\w*\n(.*?)^```", README, re.MULTILINE | re.DOTALL)
    indented = re.findall(
        r"^(?: {4}|\t)(.*)$", re.sub(r"^```.*?^```", "", README, flags=re.DOTALL | re.MULTILINE), re.M
    )
    for line in (*"\n".join(fenced).replace("\\\n", " ").splitlines(), *indented):
        for command in re.sub(r"\s+#\s.*$", "", line.removeprefix("$ ")).split("&&"):
            yield command.strip()


def commands() -> list[list[str]]:
    """Return the arguments of each ``fauio`` command of the README."""
    typed = (shlex.split(line) for line in code_lines() if re.match(r"(\S*/)?fauio\s", line))
    return [words[1:] for words in typed]


TYPED = commands()
ENDING = [words for words in TYPED if words[0] not in FOR_EVER]


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("readme")
    lay_out(folder)
    return folder


def test_the_readme_shows_how_to_fit_replay_and_run() -> None:
    assert {"fit", "replay", "run", "alarms"} <= {words[0] for words in TYPED}


@pytest.mark.parametrize("words", TYPED, ids=" ".join)
def test_each_command_of_the_readme_is_understood(words: list[str]) -> None:
    assert callable(fauio.build_parser().parse_args(words).handler)


def test_each_make_target_of_the_readme_is_there() -> None:
    made = {line.split()[1] for line in code_lines() if line.startswith("make ")}
    targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    assert made <= targets


@pytest.mark.parametrize(
    "words",
    [
        pytest.param(
            words,
            marks=[pytest.mark.long, pytest.mark.timeout(900)]
            if words[0] in SLOW or tuple(words) in RUN_ELSEWHERE
            else [],
        )
        for words in ENDING
    ],
    ids=[" ".join(words) for words in ENDING],
)
def test_each_command_of_the_readme_does_what_it_says(words: list[str], desk: Path) -> None:
    done = subprocess.run([*FAUIO, *words], cwd=desk, env=ENVIRONMENT, capture_output=True, text=True, check=False)
    # a review that finds something says so by 1
    assert done.returncode == 0 or (words[0] == "review" and done.returncode == 1), done.stderr
    assert "Traceback" not in done.stderr
    assert done.stdout
    assert "\x1b" not in done.stdout + done.stderr
    written = [desk / word for option, word in pairwise(words) if option.startswith("-") and "." in word]
    for path in (path for path in written if path.suffix in (".mcap", ".html", ".png", ".csv", ".rrd", ".jsonl")):
        assert path.stat().st_size > 0


def test_the_recording_of_the_readme_is_made_from_what_the_vehicle_sends(desk: Path) -> None:
    record = next(words for words in TYPED if words[0] == "record")
    [port] = free_ports(1, socket.SOCK_DGRAM)
    record = [re.sub(r":14550$", f":{port}", word) for word in record]
    process = subprocess.Popen([*FAUIO, *record, "--seconds", "1"], cwd=desk, env=ENVIRONMENT, stdout=subprocess.PIPE)
    try:
        until((desk / record[-1]).exists)
        with Flight(desk / "flight.tlog", [port], 0.0):
            said, _ = process.communicate(timeout=20)
    finally:
        process.kill()
    assert process.returncode == 0
    assert said.decode().startswith(f"{record[-1]}: ")


def test_the_monitor_of_the_readme_raises_motor1_and_the_terminal_beside_it_says_so(desk: Path) -> None:
    run = next(words for words in TYPED if words[0] == "run" and "--mavlink" in words)
    alarms = next(words for words in TYPED if words[0] == "alarms")
    (zenoh_port,), (udp_port,) = free_ports(1), free_ports(1, socket.SOCK_DGRAM)
    endpoint = f"tcp/127.0.0.1:{zenoh_port}"
    run = [re.sub(r":14550$", f":{udp_port}", word) for word in run]
    said, heard = (desk / "said").open("w+"), (desk / "heard").open("w+")
    with said, heard:
        monitor = subprocess.Popen(
            [*FAUIO, *run, "--listen", endpoint], cwd=desk, env=ENVIRONMENT, stderr=said, stdout=said
        )
        terminal = subprocess.Popen(
            [*FAUIO, *alarms, "--connect", endpoint], cwd=desk, env=ENVIRONMENT, stderr=subprocess.STDOUT, stdout=heard
        )
        try:
            until(lambda: "monitor of quad is there" in (desk / "heard").read_text())
            with Flight(desk / "flight.tlog", [udp_port], 4.0):  # the motor fails 8.6 s into it
                until(lambda: '"raised"' in (desk / "heard").read_text())
        finally:
            for process in (terminal, monitor):
                process.send_signal(signal.SIGINT)
            ended = [process.wait(20) for process in (terminal, monitor)]
    events = [json.loads(line) for line in (desk / "heard").read_text().splitlines() if line.startswith("{")]
    assert events[0]["channel"] == "motor1"
    assert ended == [130, 130]
    assert "Traceback" not in (desk / "said").read_text() + (desk / "heard").read_text()
