"""What operators ask of a monitor: which alarm is meant, what is sent, and what is said when it does not work."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh
from jsonschema import Draft202012Validator
from loopback import Endpoint, event

from adapters.errors import UsageError
from adapters.zenoh.zenoh_session import open_session
from monitor.bus.alarm_text import alarm_line
from monitor.bus.payload import to_json
from monitor.bus.publisher import Publisher
from monitor.bus.schemas import SCHEMAS
from monitor.console import operator_client
from monitor.console.operator_client import Target, find_target, send_command

ROOT = Path(__file__).parent.parent
ULID = "01J0000000000000000000ABCD"
ACKNOWLEDGED = event(2, state="acknowledged", acknowledged=True)


class Monitor:
    """The side of a monitor that answers commands, and what it was asked."""

    def __init__(self, endpoint: Endpoint, reply: bytes, failed: bool = False, vehicle: str = "copter-1") -> None:
        self.asked: list[tuple[str, Any]] = []
        self._reply = reply
        self._failed = failed
        self._queryable = endpoint.session.declare_queryable(f"fauio/{vehicle}/command/*", self._answer)

    def _answer(self, query: zenoh.Query) -> None:
        with query:
            assert query.payload is not None
            self.asked.append((str(query.key_expr), json.loads(query.payload.to_bytes())))
            if self._failed:
                query.reply_err(self._reply)
            else:
                query.reply(query.key_expr, self._reply)


def done(one: Any = ACKNOWLEDGED) -> bytes:
    return to_json({"ok": True, "event": one.to_json()})


def run(endpoint: Endpoint, *options: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-W", "error", "-m", "fauio", "alarms", *options, "--connect", endpoint.address]
    return subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)


def find(session: zenoh.Session, text: str, vehicle: str = "*") -> Target:
    return find_target(session, text, "fauio", vehicle, ["tcp/here"])


@pytest.mark.parametrize(
    ("options", "verb", "request_body"),
    [
        (("ack", "motors/motor1", "--by", "eva"), "ack", {"channel": "motors/motor1", "by": "eva"}),
        (("ack", "motor1", "--by", "eva"), "ack", {"channel": "motors/motor1", "by": "eva"}),
        (
            ("--vehicle", "copter-1", "shelve", ULID, "--minutes", "5", "--reason", "landing", "--by", "eva"),
            "shelve",
            {"id": ULID, "by": "eva", "reason": "landing", "minutes": 5.0},
        ),
    ],
)
def test_a_command_is_sent_and_the_reply_is_printed(
    endpoint: Endpoint, options: tuple[str, ...], verb: str, request_body: dict[str, Any]
) -> None:
    publisher = Publisher(endpoint.session, "copter-1", [])
    publisher.event(event(1))
    monitor = Monitor(endpoint, done())
    found = run(endpoint, *options)
    assert (found.returncode, found.stdout, found.stderr) == (0, alarm_line(ACKNOWLEDGED) + "\n", "")
    assert monitor.asked == [(f"fauio/copter-1/command/{verb}", request_body)]
    Draft202012Validator(SCHEMAS["command_request"]).validate(request_body)


def test_json_prints_the_reply_and_the_user_is_named(endpoint: Endpoint) -> None:
    monitor = Monitor(endpoint, done())
    found = run(endpoint, "reset", "motors/motor1", "--vehicle", "copter-1", "--json")
    assert json.loads(found.stdout) == {"ok": True, "event": ACKNOWLEDGED.to_json()}
    assert monitor.asked[0][1]["by"]


@pytest.mark.parametrize(
    ("reply", "complaint"),
    [
        (b'{"error": "motors/motor1 is not active\\u001b[2J"}', "fauio: ack: motors/motor1 is not active?[2J\n"),
        (b"nonsense", "fauio: ack: no answer within 5 s; look with 'fauio alarms' whether it was done\n"),
    ],
)
def test_a_refusal_is_one_line_and_ends_with_2(endpoint: Endpoint, reply: bytes, complaint: str) -> None:
    monitor = Monitor(endpoint, reply, failed=True)
    found = run(endpoint, "ack", "motors/motor1", "--vehicle", "copter-1")
    assert (found.returncode, found.stdout, found.stderr) == (2, "", complaint)
    assert len(monitor.asked) == 1


@pytest.mark.parametrize("reply", [b"nonsense", b"[]", b"\xff", b"[" * 100_000])
def test_a_reply_that_is_none_is_said_so(endpoint: Endpoint, reply: bytes) -> None:
    monitor = Monitor(endpoint, reply)
    with pytest.raises(UsageError, match="the answer is no JSON object"):
        send_command(endpoint.client(), "fauio", "copter-1", "ack", {"id": ULID})
    assert len(monitor.asked) == 1


def test_an_event_that_is_none_is_not_printed_as_one(endpoint: Endpoint) -> None:
    monitor = Monitor(endpoint, b'{"ok": true, "event": {"id": 3, "message": "\\u001b[2J"}}')
    found = run(endpoint, "unshelve", "motors/motor1", "--vehicle", "copter-1")
    assert (found.returncode, found.stdout) == (0, "unshelve motors/motor1: done\n")
    assert len(monitor.asked) == 1


def test_nobody_who_answers_is_explained(endpoint: Endpoint, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(operator_client, "TRIES", 2)
    session = endpoint.client()
    with pytest.raises(UsageError, match="no monitor answers at tcp/here; start one with 'fauio run'"):
        find(session, "motor1")
    with pytest.raises(UsageError, match="no monitor of 'copter-1' answers to 'ack': it is not running, or its"):
        send_command(session, "fauio", "copter-1", "ack", {"id": ULID})
    publisher = Publisher(endpoint.session, "copter-1", [])
    with pytest.raises(UsageError, match=r"does not take 'ack'; .* \[commands\] allow = \[\"ack\"\]"):
        send_command(session, "fauio", "copter-1", "ack", {"id": ULID})
    publisher.close()


def test_nobody_on_the_whole_network_ends_with_2(tmp_path: Path) -> None:
    session = open_session()
    try:
        with pytest.raises(UsageError, match="no monitor of 'copter-1' answers at tcp/here"):
            find(session, "motor1", "copter-1")
    finally:
        session.close()


def test_an_alarm_is_found_by_id_by_channel_and_by_its_last_name(endpoint: Endpoint) -> None:
    publishers = [Publisher(endpoint.session, name, []) for name in ("copter-1", "copter-2")]
    publishers[0].event(event(1, id=ULID))
    publishers[1].event(event(1, "motor2", vehicle="copter-2"))
    publishers[1].event(event(2, "motor3", vehicle="copter-2", state="cleared"))
    session = endpoint.client()
    assert find(session, ULID) == Target("copter-1", {"id": ULID})
    assert find(session, "motors/motor2") == Target("copter-2", {"channel": "motors/motor2"})
    assert find(session, "motor1") == Target("copter-1", {"channel": "motors/motor1"})
    assert find(session, "motors/motor9", "copter-2") == Target("copter-2", {"channel": "motors/motor9"})
    with pytest.raises(
        UsageError,
        match="no active alarm 'motor3'; active are motors/motor1 of copter-1, motors/motor2 of copter-2",
    ):
        find(session, "motor3")


def test_what_several_vehicles_have_needs_the_vehicle(endpoint: Endpoint) -> None:
    publishers = [Publisher(endpoint.session, name, []) for name in ("copter-1", "copter-2")]
    for publisher, name in zip(publishers, ("copter-1", "copter-2"), strict=True):
        publisher.event(event(1, vehicle=name))
    session = endpoint.client()
    with pytest.raises(
        UsageError, match=r"'motor1' is more than one alarm: .* of copter-1, .* of copter-2; add --vehi"
    ):
        find(session, "motor1")
    assert find(session, "motor1", "copter-2") == Target("copter-2", {"channel": "motors/motor1"})


def test_the_only_vehicle_is_asked_about_a_channel_that_is_not_active(endpoint: Endpoint) -> None:
    publisher = Publisher(endpoint.session, "copter-1", [])
    session = endpoint.client()
    assert find(session, "motors/motor1") == Target("copter-1", {"channel": "motors/motor1"})
    with pytest.raises(UsageError, match="no active alarm 'motor1'; none is active"):
        find(session, "motor1")
    publisher.close()


@pytest.mark.parametrize("payload", [b'{"a": 1}', b'[3, {"id": 1}, {"id": "a", "observer": 2, "channel": "c"}]'])
def test_a_list_of_alarms_that_is_none_holds_none(
    endpoint: Endpoint, payload: bytes, until_answer: Callable[[str, bytes], None]
) -> None:
    until_answer("fauio/copter-1/alarms", payload)
    with pytest.raises(UsageError, match="no active alarm 'motor1'; none is active"):
        find(endpoint.client(), "motor1")


@pytest.fixture
def until_answer(endpoint: Endpoint) -> Iterator[Callable[[str, bytes], None]]:
    declared: list[Any] = []

    def declare(key: str, payload: bytes) -> None:
        declared.append(endpoint.session.declare_queryable(key, lambda query: query.reply(key, payload)))

    yield declare
    for queryable in declared:
        queryable.undeclare()
