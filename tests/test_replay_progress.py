"""Progress: a bar with the time left on a terminal, a line now and then in a pipe, and every item in either."""

from __future__ import annotations

from io import StringIO
from pathlib import Path

import pytest

from adapters.logs.compressed import ON_BYTES, CompressedFile
from monitor.fitting.progress import recording_bytes, track


class Terminal(StringIO):
    """A stream that says it is a terminal."""

    def isatty(self) -> bool:
        return True


def make_terminal(monkeypatch: pytest.MonkeyPatch) -> Terminal:
    """Make stderr a terminal; from within a test, for what a fixture sets is set back by the capturing of output."""
    found = Terminal()
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.setattr("sys.stderr", found)
    return found


def test_nothing_is_said_in_a_pipe(monkeypatch: pytest.MonkeyPatch) -> None:
    pipe = StringIO()
    monkeypatch.setattr("sys.stderr", pipe)
    assert list(track(range(5000), "log", total_bytes=100)) == list(range(5000))
    assert pipe.getvalue() == ""


def test_a_line_now_and_then_says_in_a_pipe_how_far_a_long_command_is(monkeypatch: pytest.MonkeyPatch) -> None:
    pipe = StringIO()
    monkeypatch.setattr("sys.stderr", pipe)
    monkeypatch.setattr("monitor.fitting.progress._LINE_S", 0.0)
    assert len(list(track("abcd", "replaying", "logs", total=4))) == 4
    assert pipe.getvalue().splitlines()[1] == "fauio: replaying: 50 %, 2 logs after 0 s"


def test_the_share_of_the_file_that_was_read_is_shown_with_the_time_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    terminal = make_terminal(monkeypatch)
    path = tmp_path / "flight.tlog"
    path.write_bytes(bytes(1 << 20))
    pieces = track(CompressedFile(path), "[b]flight", total_bytes=recording_bytes(path), weigh=lambda _: 3000)
    seen = [next(pieces) for _ in range(9)]
    shown = terminal.getvalue()
    seen += list(pieces)
    assert b"".join(seen) == path.read_bytes()
    assert "[b]flight" in terminal.getvalue()
    assert "100%" in terminal.getvalue()
    assert "left:" in terminal.getvalue()
    assert "48,000 messages" in terminal.getvalue()
    assert "100%" not in shown
    assert ON_BYTES.get() is None


def test_without_a_size_items_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = make_terminal(monkeypatch)
    assert list(track("abc", "replayed", "flights")) == ["a", "b", "c"]
    assert "3 flights" in terminal.getvalue()
    assert "%" not in terminal.getvalue()


def test_a_consumer_that_stops_leaves_nobody_listening(monkeypatch: pytest.MonkeyPatch) -> None:
    make_terminal(monkeypatch)
    items = track(range(10), "log", total_bytes=5)
    next(items)
    items.close()
    assert ON_BYTES.get() is None


def test_the_size_of_a_recording_is_that_of_its_files(tmp_path: Path) -> None:
    for number in range(3):
        (tmp_path / f"{number}.mcap").write_bytes(b"12345")
    assert recording_bytes(tmp_path) == 15
    assert recording_bytes(tmp_path / "0.mcap") == 5
    assert recording_bytes(tmp_path / "none") == 0
