"""``fauio alarms`` as a user runs it: a process of its own against a monitor's real session."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import IO

import pytest
from loopback import Endpoint, event

from monitor.bus.alarm_text import alarm_line
from monitor.bus.payload import to_json
from monitor.bus.publisher import Publisher
from monitor.event import AlarmEvent, event_from_json

ROOT = Path(__file__).parent.parent


def alarms(endpoint: Endpoint, *options: str) -> subprocess.Popen[str]:
    command = [
        sys.executable,
        "-W",
        "error",
        "-m",
        "fauio",
        "alarms",
        "--connect",
        endpoint.address,
        *options,
    ]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT)


def lines(stream: IO[str] | None, count: int) -> list[str]:
    """Return the next lines; the test's own time-out ends it if they do not come."""
    assert stream is not None
    return [stream.readline().rstrip("\n") for _ in range(count)]


def json_line(one: AlarmEvent) -> str:
    return to_json(one.to_json()).decode()


def test_current_state_and_changes_are_json_lines_in_a_pipe_and_ctrl_c_ends_with_130(endpoint: Endpoint) -> None:
    publisher = Publisher(endpoint.session, "copter-1", [])
    publisher.event(event(1))
    with alarms(endpoint) as process:
        assert lines(process.stdout, 1) == [json_line(event(1))]
        publisher.event(event(2, state="cleared"))
        assert lines(process.stdout, 1) == [json_line(event(2, state="cleared"))]
        assert lines(process.stderr, 1) == ["fauio: monitor of copter-1 is there"]
        process.send_signal(signal.SIGINT)
        assert process.communicate() == ("", "")
    assert process.returncode == 130


def test_a_vehicle_that_is_not_watched_as_it_should_be_is_told_beside_the_lines(endpoint: Endpoint) -> None:
    publisher = Publisher(endpoint.session, "copter-1", [])
    done = threading.Event()
    status: dict[str, object] = {"state": "degraded", "reasons": ["motors watches nothing: no HIGHRES_IMU for 3 s"]}

    def say() -> None:
        while not done.wait(0.05):
            publisher.status(status)

    speaker = threading.Thread(target=say)
    speaker.start()
    try:
        with alarms(endpoint) as process:
            assert lines(process.stderr, 2) == [
                "fauio: monitor of copter-1 is there",
                "fauio: copter-1 is degraded: motors watches nothing: no HIGHRES_IMU for 3 s",
            ]
            # the figures alone are no news
            status["reasons"] = ["motors watches nothing: no HIGHRES_IMU for 4 s"]
            time.sleep(0.5)
            status.update(state="monitoring", reasons=[])
            assert lines(process.stderr, 1) == ["fauio: copter-1 is monitoring"]
            process.send_signal(signal.SIGINT)
            out, _ = process.communicate()
            assert (process.returncode, out) == (130, "")
    finally:
        done.set()
        speaker.join()


def test_json_is_one_object_per_line_with_the_history_first(endpoint: Endpoint) -> None:
    publisher = Publisher(endpoint.session, "copter-1", [])
    events = [event(1), event(2, "motor 2"), event(3, state="cleared"), event(4, message="ünïcode")]
    for one in events[:3]:
        publisher.event(one)
    with alarms(endpoint, "--json", "--history", "--vehicle", "copter-1") as process:
        found = lines(process.stdout, 3)
        publisher.event(events[3])
        found += lines(process.stdout, 1)
        process.send_signal(signal.SIGINT)
        assert process.wait() == 130
    assert [event_from_json(json.loads(line)) for line in found] == events


def test_it_says_when_no_monitor_is_there_and_keeps_waiting(endpoint: Endpoint) -> None:
    endpoint.session.close()
    with alarms(endpoint) as process:
        assert lines(process.stderr, 1) == [
            f"fauio: no monitor at {endpoint.address} yet; waiting (start one with 'fauio run')"
        ]
        with Endpoint(endpoint.address).session as late:
            publisher = Publisher(late, "copter-1", [])
            assert lines(process.stderr, 1) == ["fauio: monitor of copter-1 is there"]
            publisher.event(event(1))
            assert lines(process.stdout, 1) == [json_line(event(1))]
            publisher.close()
            assert lines(process.stderr, 1) == ["fauio: monitor of copter-1 is gone; waiting for it"]
        process.send_signal(signal.SIGINT)
        assert process.wait() == 130


def test_it_ends_by_itself_after_the_time_asked(endpoint: Endpoint) -> None:
    with alarms(endpoint, "--for", "0.2") as process:
        assert process.communicate() == ("", "")
    assert process.returncode == 0


def test_a_reader_that_goes_away_ends_it_quietly(endpoint: Endpoint) -> None:
    publisher = Publisher(endpoint.session, "copter-1", [])
    publisher.event(event(1))
    with alarms(endpoint) as process:
        assert lines(process.stdout, 1) == [json_line(event(1))]
        assert lines(process.stderr, 1) == ["fauio: monitor of copter-1 is there"]
        assert process.stdout is not None
        process.stdout.close()
        publisher.event(event(2))
        assert process.wait() == 0
        assert lines(process.stderr, 1) == [""]


@pytest.mark.parametrize(
    ("options", "part"),
    [
        (("--vehicle", "a/b"), "cannot be part of a Zenoh key"),
        (("--prefix", ""), "cannot be part of a Zenoh key"),
        (("--connect", "nonsense"), "nonsense"),
        (("--for", "soon"), "'soon' is not a finite number"),
    ],
)
def test_a_mistake_is_named_and_ends_with_2(endpoint: Endpoint, options: tuple[str, ...], part: str) -> None:
    with alarms(endpoint, *options) as process:
        out, err = process.communicate()
    assert process.returncode == 2
    assert out == ""
    assert part in err.splitlines()[-1]
    assert "Traceback" not in err


@pytest.mark.parametrize(
    ("changes", "parts"),
    [
        ({"relative": -0.05}, ["-5 % of the command", "motors/motor1", "raised"]),
        ({"estimate": None, "kind": "stale"}, ["motor1 delivers less"]),
        ({"time_ns": 10**30}, [f"{10**30} ns"]),
        ({"time_ns": 1_795_251_917_265_689_600}, ["2026-11-21T09:05:17.265Z"]),
    ],
)
def test_a_line_says_when_what_and_how_large(changes: dict[str, object], parts: list[str]) -> None:
    line = alarm_line(event(1, **changes))
    assert all(part in line for part in parts)


def test_a_line_holds_no_control_characters() -> None:
    line = alarm_line(event(1, message="\x1b[2J\nmotor1\x07"))
    assert line.isprintable()
    assert line.endswith("?[2J?motor1?")
