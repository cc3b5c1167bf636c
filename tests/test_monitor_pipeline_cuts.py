"""What a vehicle's pipeline finds does not depend on how the stream is cut into batches, to the last bit."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import accumulate, pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adapters.logs.recordings import packed, read_recording
from adapters.message import Message, silence
from adapters.simulation.arm import SCENARIOS, simulate_arm
from adapters.simulation.arm_source import arm_messages
from adapters.source import MAVLINK, OPERATOR, ZENOH
from monitor.alarms.desk import DeskRule
from monitor.estimate import Estimates
from monitor.event import AlarmEvent
from monitor.pipeline import Pipeline, rules_message
from monitor.profile import Profile, read_profile

QUAD = Path("replay/data/quad")


class Outcome(NamedTuple):
    estimates: list[Estimates]
    events: list[AlarmEvent]
    pipeline: Pipeline


Distortion = Callable[[list[Message], random.Random], list[Message]]


def as_they_come(messages: list[Message], rng: random.Random) -> list[Message]:
    del rng
    return messages


def lossy(messages: list[Message], rng: random.Random) -> list[Message]:
    return [message for message in messages if rng.random() > 0.1]


def twice(messages: list[Message], rng: random.Random) -> list[Message]:
    return [message for message in messages for _ in range(1 + (rng.random() < 0.2))]


def out_of_order(messages: list[Message], rng: random.Random) -> list[Message]:
    order = sorted(range(len(messages)), key=lambda i: i + 5 * rng.random())
    return [replace(messages[i], received_ns=messages[j].received_ns) for j, i in enumerate(order)]


def with_silence(messages: list[Message], rng: random.Random) -> list[Message]:
    at = rng.randrange(len(messages))
    start_ns = messages[at].received_ns
    kept = [m for m in messages if not start_ns <= m.received_ns < start_ns + 4_000_000_000]
    return sorted([*kept, silence(start_ns + 3_000_000_000)], key=lambda message: message.received_ns)


def with_poison(messages: list[Message], rng: random.Random) -> list[Message]:
    found = []
    for message in messages:
        if message.name == "ATTITUDE" and rng.random() < 0.01:
            bad = rng.choice([float("nan"), float("inf"), 1e30])
            message = replace(message, fields={**message.fields, "rollspeed": bad})  # noqa: PLW2901
        found.append(message)
    return found


def rebooted(messages: list[Message], rng: random.Random) -> list[Message]:
    at = rng.randrange(len(messages) // 4, len(messages))
    boot_ms = max(m.fields.get("time_boot_ms", 0) for m in messages[:at])

    def back(message: Message) -> Message:
        fields = dict(message.fields)
        for name, unit in (("time_boot_ms", 1), ("time_usec", 1000)):
            if name in fields:
                fields[name] = max(fields[name] - boot_ms * unit, 0)
        return replace(message, fields=fields)

    return messages[:at] + [back(message) for message in messages[at:]]


def with_operators(messages: list[Message], rng: random.Random) -> list[Message]:
    del rng
    names = ("ack", "shelve", "unshelve", "reset", "shelve")
    found = list(messages)
    for number, name in enumerate(names):
        place = len(messages) * (number + 3) // 9
        now_ns = messages[place].received_ns
        until_ns = now_ns + 2_000_000_000
        fields = {"channel": "motors/motor2", "until_ns": until_ns, "by": "somebody"}
        found.insert(place + number, Message(OPERATOR, name, now_ns, fields))
    return found


def with_floods(messages: list[Message], rng: random.Random) -> list[Message]:
    del rng
    rule = DeskRule(flood_raised=1, flood_s=2.0, latched=frozenset({"motors/motor2"}))
    return [rules_message(rule, read_profile(QUAD), messages[0].received_ns), *messages]


def over_zenoh(messages: list[Message], rng: random.Random) -> list[Message]:
    del rng
    return [replace(message, source=ZENOH, system=0, component=0) for message in messages]


def with_forgeries(messages: list[Message], rng: random.Random) -> list[Message]:
    first_ns, found = messages[0].received_ns, list(messages)
    for at_s in (0.5, 1.1, 1.4, 2.0, 2.2, 2.9, 3.3, 3.6):
        fields = {"type": 2, "autopilot": 3, "base_mode": 81}
        forged = Message(MAVLINK, "HEARTBEAT", first_ns + round((at_s + 0.2 * rng.random()) * 1e9), fields, 1, 1)
        found.append(forged)
    return sorted(found, key=lambda message: message.received_ns)


def with_two_clocks(messages: list[Message], rng: random.Random) -> list[Message]:
    found = []
    for message in messages:
        found.append(message)
        if message.name == "ATTITUDE" and rng.random() < 0.02:
            stamp = message.fields["time_boot_ms"] + 3_600_000
            found.append(replace(message, fields={**message.fields, "time_boot_ms": stamp}))
    return found


def with_commanders(messages: list[Message], rng: random.Random) -> list[Message]:
    """Let others steer the vehicle, by streams and by single commands, to this vehicle, to others and to all."""
    first_ns, last_ns = messages[0].received_ns, messages[-1].received_ns
    names = ("RC_CHANNELS_OVERRIDE", "SET_ATTITUDE_TARGET", "SET_MODE", "MISSION_CLEAR_ALL")
    sent = []
    for _ in range(400):
        sender, target = rng.choice(((66, 1), (67, 2), (255, 0)))
        fields, at_ns = {"target_system": target, "target_component": 1}, rng.randrange(first_ns, last_ns)
        sent.append(Message(MAVLINK, rng.choice(names), at_ns, fields, sender, 1))
    return sorted([*messages, *sent], key=lambda message: message.received_ns)


DISTORTIONS: tuple[Distortion, ...] = (
    as_they_come,
    lossy,
    twice,
    out_of_order,
    with_silence,
    with_poison,
    rebooted,
    with_operators,
    with_floods,
    over_zenoh,
    with_forgeries,
    with_commanders,
    with_two_clocks,
)


def in_batches(profile: Profile, messages: Sequence[Message], cuts: Sequence[int] = ()) -> Outcome:
    """Return what a pipeline makes of messages in batches that end at these places."""
    pipeline = Pipeline(profile)
    outputs: list[Estimates | AlarmEvent] = []
    for a, b in pairwise([0, *sorted(min(cut_at, len(messages)) for cut_at in cuts), len(messages)]):
        for batch in packed(messages[a:b]):
            outputs += pipeline.run(batch)
    estimates = [output for output in outputs if isinstance(output, Estimates)]
    return Outcome(estimates, [output for output in outputs if isinstance(output, AlarmEvent)], pipeline)


def assert_same(one: Outcome, other: Outcome, profile: Profile) -> None:
    assert [repr(event) for event in other.events] == [repr(event) for event in one.events]
    for observer in profile.observers:
        pair = [[part for part in way.estimates if part.observer == observer.name] for way in (one, other)]
        assert sum(map(len, pair[0])) == sum(map(len, pair[1]))
        if not pair[0]:
            continue
        for name in ("index", "vehicle_time_ns", "time_ns", "known_ns", "restart", "complete", "measured", "u", "y"):
            same(name, *([getattr(part.samples, name) for part in parts] for parts in pair))
        for name in ("x", "fault", "isolated", "residual", "armed", "sd", "coasted_s"):
            same(name, *([getattr(part, name) for part in parts] for parts in pair))
    assert one.pipeline.statistics() == other.pipeline.statistics()
    assert one.pipeline.foreign == other.pipeline.foreign
    assert one.pipeline.metadata() == other.pipeline.metadata()


def same(name: str, one: list[np.ndarray], other: list[np.ndarray]) -> None:
    expected, found = np.concatenate(one), np.concatenate(other)
    assert expected.shape == found.shape, name
    differs = np.flatnonzero((expected != found) & ~((np.isnan(expected)) & (np.isnan(found))))
    assert not differs.size, f"{name} differs first at {differs[0]} of {found.size}"


@pytest.mark.parametrize("distortion", DISTORTIONS, ids=lambda one: one.__name__)
def test_single_messages_give_the_bits_of_one_large_batch_on_a_distorted_flight(
    bundled_quad: Profile, data: Path, distortion: Distortion
) -> None:
    messages = distortion(list(read_recording(data / "copter_5s.tlog.xz")), random.Random(1))
    singly = in_batches(bundled_quad, messages, range(len(messages) // 2, len(messages)))
    assert_same(singly, in_batches(bundled_quad, messages), bundled_quad)


@pytest.mark.parametrize("name", ["copter_motor2_080", "copter_gyro1_bias"])
def test_batches_as_a_daemon_collects_them_give_the_bits_of_large_ones(
    quad_profile: Profile, data: Path, name: str
) -> None:
    messages = list(read_recording(data / f"{name}.tlog.xz"))
    rng = random.Random(2)
    cuts = list(accumulate(rng.choice((1, 5, 10, 11, 40)) for _ in range(len(messages) // 10)))
    assert_same(in_batches(quad_profile, messages, cuts), in_batches(quad_profile, messages), quad_profile)


@settings(max_examples=4)
@given(
    cuts=st.lists(st.integers(0, 12_000), max_size=6), seed=st.integers(0, 9), distortion=st.sampled_from(DISTORTIONS)
)
def test_it_does_not_matter_where_batches_end(
    bundled_quad: Profile, data: Path, cuts: list[int], seed: int, distortion: Distortion
) -> None:
    messages = distortion(list(read_recording(data / "copter_5s.tlog.xz")), random.Random(seed))
    assert_same(in_batches(bundled_quad, messages, cuts), in_batches(bundled_quad, messages), bundled_quad)


def test_cuts_do_not_matter_while_a_vehicle_is_not_watched(quad_profile: Profile, data: Path) -> None:
    messages = list(read_recording(data / "copter_healthy_square.tlog.xz"))
    first_ns = messages[0].received_ns
    messages = [m for m in messages if m.received_ns - first_ns < 30_000_000_000]
    lost = [m for m in messages if m.name != "GPS_RAW_INT" or not 5 <= (m.received_ns - first_ns) / 1e9 < 22]
    lost = [m for m in lost if m.name != "ATTITUDE" or not 12 <= (m.received_ns - first_ns) / 1e9 < 19]
    whole = in_batches(quad_profile, lost)
    assert {event.kind for event in whole.events} == {"blind"}
    rng = random.Random(3)
    cuts = list(accumulate(rng.choice((1, 5, 10, 11, 40, 900)) for _ in range(len(lost) // 60)))
    assert_same(in_batches(quad_profile, lost, cuts), whole, quad_profile)


def test_cuts_do_not_matter_for_the_arm(arm_profile: Profile) -> None:
    messages = list(arm_messages(simulate_arm(SCENARIOS["case2"], 10.0, 100.0), 10**18))
    assert_same(in_batches(arm_profile, messages, range(0, 2000, 3)), in_batches(arm_profile, messages), arm_profile)


def test_messages_of_strangers_are_counted_whether_they_are_columns_or_not(bundled_quad: Profile, data: Path) -> None:
    messages = list(read_recording(data / "copter_5s.tlog.xz"))
    for place in (600, 400):
        messages.insert(place, Message(MAVLINK, "STATUSTEXT", messages[place].received_ns, {"text": "x"}, 9, 1))
        messages.insert(place, Message(MAVLINK, "ATTITUDE", messages[place].received_ns, {"roll": "x"}, 9, 1))
    whole = in_batches(bundled_quad, messages)
    assert whole.pipeline.foreign >= 4
    assert_same(in_batches(bundled_quad, messages, [300, 500, 601]), whole, bundled_quad)
