"""The pipeline: one vehicle out of many senders, evidence only in flight, no clock but the messages."""

import dataclasses
import itertools
from collections.abc import Iterator
from pathlib import Path

import pytest

from adapters.message import Message, silence
from adapters.phase import FlightPhase
from adapters.recordings import read_recording
from monitor.chain import Output
from monitor.estimate import Estimate
from monitor.event import AlarmEvent
from monitor.pipeline import Pipeline
from monitor.profile import Profile


@pytest.fixture(scope="module")
def flight(data: Path) -> list[Message]:
    return list(read_recording(data / "copter_motor2_080.tlog.xz"))


def outputs(profile: Profile, messages: Iterator[Message] | list[Message]) -> list[Output]:
    pipeline = Pipeline(profile)
    return [output for message in messages for output in pipeline.feed(message)]


def events(profile: Profile, messages: Iterator[Message] | list[Message]) -> list[AlarmEvent]:
    return [output for output in outputs(profile, messages) if isinstance(output, AlarmEvent)]


def test_other_stations_change_nothing(quad_profile: Profile, flight: list[Message]) -> None:
    expected = events(quad_profile, flight)

    def crowded() -> Iterator[Message]:
        for message in flight:
            yield message
            yield dataclasses.replace(message, system=255)
            yield dataclasses.replace(message, system=7)

    assert expected
    assert events(quad_profile, crowded()) == expected


def test_messages_of_no_interest_change_nothing(quad_profile: Profile, flight: list[Message]) -> None:
    interests = Pipeline(quad_profile).interests
    noise = Message("mavlink", "STATUSTEXT", flight[0].received_ns, {"text": "hello"}, 1, 1)
    with_noise = [item for message in flight for item in (message, noise)]
    wanted = [message for message in with_noise if message.name in interests]
    assert events(quad_profile, with_noise) == events(quad_profile, wanted) == events(quad_profile, flight)


@pytest.mark.parametrize(
    ("name", "field", "value"), [("EXTENDED_SYS_STATE", "landed_state", 4), ("HEARTBEAT", "base_mode", 0)]
)
def test_nothing_is_raised_while_landing_or_disarmed(
    quad_profile: Profile, flight: list[Message], name: str, field: str, value: int
) -> None:
    first = next(message for message in flight if message.name == name)
    changed = dataclasses.replace(first, fields={**first.fields, field: value})
    masked = [
        changed,
        *(
            dataclasses.replace(message, fields=changed.fields) if message.name == name else message
            for message in flight
        ),
    ]
    found = outputs(quad_profile, masked)
    assert [output for output in found if isinstance(output, AlarmEvent)] == []
    assert not any(output.armed for output in found if isinstance(output, Estimate))


def test_a_vehicle_that_reports_no_phase_is_watched_by_its_commands(
    quad_profile: Profile, flight: list[Message]
) -> None:
    silent = [message for message in flight if message.name not in FlightPhase.interests]
    assert [event.channel for event in events(quad_profile, silent)][:1] == ["motor2"]


def test_a_gap_restarts_the_observer_without_a_false_alarm(quad_profile: Profile, data: Path) -> None:
    healthy = list(read_recording(data / "copter_wind_step.tlog.xz"))
    start = healthy[0].received_ns
    cut = [m for m in healthy if not 5e9 < m.received_ns - start < 8e9]
    found = outputs(quad_profile, cut)
    restarts = [output.sample for output in found if isinstance(output, Estimate) and output.sample.restart]
    assert len(restarts) == 2  # of the motors; the inertial observer waits for a GPS, which this log lacks
    stale = [output for output in found if isinstance(output, AlarmEvent)]
    assert [(event.channel, event.state) for event in stale] == [("telemetry", "raised"), ("telemetry", "cleared")]


def test_silence_live_and_a_gap_replayed_give_the_same_events(quad_profile: Profile, data: Path) -> None:
    healthy = list(read_recording(data / "copter_wind_step.tlog.xz"))
    start = healthy[0].received_ns
    cut = [m for m in healthy if not 5e9 < m.received_ns - start < 8e9]

    def live() -> Iterator[Message]:
        for before, after in itertools.pairwise(cut):
            yield before
            for now_ns in range(before.received_ns + 100_000_000, after.received_ns, 100_000_000):
                yield silence(now_ns)
        yield cut[-1]

    assert events(quad_profile, live()) == events(quad_profile, cut)


def test_time_of_arrival_moves_unix_times_and_nothing_else(quad_profile: Profile, flight: list[Message]) -> None:
    shifted = [dataclasses.replace(message, received_ns=message.received_ns + 10**15) for message in flight]
    for before, after in zip(events(quad_profile, flight), events(quad_profile, shifted), strict=True):
        assert after.vehicle_time_ms == before.vehicle_time_ms
        assert after.estimate == before.estimate
        assert after.time_ns - before.time_ns == 10**15
