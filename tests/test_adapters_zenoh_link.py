"""Telemetry over real Zenoh sessions on loopback, hostile payloads included."""

from __future__ import annotations

import json
import math
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh

from adapters.errors import TelemetryError
from adapters.message import Message
from adapters.zenoh_link import MAX_PAYLOAD_BYTES, ZenohLink
from adapters.zenoh_session import open_session

ROOT = Path(__file__).parent.parent


def free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


@pytest.fixture
def endpoint() -> str:
    return free_endpoint()


@pytest.fixture
def listener(endpoint: str) -> Iterator[zenoh.Session]:
    with open_session(listen=[endpoint]) as session:
        yield session


@pytest.fixture
def sender(listener: zenoh.Session, endpoint: str) -> Iterator[zenoh.Session]:
    with open_session(connect=[endpoint]) as session:
        yield session


def publisher(session: zenoh.Session, key: str) -> Any:
    made = session.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK)
    wait_for_match(made)
    return made


def wait_for_match(made: Any) -> None:
    while not made.matching_status.matching:
        time.sleep(0.005)


def collect(link: ZenohLink, count: int) -> list[Message]:
    messages: list[Message] = []
    while len(messages) < count:
        messages += link.receive(0.2)
    return messages


def test_json_objects_become_messages_named_by_their_key(listener: zenoh.Session, sender: zenoh.Session) -> None:
    with ZenohLink(listener, "arm/**") as link:
        out = publisher(sender, "arm/telemetry")
        before = time.time_ns()
        out.put(json.dumps({"time_ns": 5, "u": [1.0], "pose": {"x": 2}}))
        (message,) = collect(link, 1)
        assert (message.source, message.name) == ("zenoh", "arm/telemetry")
        assert message.fields == {"time_ns": 5, "u": [1.0], "pose": {"x": 2}}
        assert before <= message.received_ns <= time.time_ns()


def test_what_is_no_json_object_is_counted_and_passed_over(listener: zenoh.Session, sender: zenoh.Session) -> None:
    with ZenohLink(listener, "t") as link:
        out = publisher(sender, "t")
        for payload in (b"", b"\xff\xfe", b"[1]", b"3", b"{", b"[" * 100_000, b'{"a":' * 50_000, b'"text"'):
            out.put(payload)
        out.put(b'{"a": NaN, "b": 1e999}')
        (message,) = collect(link, 1)
        assert math.isnan(message.fields["a"])
        assert math.isinf(message.fields["b"])
        assert (link.statistics().malformed, link.statistics().messages) == (8, 1)


def test_oversized_payloads_are_counted_and_the_session_lives_on(
    listener: zenoh.Session, sender: zenoh.Session
) -> None:
    with ZenohLink(listener, "t") as link:
        out = publisher(sender, "t")
        out.put(b"x" * (MAX_PAYLOAD_BYTES + 1))
        out.put(b"x" * (10 << 20))
        out.put(b'{"a": 1}')
        assert collect(link, 1)[0].fields == {"a": 1}
        assert link.statistics().oversized == 2


def test_a_reader_that_stalls_loses_the_oldest_and_knows_how_many(
    listener: zenoh.Session, sender: zenoh.Session
) -> None:
    with ZenohLink(listener, "t") as link:
        out = publisher(sender, "t")
        for k in range(6_000):
            out.put(b'{"k": %d}' % k)
        while link.statistics().dropped < 6_000 - 4_096:
            time.sleep(0.005)
        messages = collect(link, 4_096)
        assert [message.fields["k"] for message in messages] == list(range(6_000 - 4_096, 6_000))


def test_a_flood_of_large_payloads_is_bounded_in_bytes(listener: zenoh.Session, sender: zenoh.Session) -> None:
    with ZenohLink(listener, "t") as link:
        out = publisher(sender, "t")
        payload = b'{"a": "' + b"x" * 900_000 + b'"}'
        for _ in range(40):
            out.put(payload)
        while link.statistics().dropped + len(link._queue) < 40:
            time.sleep(0.005)
        assert link._queued_bytes <= 1 << 24
        assert link.statistics().dropped > 20


def test_a_quiet_link_returns_nothing_when_the_time_is_over(listener: zenoh.Session) -> None:
    with ZenohLink(listener, "t") as link:
        assert link.receive(0.0) == []
        assert link.receive(0.02) == []


def test_a_wrong_key_expression_is_reported(listener: zenoh.Session) -> None:
    with pytest.raises(TelemetryError, match="'a//b' is not a Zenoh key expression"):
        ZenohLink(listener, "a//b")


def test_a_session_waits_in_the_background_for_what_it_cannot_reach_yet(endpoint: str) -> None:
    with open_session(connect=[endpoint]) as early:
        made = early.declare_publisher("t")
        for _ in range(2):
            with open_session(listen=[endpoint]) as late, ZenohLink(late, "t") as link:
                wait_for_match(made)
                made.put(b"{}")
                collect(link, 1)
            while made.matching_status.matching:
                time.sleep(0.005)


LISTENING = """
import os, sys
from pathlib import Path
from adapters.zenoh_session import open_session
with open_session(connect=sys.argv[1:2], listen=sys.argv[2:]):
    handles = [Path("/proc/self/fd", fd) for fd in os.listdir("/proc/self/fd")]
    sockets = {os.readlink(handle) for handle in handles if handle.is_symlink()}
    for table in ("tcp", "tcp6", "udp", "udp6"):
        for row in Path("/proc/net", table).read_text().splitlines()[1:]:
            columns = row.split()
            if f"socket:[{columns[9]}]" in sockets and columns[3] in ("07", "0A"):
                print(columns[1])
"""


def test_sessions_listen_nowhere_but_where_told(endpoint: str) -> None:
    def listening(*listen: str) -> list[str]:
        command = [sys.executable, "-c", LISTENING, endpoint, *listen]
        return subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT).stdout.split()

    other = free_endpoint()
    assert listening(other) == [f"0100007F:{int(other.rpartition(':')[2]):04X}"]
    assert listening() == []


@pytest.mark.parametrize(
    ("where", "said"),
    [
        ({"listen": ["foo"]}, "Zenoh endpoint foo: not understood; write it like tcp/127.0.0.1:7447"),
        ({"connect": ["tcp"]}, "Zenoh endpoint tcp: not understood"),
        (
            {"listen": ["tcp/1.2.3.4:7447"]},
            "Zenoh cannot listen on tcp/1.2.3.4:7447: 1.2.3.4:7447: Cannot assign",
        ),
        (
            {"listen": ["tcp/127.0.0.1:99999"]},
            "Zenoh cannot listen on tcp/127.0.0.1:99999: invalid port value",
        ),
    ],
)
def test_an_endpoint_that_cannot_be_used_is_reported_in_one_line(where: dict[str, list[str]], said: str) -> None:
    with pytest.raises(TelemetryError) as caught:
        open_session(**where)
    assert str(caught.value).startswith(said)
    assert "\n" not in str(caught.value)
    assert ".rs" not in str(caught.value)


def test_a_taken_port_is_reported(listener: zenoh.Session, endpoint: str) -> None:
    with pytest.raises(TelemetryError, match="the port is taken; is another monitor running"):
        open_session(listen=[endpoint])
