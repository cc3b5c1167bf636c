"""A flying vehicle without evidence raises ``monitor/blind``; one on the ground, or without a sensor, does not."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from adapters.logs.recordings import packed, read_recording
from adapters.message import Message, silence
from monitor.blind import LIMIT_NS, EvidenceFlow
from monitor.event import AlarmEvent
from monitor.pipeline import Pipeline, handover_message
from monitor.profile import Profile
from monitor.sampling.transform import LiftRule
from replay.player import play


@pytest.fixture(scope="module")
def flight(data: Path) -> list[Message]:
    """Return 30 s of a healthy flight with all sensors."""
    messages = list(read_recording(data / "copter_healthy_square.tlog.xz"))
    return [message for message in messages if message.received_ns - messages[0].received_ns < 30_000_000_000]


def events_of(profile: Profile, messages: Sequence[Message], pipeline: Pipeline | None = None) -> list[AlarmEvent]:
    pipeline = pipeline or Pipeline(profile)
    outputs = [output for batch in packed(messages) for output in pipeline.run(batch)]
    return [event for event in outputs if isinstance(event, AlarmEvent)]


def blind_of(profile: Profile, messages: Sequence[Message]) -> list[AlarmEvent]:
    return [event for event in events_of(profile, messages) if event.kind == "blind"]


def without(messages: Sequence[Message], names: Sequence[str], start_s: float, stop_s: float = 1e9) -> list[Message]:
    first_ns = messages[0].received_ns

    def lost(message: Message) -> bool:
        return message.name in names and start_s <= (message.received_ns - first_ns) / 1e9 < stop_s

    return [message for message in messages if not lost(message)]


def test_a_healthy_flight_is_watched_and_says_so(quad_profile: Profile, flight: list[Message]) -> None:
    pipeline = Pipeline(quad_profile)
    assert events_of(quad_profile, flight, pipeline) == []
    for watching in pipeline.watching(flight[-1].received_ns).values():
        assert watching.share > 0.8
        assert watching.why_not is None
        assert watching.age_s(flight[-1].received_ns) is not None
    assert pipeline.blind is None


def test_a_gps_that_stops_is_named_within_seconds_and_clears_when_it_is_back(
    quad_profile: Profile, flight: list[Message]
) -> None:
    raised, cleared = blind_of(quad_profile, without(flight, ["GPS_RAW_INT"], 10.0, 20.0))
    assert (raised.observer, raised.channel, raised.state, raised.severity) == ("monitor", "blind", "raised", "warning")
    assert raised.message == "the vehicle flies and is not watched: inertial: no GPS for 5 s"
    assert 4.5 <= (raised.time_ns - flight[0].received_ns) / 1e9 - 10.0 <= 7.5
    assert cleared.state == "cleared"
    assert 20.0 <= (cleared.time_ns - flight[0].received_ns) / 1e9 <= 27.0


def frozen_measurements(messages: Sequence[Message], *spans_s: tuple[float, float]) -> list[Message]:
    """Return messages of which IMU, attitude and GPS repeat their values between these times."""
    latest, frozen = {}, []
    for message in messages:
        if message.name not in ("ATTITUDE", "HIGHRES_IMU", "GPS_RAW_INT"):
            frozen.append(message)
            continue
        time_s = (message.received_ns - messages[0].received_ns) / 1e9
        if not any(start <= time_s < stop for start, stop in spans_s):
            latest[message.name] = message.fields
        stamps = {name: value for name, value in message.fields.items() if name.startswith("time_")}
        frozen.append(replace(message, fields={**latest[message.name], **stamps}))
    return frozen


def test_measurements_that_froze_and_go_on_clear_within_two_seconds(
    quad_profile: Profile, flight: list[Message]
) -> None:
    raised, *updates, cleared = blind_of(quad_profile, frozen_measurements(flight, (12.0, 20.0)))
    assert raised.state == "raised"
    assert {event.state for event in updates} <= {"updated"}
    assert (cleared.state, cleared.message) == (
        "cleared",
        "the vehicle is watched again, as soon as estimates settle (5 s)",
    )
    assert 20.0 <= (cleared.time_ns - flight[0].received_ns) / 1e9 <= 22.0


def test_estimates_that_begin_anew_just_before_the_limit_are_awaited(
    quad_profile: Profile, flight: list[Message]
) -> None:
    measured = ["ATTITUDE", "HIGHRES_IMU", "GPS_RAW_INT"]
    gap = without(flight, measured, 15.0, 17.5)
    assert blind_of(quad_profile, gap) == []
    raised, *_ = blind_of(quad_profile, without(gap, measured, 17.6))
    assert raised.state == "raised"
    assert raised.time_ns - flight[0].received_ns < 26_000_000_000


def test_a_vehicle_whose_estimates_settle_in_vain_is_blind_again_until_there_is_evidence(
    quad_profile: Profile, flight: list[Message]
) -> None:
    messages = frozen_measurements(flight, (12.0, 18.0))
    for start_s in (20.0, 24.0, 28.0):
        messages = without(messages, ["ATTITUDE", "HIGHRES_IMU", "GPS_RAW_INT"], start_s, start_s + 2.0)
    states = [event.state for event in blind_of(quad_profile, messages)]
    assert [state for state in states if state != "updated"] == ["raised", "cleared", "raised"]


def test_alarms_raised_since_the_measurements_froze_end_under_the_alarm_that_says_so(
    quad_profile: Profile, flight: list[Message]
) -> None:
    events = events_of(quad_profile, frozen_measurements(flight, (20.0, 1e9)))
    assert {event.observer for event in events if event.state == "raised"} == {"inertial", "monitor"}
    assert events[-1].channel == "blind"
    gps = [event.channel for event in events if event.message == "explained by frozen telemetry"]
    assert gps
    assert events[-1].message.endswith(f"; affected: {', '.join(gps)}")


def test_a_gps_that_goes_on_without_a_fix_is_lost(quad_profile: Profile, flight: list[Message]) -> None:
    observers = [
        replace(
            one,
            source=replace(
                one.source,
                signals=tuple(
                    replace(channel, at_least=(("fix_type", 2.0),)) if channel.message == "GPS_RAW_INT" else channel
                    for channel in one.source.signals
                ),
            ),
        )
        for one in quad_profile.observers
    ]
    profile = replace(quad_profile, observers=tuple(observers))
    assert blind_of(profile, flight) == []
    raised, cleared = blind_of(profile, gps_says(flight, fix_type=1))
    assert "inertial: no GPS for 5 s" in raised.message
    assert cleared.state == "cleared"


def test_a_gps_that_does_not_know_its_speed_is_lost_and_accused_of_nothing(
    quad_profile: Profile, flight: list[Message]
) -> None:
    unknown = gps_says(flight, vel=65_535)
    events = [event for event in play(quad_profile, unknown).events if event.state == "raised"]
    assert [event.message for event in events] == ["the vehicle flies and is not watched: inertial: no GPS for 5 s"]


def gps_says(flight: list[Message], **fields: int) -> list[Message]:
    """Return the flight with these values in what its GPS says from 10 to 20 s."""
    kept = {id(m) for m in without(flight, ["GPS_RAW_INT"], 10.0, 20.0)}
    return [m if id(m) in kept else replace(m, fields={**m.fields, **fields}) for m in flight]


def test_motors_of_a_vehicle_on_its_wings_are_not_watched_and_its_sensors_are(
    quad_profile: Profile, flight: list[Message]
) -> None:
    lift = LiftRule("rotors", 0.1)
    observers = (
        one if one.source.transform else replace(one, source=replace(one.source, lift=lift))
        for one in quad_profile.observers
    )
    profile = replace(quad_profile, observers=tuple(observers))
    first_ns = flight[0].received_ns
    states = [
        replace(m, fields={**m.fields, "vtol_state": 4 if 10.0 <= (m.received_ns - first_ns) / 1e9 < 20.0 else 3})
        if m.name == "EXTENDED_SYS_STATE"
        else m
        for m in flight
    ]
    raised, *_, cleared = events_of(profile, states)
    assert raised.message == (
        "the vehicle flies and is not watched: motors: flight not carried by its rotors alone for 5 s"
    )
    assert (raised.channel, raised.severity, cleared.state) == ("blind", "warning", "cleared")
    assert 20.0 <= (cleared.time_ns - first_ns) / 1e9 <= 27.0


def test_a_message_that_never_came_is_no_loss(quad_profile: Profile, flight: list[Message]) -> None:
    assert blind_of(quad_profile, without(flight, ["GPS_RAW_INT"], 0.0)) == []


def test_it_is_critical_where_nothing_is_watched(quad_profile: Profile, flight: list[Message]) -> None:
    first, *more = blind_of(quad_profile, without(flight, ["ATTITUDE"], 10.0))
    assert "no ATTITUDE for 5 s" in first.message
    assert {event.severity for event in (first, *more)} >= {"critical"}


@pytest.mark.parametrize(
    ("name", "fields"), [("HEARTBEAT", {"base_mode": 81}), ("EXTENDED_SYS_STATE", {"landed_state": 1})]
)
def test_on_the_ground_nothing_is_expected(
    quad_profile: Profile, flight: list[Message], name: str, fields: dict[str, int]
) -> None:
    # who says that it is disarmed, and is in the air or runs its motors, contradicts itself
    told = [message for message in flight if message.name == name or message.name != "EXTENDED_SYS_STATE"]
    said = {name: fields, "SERVO_OUTPUT_RAW": {f"servo{k}_raw": 1000 for k in (1, 2, 3, 4)}}
    grounded = [replace(message, fields={**message.fields, **said.get(message.name, {})}) for message in told]
    pipeline = Pipeline(quad_profile)
    assert events_of(quad_profile, grounded, pipeline) == []
    assert {one.why_not for one in pipeline.watching(flight[-1].received_ns).values()} == {"on_ground"}


def test_before_any_telemetry_nothing_is_expected(quad_profile: Profile, flight: list[Message]) -> None:
    first_ns = flight[0].received_ns
    waiting = [silence(first_ns - second * 1_000_000_000) for second in range(60, 0, -1)]
    assert events_of(quad_profile, [*waiting, *flight]) == []


def test_an_adopted_alarm_stays_until_there_is_evidence(quad_profile: Profile, flight: list[Message]) -> None:
    adopted = blind_of(quad_profile, without(flight, ["GPS_RAW_INT"], 10.0))[0]
    start = next(place for place, m in enumerate(flight) if m.received_ns > adopted.time_ns + LIMIT_NS)
    message = handover_message([adopted], adopted.seq, flight[start].received_ns)
    events = events_of(quad_profile, [message, *flight[start:]])
    assert [event.state for event in events] == ["updated", "cleared"]
    assert events[-1].time_ns - flight[start].received_ns > 1_000_000_000


def test_a_replay_says_how_long_what_was_not_watched(quad_profile: Profile, flight: list[Message]) -> None:
    replay = play(quad_profile, without(flight, ["GPS_RAW_INT"], 10.0))
    [(why, seconds)] = replay.unwatched(flight[-1].received_ns)
    assert "no GPS for 5 s" in why
    assert 10.0 < seconds < 16.0
    assert play(quad_profile, flight).unwatched(flight[-1].received_ns) == []


@pytest.mark.parametrize(("rate_hz", "granted_s"), [(0.5, 12.0), (100.0, 6.0)])
def test_an_observer_so_slow_that_it_has_no_sample_yet_is_waited_for(rate_hz: float, granted_s: float) -> None:
    channel = SimpleNamespace(name="vibration", message="VIBRATION")
    chain: Any = SimpleNamespace(
        layout=SimpleNamespace(observer="vibration", outputs=("vibration",), inputs=(), rate_hz=rate_hz),
        sampler=SimpleNamespace(interests={"VIBRATION"}),
        source=SimpleNamespace(channels=[channel]),
        settle_s=1.0,
    )
    flow = EvidenceFlow(chain)
    flow.receive("VIBRATION", 2**60, 2**60)
    assert flow.awaits(2**60 + round(1e9 * granted_s) - 1)
    assert not flow.awaits(2**60 + round(1e9 * granted_s))
    flow.wait_from(2**60 + 10**9)  # after a gap, as long again
    assert flow.awaits(2**60 + 10**9 + round(1e9 * granted_s) - 1)


def told_the_time(profile: Profile, kept: Sequence[Message], step_ns: Callable[[], int]) -> list[AlarmEvent]:
    """Return the events of messages between which time passes; those are the same without what caused no event."""
    pipeline, waiting = Pipeline(profile), list[Message]()
    recorded, events = list[Message](), list[AlarmEvent]()
    for before, message in pairwise(kept):
        waiting.append(before)
        for now_ns in range(before.received_ns + 10**8, message.received_ns - 10**7, step_ns()):
            events += events_of(profile, waiting, pipeline)
            recorded += waiting
            waiting = []
            if caused := events_of(profile, [silence(now_ns)], pipeline):
                events += caused
                recorded.append(silence(now_ns))
    events += events_of(profile, waiting, pipeline)
    assert events_of(profile, [*recorded, *waiting]) == events
    return events


def test_time_that_passes_as_estimates_settle_leaves_no_trace(bundled_quad: Profile, flight: list[Message]) -> None:
    """The motors, which begin anew 3.5 s after their last evidence, have settled when messages come again."""
    kept = without(flight, ["ATTITUDE", "HIGHRES_IMU", "GPS_RAW_INT"], 15.0, 18.5)
    names = list({message.name for message in flight})
    assert told_the_time(bundled_quad, without(kept, names, 19.5, 21.4), lambda: 4 * 10**7)


@pytest.mark.parametrize("seed", [5, 7])
def test_passing_time_that_causes_no_event_leaves_no_trace(
    bundled_quad: Profile, flight: list[Message], seed: int
) -> None:
    profile, rng, start_ns = bundled_quad, random.Random(seed), flight[0].received_ns
    names = "GPS_RAW_INT", "ATTITUDE", "HIGHRES_IMU", "SERVO_OUTPUT_RAW"
    share, period_s = rng.choice([0.5, 0.7, 0.8, 0.9]), rng.choice([0.4, 0.5, 1.0, 1.5])
    kept = [m for m in flight if (s := (m.received_ns - start_ns) / 1e9) < 9.0 or s % period_s >= share * period_s]
    for name in names:
        kept = without(kept, [name], begin_s := rng.uniform(9.0, 18.0), begin_s + rng.uniform(2.0, 8.0))
    events = told_the_time(profile, kept, lambda: rng.randint(2, 6) * 10**7)
    assert "blind" in [event.channel for event in events]


@pytest.mark.parametrize(("names", "share", "period_s"), [((), 0.9, 1.0), (("HIGHRES_IMU",), 0.8, 0.5)])
def test_a_link_that_loses_nearly_all_is_blind_after_five_seconds(
    bundled_quad: Profile, flight: list[Message], names: tuple[str, ...], share: float, period_s: float
) -> None:
    start_ns = flight[0].received_ns + 15 * 10**9

    def lost(message: Message) -> bool:
        since_s = (message.received_ns - start_ns) / 1e9
        return (not names or message.name in names) and since_s >= 0.0 and since_s % period_s < share * period_s

    first = blind_of(bundled_quad, [message for message in flight if not lost(message)])[0]
    # the first stretch that comes after a loss may still be evidence
    assert 4.5 < (first.time_ns - start_ns) / 1e9 < 6.0
