"""Forged values beside true ones are told from noise: they come on top, and contradict those around them."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import pytest
from test_monitor_impostor import events_of

from adapters.message import Message
from monitor.event import AlarmEvent
from monitor.profile import Profile

UNITS = {"time_boot_ms": 1e3, "time_usec": 1e6}
START_S = 10.0


def forged(message: Message, behind_s: float, changes: Mapping[str, float]) -> Message:
    fields = dict(message.fields)
    for name, per_s in UNITS.items():
        if fields.get(name):
            fields[name] += round(behind_s * per_s)
    for name, change in changes.items():
        fields[name] += type(fields[name])(change)
    return replace(message, received_ns=message.received_ns + round(behind_s * 1e9), fields=fields)


def attacked(
    calm_flight: list[Message],
    name: str,
    changes: Mapping[str, float],
    every: int,
    share: float,
    start_s: float = START_S,
) -> list[Message]:
    """Return messages with a forged one behind each ``every``-th of a kind, by a share of its period."""
    own = [message for message in calm_flight if message.name == name]
    period_s = (own[-1].received_ns - own[0].received_ns) / 1e9 / len(own)
    late = [message for message in own if message.received_ns - calm_flight[0].received_ns >= start_s * 1e9][::every]
    return in_order([*calm_flight, *(forged(message, share * period_s, changes) for message in late)])


def in_order(messages: list[Message]) -> list[Message]:
    return sorted(messages, key=lambda message: message.received_ns)


def impostors(bundled_quad: Profile, messages: list[Message]) -> list[AlarmEvent]:
    return [event for event in events_of(bundled_quad, messages) if event.channel == "impostor"]


@pytest.mark.parametrize(
    ("name", "changes", "every", "share"),
    [
        ("ATTITUDE", {"roll": 0.2}, 1, 0.45),
        ("HIGHRES_IMU", {"xgyro": 0.3}, 1, 0.0),
        ("HIGHRES_IMU", {"xgyro": 0.3}, 1, 0.01),
        ("GPS_RAW_INT", {"lat": 500}, 1, 0.45),
        ("SERVO_OUTPUT_RAW", {"servo1_raw": 150}, 5, 0.45),
    ],
)
def test_values_of_two_senders_by_turns_are_an_impostor(
    bundled_quad: Profile, calm_flight: list[Message], name: str, changes: Mapping[str, float], every: int, share: float
) -> None:
    first = impostors(bundled_quad, attacked(calm_flight, name, changes, every, share))[0]
    assert (first.state, first.severity) == ("raised", "critical")
    assert f"{name} came more often than before" in first.message
    assert first.time_ns - calm_flight[0].received_ns < (START_S + 2.0) * 1e9


@pytest.mark.parametrize(
    ("name", "changes", "every", "limit_s"),
    [
        ("ATTITUDE", {"roll": 0.2}, 500, 0.1),
        ("HIGHRES_IMU", {"xgyro": 0.3}, 500, 0.1),
        ("GPS_RAW_INT", {"lat": 500}, 25, 0.6),
    ],
)
def test_a_forged_value_now_and_then_is_an_impostor(
    bundled_quad: Profile,
    calm_flight: list[Message],
    name: str,
    changes: Mapping[str, float],
    every: int,
    limit_s: float,
) -> None:
    first = impostors(bundled_quad, attacked(calm_flight, name, changes, every, 0.45))[0]
    assert f"{name} came more often than before" in first.message
    assert first.time_ns - calm_flight[0].received_ns < (START_S + limit_s) * 1e9


@pytest.mark.parametrize("stamped_anew", [True, False])
def test_a_recorded_stretch_that_is_sent_again_is_an_impostor(
    bundled_quad: Profile, calm_flight: list[Message], stamped_anew: bool
) -> None:
    behind_s = 15.0

    def again(message: Message) -> Message:
        later = forged(message, behind_s, {})
        return later if stamped_anew else replace(message, received_ns=later.received_ns)

    def gone_s(message: Message) -> float:
        return (message.received_ns - calm_flight[0].received_ns) / 1e9

    recorded = [message for message in calm_flight if gone_s(message) < 20.0]
    told = impostors(bundled_quad, [*recorded, *(again(message) for message in recorded if gone_s(message) > 5.0)])
    first = told[0]
    assert first.severity == "critical"
    assert "sent again" in first.message
    assert all(
        any(f"{name} repeats earlier" in event.message for event in told) for name in ("ATTITUDE", "HIGHRES_IMU")
    )
    assert first.time_ns - calm_flight[0].received_ns < 20.5e9


@pytest.mark.parametrize("names", [("ATTITUDE", "HIGHRES_IMU", "GPS_RAW_INT"), ("ATTITUDE",)])
def test_motors_are_not_accused_beside_measurements_that_are_sent_again_and_the_end_is_known(
    bundled_quad: Profile, calm_flight: list[Message], names: Sequence[str]
) -> None:
    behind_ns, start_ns = 15_000_000_000, calm_flight[0].received_ns + 20_000_000_000
    end_ns = start_ns + 2_000_000_000
    sent: dict[str, list[Message]] = {name: [] for name in names}
    replayed = []
    for message in calm_flight:
        earlier = sent.get(message.name)
        if earlier is None or not start_ns <= message.received_ns < end_ns:
            replayed.append(message)
        else:
            before = next(one for one in earlier if one.received_ns >= message.received_ns - behind_ns)
            stamps = {name: value for name, value in message.fields.items() if name.startswith("time_")}
            replayed.append(replace(message, fields={**before.fields, **stamps}))
        if earlier is not None:
            earlier.append(message)
    events = events_of(bundled_quad, replayed)
    standing: set[str] = set()
    for event in (event for event in events if event.time_ns < end_ns):
        (standing.discard if event.state == "cleared" else standing.add)(event.channel)
        if event.state == "cleared":
            assert event.message == "explained by a second sender"
    assert standing == {"impostor"}
    later = [event for event in events if event.time_ns >= end_ns]
    assert {event.channel for event in later} == {"impostor"}
    over = next(event for event in later if "ATTITUDE repeats" not in event.message)
    assert over.time_ns - end_ns < 2_000_000_000


@pytest.mark.parametrize(
    ("name", "changes", "share"),
    [
        ("ATTITUDE", {"roll": 0.2}, 0.2),
        ("ATTITUDE", {"roll": 0.2}, 0.45),
        ("ATTITUDE", {"roll": 0.2}, 0.5),
        ("HIGHRES_IMU", {"xgyro": 0.3}, 0.45),
        ("SERVO_OUTPUT_RAW", {"servo1_raw": 150}, 0.5),
    ],
)
def test_values_of_two_senders_are_an_impostor_from_the_first_message_on(
    bundled_quad: Profile, calm_flight: list[Message], name: str, changes: Mapping[str, float], share: float
) -> None:
    events = events_of(bundled_quad, attacked(calm_flight[:8000], name, changes, 1, share, 0.0))
    first = next(event for event in events if event.channel == "impostor")
    assert f"{name} came more often than before" in first.message
    assert first.time_ns - calm_flight[0].received_ns < 2_000_000_000
    assert not [event for event in events if event.channel.startswith("gyro")]


def test_sensors_are_not_accused_beside_the_impostor_but_listed_in_its_alarm(
    bundled_quad: Profile, calm_flight: list[Message]
) -> None:
    events = events_of(bundled_quad, attacked(calm_flight, "HIGHRES_IMU", {"xgyro": 0.3}, 1, 0.45))
    assert {event.channel for event in events if event.state == "raised"} == {"impostor"}
    assert any(event.message.endswith("; affected: gyro_x") for event in events if event.channel == "impostor")


def test_a_sensor_that_was_accused_before_the_impostor_was_known_is_cleared(
    bundled_quad: Profile, calm_flight: list[Message]
) -> None:
    events = events_of(bundled_quad, attacked(calm_flight, "GPS_RAW_INT", {"vel": 300}, 3, 0.45))
    (gps,) = (event for event in events if event.channel == "gps_north" and event.state == "cleared")
    assert gps.message == "explained by a second sender"
    told = [event for event in events if event.channel == "impostor"]
    assert "affected: gps_north" in told[1].message


def thinned(calm_flight: list[Message], keep: Callable[[int, float], bool]) -> list[Message]:
    seen: Counter[str] = Counter()
    kept = []
    for message in calm_flight:
        seen[message.name] += 1
        at_s = (message.received_ns - calm_flight[0].received_ns) / 1e9
        if message.name in ("HEARTBEAT", "EXTENDED_SYS_STATE") or keep(seen[message.name], at_s):
            kept.append(message)
    return kept


def delayed(messages: list[Message], most_s: float, rng: random.Random | None = None) -> list[Message]:
    return [
        replace(one, received_ns=one.received_ns + round((rng.random() if rng else 1.0) * most_s * 1e9))
        for one in messages
    ]


CLEAN: Mapping[str, Callable[[list[Message]], list[Message]]] = {
    "a rate that grows five times": lambda calm_flight: thinned(calm_flight, lambda k, at: at > 15 or k % 5 == 0),
    "a rate that changes": lambda calm_flight: thinned(calm_flight, lambda k, at: int(at / 10) % 2 == 1 or k % 2 == 0),
    "two radios, duplicates": lambda calm_flight: in_order([*calm_flight, *delayed(calm_flight, 0.15)]),
    "two radios, each its own": lambda calm_flight: in_order(
        [
            *thinned(calm_flight, lambda k, _: k % 2 == 0),
            *delayed(thinned(calm_flight, lambda k, at: k % 2 > 0 and at > 15), 0.1),
        ]
    ),
    "jitter": lambda calm_flight: in_order(delayed(calm_flight, 0.2, random.Random(1))),
    "loss": lambda calm_flight: [one for rng in [random.Random(2)] for one in calm_flight if rng.random() > 0.5],
    "bursts of a second": lambda calm_flight: [
        one for one in calm_flight if random.Random(one.received_ns // 1_000_000_000).random() > 0.2
    ],
}


@pytest.mark.parametrize("link", CLEAN)
def test_links_that_change_lose_or_bring_twice_are_none(
    bundled_quad: Profile, calm_flight: list[Message], link: str
) -> None:
    assert impostors(bundled_quad, CLEAN[link](calm_flight)) == []


def test_one_row_that_contradicts_is_counted_once_however_many_come_late_behind_it(
    bundled_quad: Profile, calm_flight: list[Message]
) -> None:
    own = [message for message in calm_flight if message.name == "HIGHRES_IMU"]
    jolt = forged(own[1500], 0.005, {"xgyro": 0.3})
    late = {id(message): own[1502].received_ns + 1000 * k for k, message in enumerate(own[1486:1498])}
    held = [replace(one, received_ns=late.get(id(one), one.received_ns)) for one in calm_flight]
    assert impostors(bundled_quad, in_order([*held, jolt])) == []
