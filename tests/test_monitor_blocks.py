"""A vehicle's pipeline fed with blocks says what it says message by message, to the last bit."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adapters.logs.recordings import packed, read_recording
from adapters.message import Message, silence
from adapters.simulation.arm import SCENARIOS, simulate_arm
from adapters.simulation.arm_source import arm_messages
from adapters.source import MAVLINK, OPERATOR, ZENOH
from monitor.alarms.desk_rule import DeskRule
from monitor.estimate import Estimate, Estimates
from monitor.event import AlarmEvent
from monitor.pipeline import Pipeline, rules_message
from monitor.profile import Profile, read_profile

QUAD = Path("replay/data/quad")
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
)


def one_by_one(profile: Profile, messages: Iterable[Message]) -> tuple[list[Estimate], list[AlarmEvent], Pipeline]:
    pipeline = Pipeline(profile)
    outputs = [output for message in messages for output in pipeline.feed(message)]
    estimates = [output for output in outputs if isinstance(output, Estimate)]
    return estimates, [output for output in outputs if isinstance(output, AlarmEvent)], pipeline


def in_blocks(
    profile: Profile, messages: Sequence[Message], cuts: Sequence[int] = (), mixed: bool = False
) -> tuple[list[Estimates], list[AlarmEvent], Pipeline]:
    pipeline = Pipeline(profile)
    estimates: list[Estimates] = []
    events: list[AlarmEvent] = []
    edges = [0, *sorted(min(cut_at, len(messages)) for cut_at in cuts), len(messages)]
    for number, (a, b) in enumerate(pairwise(edges)):
        if mixed and number % 3 == 2:
            for message in messages[a : min(a + 300, b)]:
                for output in pipeline.run(next(packed([message]))):
                    (estimates if isinstance(output, Estimates) else events).append(output)  # type: ignore[attr-defined]
            a = min(a + 300, b)  # noqa: PLW2901
        for block in packed(messages[a:b]):
            for output in pipeline.run(block):
                (estimates if isinstance(output, Estimates) else events).append(output)  # type: ignore[attr-defined]
    return estimates, events, pipeline


def assert_same(plain: tuple[list[Estimate], list[AlarmEvent], Pipeline], found: object, profile: Profile) -> None:
    estimates, events, pipeline = found  # type: ignore[misc]
    assert [repr(event) for event in events] == [repr(event) for event in plain[1]]
    for observer in profile.observers:
        one = [estimate for estimate in plain[0] if estimate.observer == observer.name]
        many = [stretch for stretch in estimates if stretch.observer == observer.name]
        assert sum(len(stretch) for stretch in many) == len(one)
        if not one:
            continue
        for name in ("index", "vehicle_time_ns", "time_ns", "known_ns", "restart", "complete", "measured", "u", "y"):
            same(name, [getattr(e.sample, name) for e in one], [getattr(s.samples, name) for s in many])
        for name in ("x", "fault", "isolated", "residual", "armed", "sd", "coasted_s"):
            same(name, [getattr(e, name) for e in one], [getattr(s, name) for s in many])
    assert pipeline.statistics() == plain[2].statistics()
    assert pipeline.foreign == plain[2].foreign
    assert pipeline.metadata() == plain[2].metadata()


def same(name: str, one: list[object], many: list[np.ndarray]) -> None:
    expected, found = np.array(one), np.concatenate(many)
    assert expected.shape == found.shape, name
    differs = np.flatnonzero((expected != found) & ~((np.isnan(expected)) & (np.isnan(found))))
    assert not differs.size, f"{name} differs first at {differs[0]} of {found.size}"


@pytest.fixture(scope="module")
def quad() -> Profile:
    return read_profile(QUAD)


@pytest.mark.parametrize("distortion", DISTORTIONS, ids=lambda one: one.__name__)
def test_blocks_give_the_bits_of_single_messages_on_a_distorted_flight(
    quad: Profile, data: Path, distortion: Distortion
) -> None:
    messages = distortion(list(read_recording(data / "copter_motor2_080.tlog.xz")), random.Random(1))
    assert_same(one_by_one(quad, messages), in_blocks(quad, messages), quad)


@pytest.mark.parametrize("name", ["copter_gyro1_bias", "copter_gps_step25m", "copter_wind_step", "copter_baro_glitch"])
def test_blocks_give_the_bits_of_single_messages_on_other_faults(quad_profile: Profile, data: Path, name: str) -> None:
    messages = list(read_recording(data / f"{name}.tlog.xz"))
    plain = one_by_one(quad_profile, messages)
    assert_same(plain, in_blocks(quad_profile, messages), quad_profile)


@settings(max_examples=6)
@given(cuts=st.lists(st.integers(0, 12_000), max_size=6), seed=st.integers(0, 9), which=st.integers(0, 9))
def test_it_does_not_matter_where_blocks_end(cuts: list[int], seed: int, which: int) -> None:
    profile = read_profile(QUAD)
    messages = list(read_recording(Path("tests/data/copter_5s.tlog.xz")))
    messages = DISTORTIONS[which](messages, random.Random(seed))
    assert_same(one_by_one(profile, messages), in_blocks(profile, messages, cuts, mixed=True), profile)


def test_blocks_give_the_bits_of_single_messages_on_the_arm(arm_profile: Profile) -> None:
    messages = list(arm_messages(simulate_arm(SCENARIOS["case2"], 45.0, 100.0), 10**18))
    assert_same(one_by_one(arm_profile, messages), in_blocks(arm_profile, messages), arm_profile)


def test_messages_of_strangers_are_counted_whether_they_are_columns_or_not(quad: Profile, data: Path) -> None:
    messages = list(read_recording(data / "copter_5s.tlog.xz"))
    for place in (600, 400):
        messages.insert(place, Message(MAVLINK, "STATUSTEXT", messages[place].received_ns, {"text": "x"}, 9, 1))
        messages.insert(place, Message(MAVLINK, "ATTITUDE", messages[place].received_ns, {"roll": "x"}, 9, 1))
    plain = one_by_one(quad, messages)
    assert plain[2].foreign >= 4
    assert_same(plain, in_blocks(quad, messages), quad)
