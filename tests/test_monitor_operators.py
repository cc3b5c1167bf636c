"""Operators' commands through real Zenoh sessions: carried out, refused with a reason, never a crash."""

import json
from typing import Any

import pytest
import zenoh
from loopback import START_NS, Endpoint, event, until

from adapters.source import OPERATOR
from monitor.bus.operators import Operators

ROOT = "fauio/copter-1"
MINUTE_NS = 60_000_000_000


class Client:
    """A client that has seen the monitor's queryable, and the answers it got."""

    def __init__(self, endpoint: Endpoint) -> None:
        self._session = endpoint.client()
        self.answers: list[dict[str, Any]] = []
        self._querier = self._session.declare_querier(f"{ROOT}/command/ack")
        until(lambda: bool(self._querier.matching_status.matching))

    def ask(self, verb: str, payload: bytes | None) -> None:
        self._session.get(f"{ROOT}/command/{verb}", self._answer, payload=payload, timeout=10.0)

    def _answer(self, reply: zenoh.Reply) -> None:
        found = reply.ok or reply.err
        assert found is not None
        self.answers.append(json.loads(found.payload.to_bytes()))


def test_a_command_waits_for_the_monitors_thread_and_is_answered_with_its_event(endpoint: Endpoint) -> None:
    operators = Operators(endpoint.session, ROOT, ("ack",))
    client = Client(endpoint)
    client.ask("ack", b'{"channel": "motor1", "by": "Ann\\n\\u001b[2J\\ud800", "junk": 1}')
    found: list[Any] = []
    until(lambda: bool(found.extend(operators.pending()) or found))
    message = operators.message(found[0], START_NS)
    assert (message.source, message.name, message.received_ns) == (OPERATOR, "ack", START_NS)
    assert message.fields == {"channel": "motor1", "by": "Ann??[2J?"}
    operators.accept(found[0], event(3))
    until(lambda: bool(client.answers))
    assert client.answers == [{"ok": True, "event": event(3).to_json()}]
    operators.close()


def test_what_is_not_allowed_or_no_command_is_refused_with_the_reason(endpoint: Endpoint) -> None:
    operators = Operators(endpoint.session, ROOT, ("ack",))
    client = Client(endpoint)
    for verb, reason in (("reset", "not allowed"), ("explode", "no command"), ("*", "no command")):
        client.answers.clear()
        client.ask(verb, b'{"channel": "motor1"}')
        until(lambda: bool(client.answers))
        assert client.answers[0]["ok"] is False
        assert reason in client.answers[0]["error"]
    assert operators.refused == 3
    assert operators.pending() == []
    operators.close()


@pytest.mark.parametrize(
    "payload",
    [None, b"", b"\xff\xfe\x00", b"[]", b"7", b"{}", b'{"channel": 7}', b"[" * 4000, b'{"id": "' + b"x" * 5000 + b'"}'],
)
def test_a_payload_that_names_no_alarm_is_refused(endpoint: Endpoint, payload: bytes | None) -> None:
    operators = Operators(endpoint.session, ROOT, ("ack",))
    client = Client(endpoint)
    client.ask("ack", payload)
    until(lambda: bool(client.answers))
    assert "no JSON object" in client.answers[0]["error"]
    operators.close()


@pytest.mark.parametrize(
    ("minutes", "expected"),
    [("5", 5), ("0.5", 0.5), ("1e999", 480), ("1" * 400, 480), ("NaN", 60), ("-1", 60), ("true", 60), ('"x"', 60)],
)
def test_shelving_lasts_as_long_as_said_within_limits(endpoint: Endpoint, minutes: str, expected: float) -> None:
    operators = Operators(endpoint.session, ROOT, ("ack", "shelve"))
    client = Client(endpoint)
    client.ask("shelve", f'{{"id": "x", "minutes": {minutes}}}'.encode())
    found: list[Any] = []
    until(lambda: bool(found.extend(operators.pending()) or found))
    assert operators.message(found[0], START_NS).fields == {"id": "x", "until_ns": START_NS + expected * MINUTE_NS}
    operators.accept(found[0], None)
    operators.close()


def test_a_thousand_commands_at_once_are_all_answered_and_the_queue_stays_bounded(endpoint: Endpoint) -> None:
    operators = Operators(endpoint.session, ROOT, ("ack",))
    client = Client(endpoint)
    for _ in range(1000):
        client.ask("ack", b'{"channel": "motor1"}')
    until(lambda: len(client.answers) + 64 >= 1000)
    waiting = operators.pending()
    assert len(waiting) == 64
    for command in waiting:
        operators.accept(command, None)
    until(lambda: len(client.answers) == 1000)
    assert sum(answer["ok"] for answer in client.answers) == 64
    assert operators.refused == 936
    operators.close()


def test_commands_that_wait_at_the_end_are_refused_and_a_client_that_left_does_no_harm(endpoint: Endpoint) -> None:
    operators = Operators(endpoint.session, ROOT, ("ack",))
    client = Client(endpoint)
    client.ask("ack", b'{"channel": "motor1"}')
    found: list[Any] = []
    until(lambda: bool(found.extend(operators.pending()) or found))
    endpoint.clients[-1].close()
    operators.accept(found[0], None)
    other = Client(endpoint)
    other.ask("ack", b'{"channel": "motor1"}')
    until(lambda: len(operators._waiting) == 1)
    operators.close()
    until(lambda: bool(other.answers))
    assert other.answers == [{"ok": False, "error": "the monitor is stopping"}]
