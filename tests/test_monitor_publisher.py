"""Zenoh outputs over real sessions on loopback: who listens, who joins late, who only asks."""

from __future__ import annotations

import json
import threading
from typing import Any

import numpy as np
import pytest
import zenoh
from loopback import START_NS, Endpoint, event, matched, until
from zenoh import ext

from adapters.errors import UsageError
from adapters.sample import Samples
from monitor.bus.publisher import HISTORIES, HISTORY_EVENTS, Publisher
from monitor.estimate import Estimates, Layout
from monitor.event import AlarmEvent, event_from_json

LAYOUT = Layout("motors", 100.0, ("u",), ("r",), ("p",), ("motor1", "motor 2"), ("m", "m"))


def estimates(index: int, time_ns: int | None = None) -> Estimates:
    when = START_NS + index * 10_000_000 if time_ns is None else time_ns
    signals, yes = np.zeros((1, 1)), np.array([True])
    times_ns = np.array([index * 10_000_000]), np.array([when])
    return Estimates(
        observer="motors",
        samples=Samples(np.array([index]), *times_ns, signals, signals, ~yes, yes, times_ns[0], yes, signals > 0),
        x=np.array([[0.5]]),
        fault=np.array([[-0.02, np.nan]]),
        isolated=np.zeros((1, 2)),
        residual=np.array([[1e-3]]),
        armed=yes,
        sd=np.array([[0.1, 0.2]]),
        coasted_s=np.zeros(1),
    )


@pytest.fixture
def publisher(endpoint: Endpoint) -> Publisher:
    return Publisher(endpoint.session, "copter-1", [LAYOUT])


def collect(session: zenoh.Session, key: str) -> list[tuple[str, Any, str]]:
    """Subscribe as a plain client would; return the list that fills."""
    found: list[tuple[str, Any, str]] = []

    def take(sample: zenoh.Sample) -> None:
        found.append((str(sample.key_expr), json.loads(sample.payload.to_bytes()), str(sample.encoding)))

    session.declare_subscriber(key, take)
    return found


def collect_with_history(session: zenoh.Session, key: str) -> list[AlarmEvent]:
    found: list[AlarmEvent] = []
    ext.declare_advanced_subscriber(
        session,
        key,
        lambda sample: found.append(event_from_json(json.loads(sample.payload.to_bytes()))),
        history=ext.HistoryConfig(detect_late_publishers=True, max_samples=1),
        recovery=ext.RecoveryConfig(heartbeat=True, periodic_queries=None),
    )
    return found


def ask(session: zenoh.Session, selector: str) -> dict[str, Any]:
    """Return the JSON replies to a get by their keys."""
    replies = {}
    for reply in session.get(selector, timeout=5.0):
        assert reply.ok is not None
        assert str(reply.ok.encoding) == "application/json"
        replies[str(reply.ok.key_expr)] = json.loads(reply.ok.payload.to_bytes())
    return replies


def test_a_subscriber_gets_every_event_on_its_channels_key(endpoint: Endpoint, publisher: Publisher) -> None:
    found = collect(endpoint.client(), "fauio/copter-1/alarm/**")
    events = [event(1), event(2, "motor 2"), event(3, state="updated"), event(4, state="cleared")]
    until(lambda: matched(endpoint, "fauio/copter-1/alarm/motors/motor1"))
    for count, one in enumerate(events, 1):
        publisher.event(one)
        # one after the other: of a burst a busy machine may drop some on the way to a plain subscriber
        until(lambda count=count: len(found) >= count)
    assert [key for key, _, _ in found] == [
        "fauio/copter-1/alarm/motors/motor1",
        "fauio/copter-1/alarm/motors/motor_2",
        "fauio/copter-1/alarm/motors/motor1",
        "fauio/copter-1/alarm/motors/motor1",
    ]
    assert [event_from_json(payload) for _, payload, _ in found] == events
    assert {encoding for _, _, encoding in found} == {"application/json"}


def test_a_late_joiner_gets_the_latest_state_of_each_channel_and_then_what_follows(
    endpoint: Endpoint, publisher: Publisher
) -> None:
    publisher.event(event(1))
    publisher.event(event(2, state="updated"))
    publisher.event(event(3, "motor 2"))
    late = collect_with_history(endpoint.client(), "fauio/*/alarm/**")
    until(lambda: len(late) == 2)
    assert {(one.channel, one.seq) for one in late} == {("motor1", 2), ("motor 2", 3)}
    publisher.event(event(4, state="cleared"))
    publisher.event(event(5, "gps_north"))
    until(lambda: len(late) == 4)
    assert [one.seq for one in late[2:]] == [4, 5]


def test_a_subscriber_that_was_there_first_hears_of_a_publisher_that_comes_later(endpoint: Endpoint) -> None:
    early = collect_with_history(endpoint.client(), "fauio/*/alarm/**")
    publisher = Publisher(endpoint.session, "copter-1", [LAYOUT])
    publisher.event(event(1))
    until(lambda: bool(early))
    publisher.event(event(2))
    until(lambda: len(early) == 2)
    assert [one.seq for one in early] == [1, 2]


def test_a_plain_get_on_alarm_keys_returns_the_latest_event_of_each_matching_channel(
    endpoint: Endpoint, publisher: Publisher
) -> None:
    publisher.event(event(1))
    publisher.event(event(2, state="cleared"))
    publisher.event(event(3, "motor 2"))
    client = endpoint.client()
    until(lambda: len(ask(client, "fauio/copter-1/alarm/**")) == 2)
    replies = ask(client, "fauio/*/alarm/motors/*")
    assert {key: reply["seq"] for key, reply in replies.items()} == {
        "fauio/copter-1/alarm/motors/motor1": 2,
        "fauio/copter-1/alarm/motors/motor_2": 3,
    }
    assert list(ask(client, "fauio/copter-1/alarm/motors/motor1")) == ["fauio/copter-1/alarm/motors/motor1"]
    assert ask(client, "fauio/copter-2/alarm/**") == {}


def test_the_alarms_queryable_lists_active_alarms_or_history(endpoint: Endpoint, publisher: Publisher) -> None:
    client = endpoint.client()
    until(lambda: ask(client, "fauio/copter-1/alarms") == {"fauio/copter-1/alarms": []})
    for one in (
        event(1),
        event(2, "motor 2"),
        event(3, state="cleared"),
        event(4, "motor 2", state="updated"),
    ):
        publisher.event(one)

    def seqs(selector: str) -> list[int]:
        return [one["seq"] for one in ask(client, selector)["fauio/copter-1/alarms"]]

    assert seqs("fauio/copter-1/alarms") == [4]
    assert seqs("fauio/copter-1/alarms?history=true") == [1, 2, 3, 4]
    assert seqs(f"fauio/copter-1/alarms?history=true;since={START_NS + 3}") == [3, 4]
    [reply] = client.get("fauio/copter-1/alarms?history=true;since=yesterday")
    assert reply.err is not None
    assert "since" in json.loads(reply.err.payload.to_bytes())["error"]


def test_history_is_bounded_and_keeps_the_latest(endpoint: Endpoint, publisher: Publisher) -> None:
    for seq in range(HISTORY_EVENTS + 10):
        publisher.event(event(seq))
    client = endpoint.client()
    until(lambda: ask(client, "fauio/copter-1/alarms") != {})
    history = ask(client, "fauio/copter-1/alarms?history=true")["fauio/copter-1/alarms"]
    assert [one["seq"] for one in history] == list(range(10, HISTORY_EVENTS + 10))


def test_estimates_are_thinned_on_the_samples_time(endpoint: Endpoint, publisher: Publisher) -> None:
    found = collect(endpoint.client(), "fauio/copter-1/estimate/*")
    until(lambda: matched(endpoint, "fauio/copter-1/estimate/motors"))
    for index in range(100):
        publisher.estimates(estimates(index))
    publisher.estimates(estimates(0, time_ns=5))
    publisher.estimates(estimates(7, time_ns=6))
    publisher.status({"state": "monitoring"})
    until(lambda: len(found) >= 12)
    payloads = [payload for _, payload, _ in found]
    assert len(payloads) == 12
    assert payloads[-1]["time_ns"] == 5
    slots = [payload["time_ns"] // 100_000_000 for payload in payloads[:-1]]
    assert slots == list(range(slots[0], slots[0] + 11))
    assert payloads[0] == {
        "time_ns": START_NS,
        "vehicle_time_ms": 0,
        "armed": True,
        "x": {"p": 0.5},
        "fault": {"motor1": -0.02, "motor 2": None},
        "sd": {"motor1": 0.1, "motor 2": 0.2},
        "coasted_s": 0.0,
        "isolated": {"motor1": 0.0, "motor 2": 0.0},
        "residual": {"r": 0.001},
    }


def test_estimates_are_made_while_somebody_receives_them(
    endpoint: Endpoint, publisher: Publisher, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[int] = []
    monkeypatch.setattr("monitor.bus.publisher.estimate_json", lambda *_: made.append(1) or {"made": len(made)})
    publisher.estimates(estimates(0))
    assert made == []
    found = collect(endpoint.client(), "fauio/copter-1/estimate/*")
    until(lambda: matched(endpoint, "fauio/copter-1/estimate/motors"))
    publisher.estimates(estimates(1000))
    until(lambda: bool(found))
    assert found[0][1] == {"made": 1}


def test_no_estimates_at_a_rate_of_zero(endpoint: Endpoint) -> None:
    publisher = Publisher(endpoint.session, "copter-1", [LAYOUT], estimate_rate_hz=0.0)
    found = collect(endpoint.client(), "fauio/copter-1/**")
    until(lambda: matched(endpoint, "fauio/copter-1/status"))
    publisher.estimates(estimates(0))
    publisher.status({"state": "monitoring", "latency_ms": float("inf")})
    until(lambda: bool(found))
    assert found == [("fauio/copter-1/status", {"state": "monitoring", "latency_ms": None}, "application/json")]


def test_the_token_lives_as_long_as_the_publisher(endpoint: Endpoint, publisher: Publisher) -> None:
    kinds: list[tuple[str, zenoh.SampleKind]] = []
    endpoint.client().liveliness().declare_subscriber(
        "fauio/*/live", lambda sample: kinds.append((str(sample.key_expr), sample.kind)), history=True
    )
    until(lambda: len(kinds) == 1)
    publisher.event(event(1))
    publisher.close()
    publisher.close()
    until(lambda: len(kinds) == 2)
    assert kinds == [
        ("fauio/copter-1/live", zenoh.SampleKind.PUT),
        ("fauio/copter-1/live", zenoh.SampleKind.DELETE),
    ]


def test_two_vehicles_share_a_session_under_a_prefix_of_several_chunks(endpoint: Endpoint) -> None:
    publishers = [Publisher(endpoint.session, name, [LAYOUT], prefix="site/fauio") for name in ("a", "b")]
    late = collect_with_history(endpoint.client(), "site/fauio/*/alarm/**")
    for seq, publisher in enumerate(publishers):
        publisher.event(event(seq, vehicle="ab"[seq]))
    until(lambda: len(late) == 2)
    assert {one.vehicle for one in late} == {"a", "b"}


@pytest.mark.parametrize("name", ["", "a//b", "a*", "a b", "@a", "a?b", "$*", "#"])
def test_a_name_that_no_key_can_hold_is_refused(endpoint: Endpoint, name: str) -> None:
    with pytest.raises(UsageError, match="cannot be part of a Zenoh key"):
        Publisher(endpoint.session, name, [LAYOUT])
    with pytest.raises(UsageError, match="cannot be part of a Zenoh key"):
        Publisher(endpoint.session, "copter-1", [LAYOUT], prefix=name + "/x")


def test_a_client_that_stops_reading_stops_neither_the_monitor_nor_other_clients(
    endpoint: Endpoint, publisher: Publisher
) -> None:
    good = collect(endpoint.client(), "fauio/copter-1/alarm/**")
    endpoint.client().declare_subscriber("fauio/**", zenoh.handlers.FifoChannel(1))
    until(lambda: matched(endpoint, "fauio/copter-1/alarm/motors/motor1"))
    for seq in range(1000):
        publisher.event(event(seq, message="x" * 20_000))

    def still_served() -> bool:
        publisher.event(event(1000))
        return bool(good) and good[-1][1]["seq"] == 1000

    until(still_served)


def test_a_journal_that_takes_long_delays_no_other_answer_and_too_many_at_once_are_refused(endpoint: Endpoint) -> None:
    reading, go_on, asked = threading.Event(), threading.Event(), []

    def past(since_ns: int) -> list[AlarmEvent]:
        asked.append(since_ns)
        reading.set()
        assert go_on.wait(30.0)
        if since_ns == 1:
            raise OSError("disk gone")
        return [event(seq) for seq in range(1, 6)]

    publisher = Publisher(endpoint.session, "copter-1", [LAYOUT], journal=past)
    publisher.event(event(9))
    client = endpoint.client()
    first = client.get("fauio/copter-1/alarms?history=true;since=1", timeout=30.0)
    reading.wait(30.0)
    waiting = [client.get("fauio/copter-1/alarms?history=true;limit=2", timeout=30.0) for _ in range(HISTORIES)]
    # Whatever waits for the disk, the active alarms are answered, and the last of the others is refused.
    assert [one["seq"] for one in ask(client, "fauio/copter-1/alarms")["fauio/copter-1/alarms"]] == [9]
    refused = waiting[-1].recv()
    assert refused.err is not None
    assert b"too many" in refused.err.payload.to_bytes()
    assert asked == [1]
    go_on.set()
    failed = first.recv()
    assert failed.err is not None
    assert b"disk gone" in failed.err.payload.to_bytes()
    for one in waiting[:-1]:
        answer = one.recv()
        assert answer.ok is not None
        assert [row["seq"] for row in json.loads(answer.ok.payload.to_bytes())] == [4, 5]
