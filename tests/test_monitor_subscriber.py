"""Alarm events at the listening end: current state first, each event once, whatever else arrives."""

from __future__ import annotations

import json
from typing import Any

import pytest
from loopback import Endpoint, event, matched, put, until

from adapters.errors import UsageError
from monitor.bus.publisher import Publisher
from monitor.bus.subscriber import HELD_EVENTS, AlarmSubscriber
from monitor.event import AlarmEvent, valid_event

KEY = "fauio/copter-1/alarm/motors/motor1"


def take(subscriber: AlarmSubscriber, count: int) -> list[AlarmEvent]:
    """Return the next events; the test's own time-out ends it if they do not come."""
    found: list[AlarmEvent] = []
    while len(found) < count:
        one = subscriber.receive(1.0)
        if one is not None:
            found.append(one)
    return found


def test_the_current_state_comes_first_and_then_each_change(endpoint: Endpoint) -> None:
    publisher = Publisher(endpoint.session, "copter-1", [])
    publisher.event(event(1))
    publisher.event(event(2, state="updated"))
    subscriber = AlarmSubscriber(endpoint.client())
    assert take(subscriber, 1) == [event(2, state="updated")]
    publisher.event(event(3, state="cleared"))
    publisher.event(event(4, "motor 2"))
    assert take(subscriber, 2) == [event(3, state="cleared"), event(4, "motor 2")]
    assert subscriber.receive(0.0) is None
    subscriber.close()


def test_history_begins_with_the_past_and_gives_each_event_once(endpoint: Endpoint) -> None:
    publisher = Publisher(endpoint.session, "copter-1", [])
    past = [event(1), event(2, "motor 2"), event(3, state="cleared")]
    for one in past:
        publisher.event(one)
    subscriber = AlarmSubscriber(endpoint.client(), history=True)
    assert take(subscriber, 3) == past
    publisher.event(event(4, "motor 2", state="updated"))
    assert [one.seq for one in take(subscriber, 1)] == [4]
    assert subscriber.receive(0.0) is None


def test_what_clears_an_alarm_gets_through_where_its_number_was_given_before(endpoint: Endpoint) -> None:
    publisher = Publisher(endpoint.session, "copter-1", [])
    subscriber = AlarmSubscriber(endpoint.client(), history=True)
    until(lambda: bool(subscriber.live))
    publisher.event(event(1))
    publisher.event(event(1, state="cleared"))
    assert [one.state for one in take(subscriber, 2)] == ["raised", "cleared"]


def test_only_the_named_vehicle_is_heard(endpoint: Endpoint) -> None:
    publishers = [Publisher(endpoint.session, name, []) for name in ("copter-1", "copter-2")]
    subscriber = AlarmSubscriber(endpoint.client(), vehicle="copter-2", history=True)
    for seq, publisher in enumerate(publishers):
        publisher.event(event(seq, vehicle=f"copter-{seq + 1}"))
    assert [one.vehicle for one in take(subscriber, 1)] == ["copter-2"]
    until(lambda: subscriber.live == {"copter-2"})


def test_monitors_are_seen_to_come_and_go(endpoint: Endpoint) -> None:
    subscriber = AlarmSubscriber(endpoint.client())
    assert subscriber.live == frozenset()
    publishers = [Publisher(endpoint.session, name, []) for name in ("copter-1", "copter-2")]
    until(lambda: subscriber.live == {"copter-1", "copter-2"})
    publishers[0].close()
    until(lambda: subscriber.live == {"copter-2"})


GOOD = event(1).to_json()
ALMOST = [
    b"",
    b"\xff\xfe",
    b"null",
    b"[1, 2]",
    b'"text"',
    b"[" * 100_000,
    b"{" + b" " * (1 << 20),
    json.dumps(GOOD | {"time_ns": "yesterday"}).encode(),
    json.dumps(GOOD | {"time_ns": True}).encode(),
    json.dumps(GOOD | {"message": {"a": 1}}).encode(),
    json.dumps(GOOD | {"estimate": [1.0]}).encode(),
    json.dumps({name: GOOD[name] for name in ("id", "vehicle")}).encode(),
]


@pytest.mark.parametrize("payload", ALMOST, ids=range(len(ALMOST)))
def test_what_is_no_event_is_counted_and_the_next_one_is_heard(endpoint: Endpoint, payload: bytes) -> None:
    subscriber = AlarmSubscriber(endpoint.client())
    until(lambda: matched(endpoint, KEY))
    put(endpoint.session, KEY, payload)
    put(endpoint.session, KEY, json.dumps(GOOD).encode())
    assert take(subscriber, 1) == [event(1)]
    assert subscriber.invalid == 1


def test_an_event_of_a_newer_monitor_with_more_fields_is_understood(endpoint: Endpoint) -> None:
    subscriber = AlarmSubscriber(endpoint.client())
    until(lambda: matched(endpoint, KEY))
    put(endpoint.session, KEY, json.dumps(GOOD | {"tomorrow": 1, "estimate": 1, "peak": None}).encode())
    assert take(subscriber, 1) == [event(1, estimate=1, peak=None)]


def test_a_reader_that_does_not_read_loses_the_oldest_events(endpoint: Endpoint) -> None:
    client = endpoint.client()
    subscriber = AlarmSubscriber(client)
    publisher = Publisher(client, "copter-1", [])
    for seq in range(HELD_EVENTS + 5):
        publisher.event(event(seq))
    until(lambda: subscriber.lost >= 5)
    assert [one.seq for one in take(subscriber, 3)] == [5, 6, 7]


@pytest.mark.parametrize("vehicle", ["", "a/b", "**", "$*"])
def test_a_name_that_no_key_can_hold_is_refused(endpoint: Endpoint, vehicle: str) -> None:
    with pytest.raises(UsageError, match="cannot be part of a Zenoh key"):
        AlarmSubscriber(endpoint.session, vehicle)


def test_a_broken_answer_to_the_history_question_is_counted(endpoint: Endpoint) -> None:
    def answer(query: Any) -> None:
        with query:
            query.reply("fauio/copter-1/alarms", json.dumps([GOOD, {"id": 1}, 7]).encode())

    endpoint.session.declare_queryable("fauio/copter-1/alarms", answer)
    client = endpoint.client()
    until(lambda: bool(ask_raw(client)))
    subscriber = AlarmSubscriber(client, history=True)
    token = endpoint.session.liveliness().declare_token("fauio/copter-1/live")
    assert take(subscriber, 1) == [event(1)]
    until(lambda: subscriber.invalid == 2)
    token.undeclare()


def ask_raw(session: Any) -> list[Any]:
    return list(session.get("fauio/copter-1/alarms", timeout=5.0))


@pytest.mark.parametrize(
    ("name", "value"),
    [("estimate", 10**400), ("time_ns", 1 << 101), ("seq", 1 << 63), ("seq", -1), ("peak", -(10**400))],
)
def test_a_number_that_nothing_can_hold_makes_no_event(name: str, value: int) -> None:
    assert valid_event(GOOD) == event(1)
    assert valid_event({**GOOD, name: value}) is None
