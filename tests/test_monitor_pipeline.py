"""The pipeline: one vehicle out of many senders, evidence only in flight, no clock but the messages."""

import dataclasses
import itertools
import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import pytest
from test_monitor_recorder import Log

from adapters.batch import pack
from adapters.logs.recordings import packed, read_recording
from adapters.message import Message, silence
from adapters.source import CLOCK, DATAFLASH, JOURNAL, LINK, MAVLINK, OPERATOR
from monitor.alarms.desk import DeskRule
from monitor.estimate import Estimates
from monitor.event import AlarmEvent
from monitor.pipeline import Pipeline, handover_message, rules_message
from monitor.profile import Profile
from monitor.sampling.phase import FlightPhase

LONG = pytest.mark.long


@pytest.fixture(scope="module")
def flight(data: Path) -> list[Message]:
    return list(read_recording(data / "copter_motor2_080.tlog.xz"))


@pytest.fixture(scope="module")
def expected(quad_profile: Profile, flight: list[Message]) -> list[AlarmEvent]:
    """Return the events of the flight as it is."""
    found = events(quad_profile, flight)
    assert found
    return found


def outputs(profile: Profile, messages: Iterator[Message] | list[Message]) -> list[Estimates | AlarmEvent]:
    return processed(Pipeline(profile), messages)


def processed(pipeline: Pipeline, messages: Iterable[Message]) -> list[Estimates | AlarmEvent]:
    return [output for batch in packed(messages) for output in pipeline.run(batch)]


def only_events(outputs: Iterable[Estimates | AlarmEvent]) -> list[AlarmEvent]:
    return [output for output in outputs if isinstance(output, AlarmEvent)]


def events(profile: Profile, messages: Iterator[Message] | list[Message]) -> list[AlarmEvent]:
    return only_events(outputs(profile, messages))


def test_other_stations_change_nothing(
    quad_profile: Profile, flight: list[Message], expected: list[AlarmEvent]
) -> None:
    def crowded() -> Iterator[Message]:
        for message in flight:
            yield message
            yield dataclasses.replace(message, system=255)
            yield dataclasses.replace(message, system=7)

    assert events(quad_profile, crowded()) == expected


@pytest.mark.parametrize("absurd", [1e11, 1e200, *(pytest.param(size, marks=LONG) for size in (1e6, 3.4e38, 1e308))])
@pytest.mark.parametrize(("name", "field"), [("ATTITUDE", "rollspeed"), ("SERVO_OUTPUT_RAW", "servo1_raw")])
def test_absurd_measurements_before_a_fault_neither_hide_it_nor_accuse_a_motor(
    quad_profile: Profile, flight: list[Message], expected: list[AlarmEvent], name: str, field: str, absurd: float
) -> None:
    places = [place for place, message in enumerate(flight) if message.name == name]
    spoilt = list(flight)
    for place in places[40:43]:
        spoilt[place] = dataclasses.replace(flight[place], fields={**flight[place].fields, field: absurd})
    [raised] = (event for event in expected if event.state == "raised")
    found = [event for event in events(quad_profile, spoilt) if event.state == "raised"]
    accused = {event.channel: event.time_ns for event in found if event.channel != "unexplained"}
    assert accused == {raised.channel: raised.time_ns}


def test_messages_of_no_interest_change_nothing(
    quad_profile: Profile, flight: list[Message], expected: list[AlarmEvent]
) -> None:
    interests = Pipeline(quad_profile).interests
    noise = Message(MAVLINK, "STATUSTEXT", flight[0].received_ns, {"text": "hello"}, 1, 1)
    with_noise = [item for message in flight for item in (message, noise)]
    wanted = [message for message in with_noise if message.name in interests]
    assert events(quad_profile, with_noise) == events(quad_profile, wanted) == expected


@pytest.mark.parametrize(
    ("name", "field", "value", "raised"),
    [
        ("EXTENDED_SYS_STATE", "landed_state", 4, []),
        # that it is disarmed and in the air is a contradiction
        ("HEARTBEAT", "base_mode", 0, [("impostor", "raised")]),
    ],
)
def test_no_fault_is_raised_while_landing_or_disarmed(
    quad_profile: Profile, flight: list[Message], name: str, field: str, value: int, raised: list[tuple[str, str]]
) -> None:
    first = next(message for message in flight if message.name == name)
    changed = dataclasses.replace(first, fields={**first.fields, field: value})
    # a vehicle whose motors run as in flight is not believed that it is disarmed
    said = {
        name: changed.fields,
        **({} if raised == [] else {"SERVO_OUTPUT_RAW": {f"servo{k}_raw": 1000 for k in "1234"}}),
    }
    masked = [
        changed,
        *(dataclasses.replace(m, fields={**m.fields, **said.get(m.name, {})}) for m in flight),
    ]
    found = outputs(quad_profile, masked)
    assert [(output.channel, output.state) for output in found if isinstance(output, AlarmEvent)] == raised
    assert not any(output.armed.any() for output in found if isinstance(output, Estimates))


def landing_at(flight: list[Message], height_mm: int) -> Iterator[Message]:
    """Yield a flight as one of a vehicle that lands, at this height above its home."""
    ids = flight[0].system, flight[0].component
    for message in flight:
        if message.name == "EXTENDED_SYS_STATE":
            yield Message(MAVLINK, "GLOBAL_POSITION_INT", message.received_ns, {"relative_alt": height_mm}, *ids)
            yield dataclasses.replace(message, fields={**message.fields, "landed_state": 4})
        else:
            yield message


def test_a_landing_vehicle_is_watched_until_it_is_near_the_ground(
    quad_profile: Profile, flight: list[Message], expected: list[AlarmEvent]
) -> None:
    assert events(quad_profile, landing_at(flight, 2500)) == expected
    assert events(quad_profile, landing_at(flight, 1500)) == []
    unknown = [message for message in landing_at(flight, 2500) if message.name != "GLOBAL_POSITION_INT"]
    assert events(quad_profile, unknown) == []


def disarmed(flight: list[Message], seconds: float) -> list[Message]:
    """Return the heartbeats of a disarmed vehicle behind a flight, one a second."""
    beat = next(message for message in flight if message.name == "HEARTBEAT")
    fields = {**beat.fields, "base_mode": 81}
    ends = flight[-1].received_ns
    return [
        dataclasses.replace(beat, received_ns=ends + round(at * 1e9), fields=fields)
        for at in itertools.takewhile(lambda at: at <= seconds, itertools.count(0.5))
    ]


def test_what_is_active_at_landing_is_closed_and_does_not_greet_the_next_flight(
    quad_profile: Profile, flight: list[Message], expected: list[AlarmEvent]
) -> None:
    raised, *_ = expected
    start = next(k for k, message in enumerate(flight) if message.received_ns > raised.time_ns + 1_000_000_000)
    pipeline, flown = Pipeline(quad_profile), flight[:start]
    processed(pipeline, flown)
    assert [event.id for event in pipeline.desk.active] == [raised.id]
    beats = disarmed(flown, 2.6)
    assert {event.observer for event in only_events(processed(pipeline, beats))} <= {"link"}
    later = disarmed(flown, 4.0)[len(beats) :]
    [closed] = [event for event in only_events(processed(pipeline, later)) if event.observer == raised.observer]
    assert (closed.id, closed.state, closed.time_ns) == (raised.id, "cleared", beats[0].received_ns + 3_000_000_000)
    assert "landing" in closed.message
    healthy = [message for message in flight if message.received_ns < expected[0].time_ns - 2_000_000_000]
    shift = later[-1].received_ns + 1_000_000_000 - flight[0].received_ns
    again = [dataclasses.replace(message, received_ns=message.received_ns + shift) for message in healthy]
    assert {event.observer for event in only_events(processed(pipeline, again))} <= {"link"}


def test_a_forged_report_of_disarming_closes_nothing(
    quad_profile: Profile, flight: list[Message], expected: list[AlarmEvent]
) -> None:
    at_ns = expected[0].time_ns + 1_000_000_000
    beat = next(message for message in flight if message.name == "HEARTBEAT")
    forged = dataclasses.replace(beat, received_ns=at_ns, fields={**beat.fields, "base_mode": 81})
    session = sorted([*flight, forged], key=lambda message: message.received_ns)
    assert not any("landing" in event.message for event in events(quad_profile, session))


def test_an_operator_closes_any_alarm_and_it_comes_anew_while_its_cause_acts(
    quad_profile: Profile, flight: list[Message], expected: list[AlarmEvent]
) -> None:
    raised, *_ = expected
    reset = Message(OPERATOR, "reset", raised.time_ns + 1_000_000_000, {"id": raised.id, "by": "Ann"})
    told = events(quad_profile, sorted([*flight, reset], key=lambda message: message.received_ns))
    own = [event for event in told if event.channel == raised.channel]
    closed = next(event for event in own if event.state == "cleared")
    assert (closed.id, closed.time_ns, closed.message) == (raised.id, reset.received_ns, "reset by Ann")
    again = own[own.index(closed) + 1]
    assert (again.state, again.id != raised.id) == ("raised", True)
    assert 0 < again.time_ns - closed.time_ns < 5_000_000_000


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
    restarts = sum(int(output.samples.restart.sum()) for output in found if isinstance(output, Estimates))
    # of the motors, and of their means at the start; the inertial observer waits for a GPS, which this log lacks
    assert restarts == 3
    stale = [output for output in found if isinstance(output, AlarmEvent)]
    assert [(event.channel, event.state) for event in stale] == [("telemetry", "raised"), ("telemetry", "cleared")]


def test_a_vehicles_own_log_may_pause_on_the_ground(quad_profile: Profile, data: Path) -> None:
    flight = list(read_recording(data / "copter_wind_step.tlog.xz"))
    start = flight[0].received_ns
    states = (m for m in flight if m.name == "EXTENDED_SYS_STATE")
    landed = next(m for m in states if m.received_ns - start > 5e9)
    ground = dataclasses.replace(landed, fields={**landed.fields, "landed_state": 1})
    cut = [m for m in flight if not landed.received_ns <= m.received_ns < landed.received_ns + 3_100_000_000]
    cut = sorted([*cut, ground], key=lambda message: message.received_ns)
    own = Message(DATAFLASH, "PARM", start, {"Name": "FRAME_CLASS", "Value": 1.0})
    for session, said in ((cut, 2), ([own, *cut], 0)):
        assert [event.channel for event in events(quad_profile, session)].count("telemetry") == said


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


def test_time_of_arrival_moves_unix_times_and_nothing_else(
    quad_profile: Profile, flight: list[Message], expected: list[AlarmEvent]
) -> None:
    shifted = [dataclasses.replace(message, received_ns=message.received_ns + 10**15) for message in flight]
    for before, after in zip(expected, events(quad_profile, shifted), strict=True):
        assert after.vehicle_time_ms == before.vehicle_time_ms
        assert after.estimate == before.estimate
        assert after.time_ns - before.time_ns == 10**15


def alarm_states(found: list[AlarmEvent], channel: str) -> list[str]:
    return [event.state for event in found if event.channel == channel]


def with_operators(profile: Profile, flight: list[Message], before: AlarmEvent) -> list[Message]:
    """Return a flight in which operators acknowledge, shelve for 3 s and change thresholds."""
    first, at_ns = before, before.time_ns
    name = {"channel": f"{first.observer}/{first.channel}", "by": "Ann"}
    rule = DeskRule(latched=frozenset({name["channel"]}), flood_raised=3)
    tight = {first.observer: {first.channel: {"threshold": 0.001, "clear": 0.0005}}}
    told = [
        handover_message([dataclasses.replace(first, channel="wing", id="before")], 41, flight[0].received_ns),
        rules_message(rule, profile, at_ns - 1_000_000_000),
        Message(OPERATOR, "ack", at_ns + 500_000_000, name),
        Message(OPERATOR, "shelve", at_ns + 1_000_000_000, {**name, "until_ns": at_ns + 4_000_000_000}),
        Message(OPERATOR, "rules", at_ns + 6_000_000_000, {"alarms": tight}),
        Message(LINK, "signing", at_ns + 7_000_000_000, {"forged": 1}, 1),
        silence(at_ns + 7_050_000_000),
    ]
    return sorted([*told, *flight], key=lambda message: message.received_ns)


def test_a_recording_of_everything_fed_gives_the_same_events_again(
    quad_profile: Profile, flight: list[Message], expected: list[AlarmEvent], tmp_path: Path
) -> None:
    first, *_ = expected
    live = Pipeline(quad_profile)
    path = tmp_path / "flight.mcap"
    session = with_operators(quad_profile, flight, first)
    with Log(path, live.layouts, live.metadata()) as recorder:
        for message in session:
            recorder.write(message)
    told = only_events(processed(live, session))
    assert [event.seq for event in told] == list(range(42, 42 + len(told)))
    assert {"raised", "acknowledged", "shelved", "cleared"} <= {event.state for event in told}
    recorded = list(read_recording(path))
    assert {OPERATOR, JOURNAL, LINK, CLOCK} <= {message.source for message in recorded}
    assert events(quad_profile, recorded) == told
    interests = Pipeline(quad_profile).interests
    assert events(quad_profile, list(read_recording(path, interests))) == told


def test_a_long_gap_replayed_says_no_more_than_the_silence_said_live(
    quad_profile: Profile, flight: list[Message]
) -> None:
    middle = flight[len(flight) // 2].received_ns
    late = [
        dataclasses.replace(
            message, received_ns=message.received_ns + (15 * 10**9 if message.received_ns > middle else 0)
        )
        for message in flight
    ]
    index = next(k for k, message in enumerate(late) if message.received_ns > middle)
    rest = [message for message in late[index:] if message.name != "HEARTBEAT"]
    replayed = [*late[:index], *rest]
    pauses = [silence(middle + k * 100_000_000) for k in range(1, 140)]
    live = [*late[:index], *pauses, *rest]
    assert events(quad_profile, replayed) == events(quad_profile, live)


def test_a_restart_brings_standing_alarms_back_with_their_ids(
    quad_profile: Profile, flight: list[Message], expected: list[AlarmEvent]
) -> None:
    raised, *_ = expected
    old, at = Pipeline(quad_profile), 0
    while not old.desk.active:
        old.run(pack(flight[at : at + 10]))
        at += 10
    new = Pipeline(quad_profile)
    (told,) = processed(new, [handover_message(old.desk.active, old.desk.seq, flight[at].received_ns)])
    assert isinstance(told, AlarmEvent)
    assert (told.state, told.id, told.seq) == ("updated", raised.id, old.desk.seq + 1)
    later = only_events(processed(new, flight[at:]))
    assert "raised" not in alarm_states(later, raised.channel)
    assert {event.id for event in later if event.channel == raised.channel} <= {raised.id}


def test_a_reboot_during_an_alarm_neither_loses_nor_mutes_it_nor_raises_it_twice(
    quad_profile: Profile, flight: list[Message], expected: list[AlarmEvent]
) -> None:
    raised, *_ = expected
    # The flight once more, its clock back at the beginning, as long after it as a reboot takes to come there.
    boot_ns = next(m.fields["time_boot_ms"] for m in flight if "time_boot_ms" in m.fields) * 1_000_000
    lasted = flight[-1].received_ns - flight[0].received_ns + boot_ns
    # Another flight measures other values: those of before would be replayed ones.
    again = [
        dataclasses.replace(
            message,
            received_ns=message.received_ns + lasted,
            fields=message.fields
            | {
                name: message.fields[name] + 1e-5
                for name in message.fields
                if name.endswith(("acc", "roll", "pitch", "yaw", "speed"))
            },
        )
        for message in flight
    ]
    pipeline = Pipeline(quad_profile)
    told = only_events(processed(pipeline, [*flight, *again]))
    assert any(counts.clock_restarts for counts in pipeline.statistics().values())
    assert raised.channel in {event.channel for event in pipeline.desk.active}
    turns = [state for state in alarm_states(told, raised.channel) if state in ("raised", "cleared")]
    assert turns in (["raised"], ["raised", "cleared", "raised"])


def test_what_no_pipeline_understands_changes_nothing(
    quad_profile: Profile, flight: list[Message], expected: list[AlarmEvent]
) -> None:
    at_ns = flight[0].received_ns
    nonsense = [
        Message(JOURNAL, "standing", at_ns, {"alarms": 7, "seq": "x"}),
        Message(JOURNAL, "standing", at_ns, {"alarms": [7, None, {"id": "x"}]}),
        Message(OPERATOR, "rules", at_ns, {"alarms": {"motors": {"motor1": 3}}, "flood_s": float("inf")}),
        Message(OPERATOR, "ack", at_ns, {}),
        Message(OPERATOR, "shelve", at_ns, {"channel": "motor1", "until_ns": "tomorrow"}),
        Message(LINK, "signing", at_ns, {"forged": 1}, 77),
    ]
    assert events(quad_profile, [*nonsense, *flight]) == expected


@pytest.mark.parametrize(
    "fields",
    [
        {"flood_raised": 10**30},
        {"flood_s": math.inf},
        {"flood_s": 10**400},
        {"alarms": {"motors": {"motor1": {"threshold": 10**400, "slow_s": 0.0}}}},
        {"alarms": 5, "latched": [[1]], "out_of_service": 7},
    ],
)
def test_rules_that_cannot_be_change_nothing(
    quad_profile: Profile, flight: list[Message], expected: list[AlarmEvent], fields: dict[str, Any]
) -> None:
    rules = Message(OPERATOR, "rules", flight[0].received_ns, fields)
    assert outputs(quad_profile, [rules]) == []
    assert events(quad_profile, [rules, *flight]) == expected


@pytest.mark.parametrize("alarms", [5, "x", [5, None, {}], [{"id": 1}]])
def test_what_is_no_alarm_does_not_stand_after_a_restart(quad_profile: Profile, alarms: object) -> None:
    standing = Message(JOURNAL, "standing", 1, {"seq": 10**400, "alarms": alarms})
    assert outputs(quad_profile, [standing]) == []


def test_an_alarm_with_fields_of_the_wrong_type_does_not_stand_after_a_restart(
    quad_profile: Profile, expected: list[AlarmEvent]
) -> None:
    first, *_ = expected
    for name, value in (("vehicle_time_ms", "x"), ("estimate", [1]), ("observer", {}), ("latched", 1)):
        standing = Message(JOURNAL, "standing", 1, {"seq": 1, "alarms": [{**first.to_json(), name: value}]})
        assert outputs(quad_profile, [standing]) == []


# the last one is a leap second, which is told twice
@pytest.mark.parametrize("step_s", [-3600, 3600, -1])
@pytest.mark.parametrize("pieces", [1, 50])
def test_a_clock_that_is_set_hides_neither_a_fault_nor_the_end_of_telemetry(
    quad_profile: Profile, flight: list[Message], expected: list[AlarmEvent], step_s: int, pieces: int
) -> None:
    step_ns, middle_ns = step_s * 10**9, flight[len(flight) // 4].received_ns
    stepped = [
        dataclasses.replace(message, received_ns=message.received_ns + step_ns * (message.received_ns > middle_ns))
        for message in flight
    ]
    end_ns = stepped[-1].received_ns
    stepped += [silence(end_ns + tenth * 10**8) for tenth in range(1, 40)]
    pipeline, size = Pipeline(quad_profile), -(-len(stepped) // pieces)
    batches = [pack(stepped[at : at + size]) for at in range(0, len(stepped), size)]
    found = only_events(output for batch in batches for output in pipeline.run(batch))
    [fault] = (event for event in expected if event.state == "raised")
    raised = [(event.channel, event.vehicle_time_ms) for event in found if event.state == "raised"]
    assert (fault.channel, fault.vehicle_time_ms) in raised
    assert found[-1].channel == "telemetry"
    assert (found[-1].state, found[-1].time_ns) == ("raised", end_ns + 2 * 10**9)
