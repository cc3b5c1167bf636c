"""The most likely mistakes: each row of the page about them is typed, and says what the page says."""

from __future__ import annotations

import re
import shlex
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest
from desks import lay_out, lay_out_mistakes
from loopback import free_port

import fauio

PAGE = Path(__file__).parent.parent / "docs" / "how-to" / "mistakes.md"
ROW = re.compile(r"^\| `(?P<given>[^`]+)` \| `(?P<says>[^`]+)` \|", re.MULTILINE)


class Row(NamedTuple):
    """A row of the page: what was given, what has to be said."""

    given: str
    says: str


def rows() -> Iterator[Row]:
    for match in ROW.finditer(PAGE.read_text()):
        yield Row(match["given"], match["says"])


COMMANDS = [row for row in rows() if row.given.startswith("fauio ")]
MODELS = [row for row in rows() if "arm.toml:" in row.says]
CONFIGS = [row for row in rows() if row not in COMMANDS and row not in MODELS]


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("desk")
    lay_out(folder)
    lay_out_mistakes(folder)
    return folder


@pytest.fixture(autouse=True)
def at_the_desk(desk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(desk)


@pytest.fixture
def taken() -> Iterator[str]:
    """Yield a UDP port that somebody else listens on."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        yield str(other.getsockname()[1])


def refusal(capsys: pytest.CaptureFixture[str], command: str) -> tuple[int, str]:
    """Return status and the line on stderr of a command; nothing may stand on stdout."""
    capsys.readouterr()
    try:
        status = fauio.main(shlex.split(command)[1:])
    except SystemExit as stop:
        status = int(stop.code or 0)
    said = capsys.readouterr()
    assert said.out == ""
    lines = [line for line in said.err.splitlines() if not line.startswith("{")]
    assert len(lines) == 1, said.err
    return status, lines[0]


def assert_says(line: str, wanted: str) -> None:
    pattern = ".*".join(re.escape(part) for part in wanted.split("..."))
    assert re.fullmatch(pattern, line), f"{line}\nis not\n{wanted}"


def test_the_page_lists_at_least_twenty_mistakes_of_commands_and_some_of_each_file() -> None:
    assert len(COMMANDS) >= 20
    assert len(MODELS) >= 5
    assert len(CONFIGS) >= 5


@pytest.mark.parametrize("row", COMMANDS, ids=lambda row: row.given)
def test_a_wrong_command_says_in_one_line_what_to_do(row: Row, taken: str, capsys: pytest.CaptureFixture[str]) -> None:
    port = str(free_port())
    given, says = (text.replace("14550", taken).replace("7447", port) for text in row)
    if given.startswith("fauio run quad"):
        given += f" --listen tcp/127.0.0.1:{port}"
    elif given.startswith("fauio alarms"):
        given += f" --connect tcp/127.0.0.1:{port}"
    status, line = refusal(capsys, given)
    assert_says(line, says)
    assert status == 2


@pytest.mark.parametrize("row", CONFIGS, ids=lambda row: row.given)
def test_a_wrong_line_of_the_configuration_is_named(row: Row, desk: Path, capsys: pytest.CaptureFixture[str]) -> None:
    right = ['profile = "quad/"', 'mavlink = "udpin:127.0.0.1:14551"', f'listen = "tcp/127.0.0.1:{free_port()}"']
    key = row.given.partition(" ")[0]
    (desk / "fauio.toml").write_text(
        "\n".join([row.given, *(line for line in right if not line.startswith(key + " "))])
    )
    status, line = refusal(capsys, "fauio run --config fauio.toml")
    assert_says(line, row.says)
    assert status == 2


@pytest.mark.parametrize("row", MODELS, ids=lambda row: row.given)
def test_a_wrong_line_of_a_model_is_named(row: Row, desk: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = desk / "arm.toml"
    right = path.read_text()
    lines = right.splitlines()
    start = row.given.partition("=")[0]
    lines[next(k for k, line in enumerate(lines) if line.startswith(start))] = row.given
    path.write_text("\n".join(lines))
    try:
        status, line = refusal(capsys, "fauio design arm.toml --rate 100")
    finally:
        path.write_text(right)
    assert_says(line, row.says)
    assert status == 2
