"""Log lines for people and for machines, limited in number, harmless to the terminal and to the monitor."""

import io
import json
import logging
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from loopback import event, until

from monitor.service import log as module
from monitor.service.log import ServiceLog

ROOT = Path(__file__).parent.parent
SECOND = 1_000_000_000


class Clock:
    def __init__(self) -> None:
        self.now = 0

    def __call__(self) -> int:
        return self.now


@contextmanager
def logging_to(stream: Any, as_json: bool = True, clock: Clock | None = None) -> Iterator[ServiceLog]:
    log = ServiceLog(as_json, stream, clock or Clock())
    try:
        yield log
    finally:
        log.close()


def parsed(stream: io.StringIO) -> list[dict[str, Any]]:
    return [json.loads(line) for line in stream.getvalue().splitlines()]


def test_a_machine_reads_time_level_name_and_fields() -> None:
    stream = io.StringIO()
    with logging_to(stream) as log:
        log.say("monitoring", vehicle="copter-1", rate=float("nan"), path=Path("a.mcap"), several=(1, "x"))
        log.say("link lost", level="warning", level_of="x", time_ns=5)
        log.event(event(1, estimate=None))
    first, second, third = parsed(stream)
    assert first.pop("time_ns") > 1_700_000_000 * SECOND
    assert first == {
        "level": "info",
        "event": "monitoring",
        "vehicle": "copter-1",
        "rate": None,
        "path": "a.mcap",
        "several": [1, "x"],
    }
    assert (second["level"], second["event"]) == ("warning", "link lost")
    assert second["time_ns"] > 1_700_000_000 * SECOND
    assert third["alarm"] == event(1, estimate=None).to_json()


def test_people_read_a_line_with_a_time_of_day() -> None:
    stream = io.StringIO()
    with logging_to(stream, as_json=False) as log:
        log.say("monitoring", vehicle="copter-1", rate=50)
        log.event(event(12_345))
        log.say("disk full", level="error", path="x")
    lines = stream.getvalue().splitlines()
    assert all(line[2] == line[5] == ":" for line in lines)
    assert [line[8:] for line in lines] == [
        " monitoring  vehicle copter-1  rate 50",
        " alarm  12.345 s  copter-1  motors/motor1 raised (warning): motor1 delivers less",
        " ERROR disk full  path x",
    ]


def test_ten_lines_of_a_name_come_at_once_then_one_a_second_with_the_number_left_out() -> None:
    stream, clock = io.StringIO(), Clock()
    with logging_to(stream, clock=clock) as log:
        for number in range(15):
            log.say("noise", number=number)
        log.say("other")
        clock.now = SECOND
        log.say("noise", number=15)
        log.say("noise", number=16)
        clock.now = 100 * SECOND
        for number in range(12):
            log.say("noise", number=100 + number)
        assert log.statistics() == module.ServiceLogStatistics(written=22, suppressed=8, dropped=0)
    lines = parsed(stream)
    numbers = [line.get("number") for line in lines]
    assert numbers == [*range(10), None, 15, *range(100, 110)]
    assert {line.get("number"): line["suppressed"] for line in lines if "suppressed" in line} == {15: 5, 100: 1}


def test_one_alarm_that_chatters_silences_no_other() -> None:
    stream = io.StringIO()
    with logging_to(stream) as log:
        for seq in range(50):
            log.event(event(seq, "motor1"))
        log.event(event(50, "motor2"))
    assert [line["alarm"]["channel"] for line in parsed(stream)] == ["motor1"] * 10 + ["motor2"]


def test_names_without_end_take_memory_with_one() -> None:
    with logging_to(io.StringIO()) as log:
        for number in range(2 * module.MAX_NAMES):
            log.say(f"name {number}")
        assert len(log._handler._limit._buckets) == module.MAX_NAMES


@given(st.text(), st.booleans())
def test_nothing_from_a_network_drives_the_terminal(text: str, as_json: bool) -> None:
    stream = io.StringIO()
    with logging_to(stream, as_json) as log:
        log.say(text, field=text, nested={text: [text]})
        log.event(event(1, text, message=f"\x1b[2J\x07\x9b31m\x7f\r\n{text}"))
    written = stream.getvalue()
    assert written.count("\n") == 2
    assert all(line.isprintable() for line in written.split("\n"))


def test_a_text_without_end_is_cut() -> None:
    stream = io.StringIO()
    with logging_to(stream) as log:
        log.say("long", text="x" * 100_000)
        log.event(event(1, message="x" * 100_000))
    assert all(len(line) < 2000 for line in stream.getvalue().splitlines())


class Unprintable:
    def __str__(self) -> str:
        raise RuntimeError("no")


def test_no_field_and_no_stream_makes_the_log_raise() -> None:
    closed = io.StringIO()
    closed.close()
    with logging_to(closed) as log:
        log.say("closed")
        assert log.statistics().dropped == 1
    with logging_to(io.StringIO()) as log:
        log.say("field", value=Unprintable())
        assert log.statistics().dropped == 1
    with Path("/dev/full").open("w") as full, logging_to(full) as log:
        log.say("no room")
        assert log.statistics().dropped == 1
        os.dup2(os.open(os.devnull, os.O_WRONLY), full.fileno())


def test_a_missing_stderr_is_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", None)
    with logging_to(None) as log:
        log.say("unheard")
        assert log.statistics().dropped == 1


def test_a_pipe_that_nobody_reads_does_not_stop_the_monitor() -> None:
    reading, writing = os.pipe()
    clock = Clock()
    with os.fdopen(writing, "w") as stream, logging_to(stream, clock=clock) as log:
        while log.statistics().dropped < 3:
            clock.now += SECOND
            log.say("line", text="x" * 300)
        written = log.statistics().written
        with os.fdopen(reading) as reader:
            for _ in range(written):
                json.loads(reader.readline())
            log.say("again")
            assert json.loads(reader.readline())["event"] == "again"


def test_a_pipe_whose_reader_is_gone_does_not_stop_the_monitor() -> None:
    code = """
import sys
from monitor.service.log import ServiceLog
log = ServiceLog(as_json=True)
sys.stdin.read()
log.say("unheard")
assert log.statistics().dropped == 1
print("alive")
"""
    with subprocess.Popen(
        [sys.executable, "-c", code],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        assert process.stderr is not None
        process.stderr.close()
        process.stdin.close()
        assert process.stdout.read() == "alive\n"
        until(lambda: process.poll() is not None)


def test_what_libraries_log_comes_out_in_the_same_form() -> None:
    stream, people = io.StringIO(), io.StringIO()
    with logging_to(stream), logging_to(people, as_json=False):
        try:
            raise OSError("no route")
        except OSError:
            logging.getLogger("asyncio").exception("task %s failed", 7)
    (line,) = parsed(stream)
    line.pop("time_ns")
    assert line == {
        "level": "error",
        "event": "log",
        "logger": "asyncio",
        "message": "task 7 failed",
        "error": "OSError: no route",
    }
    assert people.getvalue()[8:] == " ERROR log  logger asyncio  message task 7 failed  error OSError: no route\n"
    logging.getLogger("asyncio").warning("after the log was closed")
    assert len(stream.getvalue().splitlines()) == 1


def test_a_library_that_logs_wrongly_is_counted() -> None:
    record = logging.LogRecord("library", logging.WARNING, "", 0, "wrong %d", ("arguments",), None)
    with logging_to(io.StringIO()) as log:
        log._handler.handle(record)
        assert log.statistics().dropped == 1
