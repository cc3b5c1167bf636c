"""Commands of somebody new in flight raise ``link/command``, live, in replays and in reviews by one rule."""

from __future__ import annotations

import struct
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from test_monitor_impostor import disarmed, events_of

from adapters.batch import pack
from adapters.logs.recordings import read_recording
from adapters.logs.tlog import TlogReader
from adapters.message import Message
from adapters.source import MAVLINK
from monitor.alarms.command_watch import (
    FLOOD,
    CommandSent,
    CommandWatch,
    StreamFilter,
    command_sent,
    commanded_systems,
)
from monitor.alarms.desk import DeskRule
from monitor.event import AlarmEvent
from monitor.pipeline import Pipeline, rules_message
from monitor.profile import Profile
from replay.player import play
from replay.review.review import review_log

QUAD = Path(__file__).parent.parent / "replay" / "data" / "quad"
GROUND, STRANGER = (255, 190), (66, 1)
ARM, DISARM, REBOOT, MODE, REQUEST = "400", "400", "246", "176", "512"


def sent(sender: tuple[int, int], name: str, *values: float | str, at: float = 0.0) -> CommandSent:
    return CommandSent(at, *sender, name, values)


def long(number: int, first: float, at_ns: int, sender: tuple[int, int] = STRANGER, **more: Any) -> Message:
    fields = {"target_system": 1, "target_component": 1, "command": number, "confirmation": 0, "param1": first}
    fields |= {f"param{k}": 0.0 for k in range(2, 8)}
    return Message(MAVLINK, "COMMAND_LONG", at_ns, fields | more, *sender)


@pytest.mark.parametrize(
    ("before", "command", "weight"),
    [
        ([(GROUND, ARM, 1.0)], (STRANGER, DISARM, 0.0), "critical"),
        ([(GROUND, ARM, 1.0)], (STRANGER, MODE, 1.0, 4.0), "critical"),
        ([(GROUND, ARM, 1.0)], (STRANGER, "PARAM_SET", "FENCE_ENABLE", 0.0), "critical"),
        ([(GROUND, ARM, 1.0)], (STRANGER, "MISSION_CLEAR_ALL"), "critical"),
        ([(GROUND, ARM, 1.0)], (STRANGER, REQUEST, 30.0), None),
        ([(GROUND, ARM, 1.0)], (GROUND, DISARM, 0.0), None),
        # nobody had commanded: its radio control armed it, or the monitor came later
        ([], (STRANGER, REBOOT, 1.0), "warning"),
        ([], (STRANGER, MODE, 1.0, 4.0), "information"),
    ],
)
def test_who_is_new_and_what_it_does_decides(before: list[Any], command: Any, weight: str | None) -> None:
    watch = CommandWatch()
    for one in before:
        assert watch.follow(sent(*one), False) == []
    assert [one.weight for one in watch.follow(sent(*command), True)] == ([] if weight is None else [weight])
    # The same again, which keeps an alarm active.
    assert [one.weight for one in watch.follow(sent(*command), True)] == ([] if weight is None else [weight])


def test_a_graver_command_of_a_new_sender_is_told_after_one_that_is_no_alarm() -> None:
    watch = CommandWatch()
    commands = [(MODE, 1.0), (REBOOT, 1.0), (MODE, 1.0), (REBOOT, 1.0), (DISARM, 0.0)]
    told = [[one.weight for one in watch.follow(sent(STRANGER, *one), True)] for one in commands]
    assert told == [["information"], ["warning"], ["information"], ["warning"], ["warning"]]
    [last] = watch.follow(sent(STRANGER, DISARM, 0.0), True)
    assert last.text.endswith(", disarms, reboots the autopilot and changes the mode in flight")


@given(st.lists(st.floats(0.0, 30.0), max_size=300).map(sorted))
def test_a_flood_is_told_once_a_second_while_it_lasts(times: list[float]) -> None:
    watch, told = CommandWatch(), []
    for at in times:
        told += [at for one in watch.follow(sent(GROUND, REQUEST, at=at), True) if one.sender is None]
        within = sum(0 <= at - other < 1.0 for other in times if other <= at)
        assert not told or told[-1] != at or within > FLOOD
    assert all(b - a >= 1.0 for a, b in pairwise(told))
    assert bool(told) == (watch.most > FLOOD)


def message(name: str, at_ns: int = 0, sender: tuple[int, int] = STRANGER, **fields: Any) -> Message:
    return Message(MAVLINK, name, at_ns, {"target_system": 1, "target_component": 1} | fields, *sender)


FTP_READS, FTP_WRITES = (15, 4, 2), (6, 8, 13)


@pytest.mark.parametrize(
    ("name", "fields", "text"),
    [
        ("RC_CHANNELS_OVERRIDE", {"chan1_raw": 1500}, "overrides its radio control"),
        ("MANUAL_CONTROL", {"target": 1, "x": 500}, "steers it by joystick"),
        ("GPS_INPUT", {"lat": 0}, "feeds it positions"),
        ("SET_ATTITUDE_TARGET", {"thrust": 0.5}, "sets its attitude"),
        ("SET_POSITION_TARGET_LOCAL_NED", {"x": 5.0}, "sends it elsewhere"),
        ("SERIAL_CONTROL", {"flags": 2}, "writes to its serial ports"),
        ("SERIAL_CONTROL", {"flags": 3}, None),  # what the autopilot answers
        ("MISSION_ITEM_INT", {"command": 16, "current": 2}, "sends it elsewhere"),
        ("MISSION_ITEM_INT", {"command": 16, "current": 1}, None),  # an item of a mission that MISSION_COUNT announced
        *(("FILE_TRANSFER_PROTOCOL", {"payload": [0, 0, 0, code, 0]}, "writes files") for code in FTP_WRITES),
        *(("FILE_TRANSFER_PROTOCOL", {"payload": [0, 0, 0, code, 0]}, None) for code in FTP_READS),
        ("FILE_TRANSFER_PROTOCOL", {"payload": [0]}, None),
        ("RC_CHANNELS_OVERRIDE", {"target_system": 2}, None),
        ("MANUAL_CONTROL", {"target": 2}, None),
    ],
)
def test_streams_of_a_stranger_are_told_and_those_known_before_are_not(
    name: str, fields: dict[str, Any], text: str | None
) -> None:
    watch = CommandWatch()
    watch.follow(sent(GROUND, ARM, 1.0), False)
    said = command_sent(name, message(name, **fields).fields, 0.0, *STRANGER, 1)
    assert (said is not None) is (text is not None)
    if said is not None:
        [found] = watch.follow(said, True)
        assert (found.weight, text in found.text) == ("critical", True)
        watch.follow(said, False)
        assert watch.follow(said, True) == []


def test_one_message_a_second_of_a_stream_is_followed_and_no_harmless_one_hides_another() -> None:
    filters = StreamFilter()
    quick = [message("MANUAL_CONTROL", k * 40_000_000 + 2**60, target=1) for k in range(100)]
    for group in (quick[:7], quick[7:60], quick[60:]):
        kept = filters.rows(pack(group).columns[0], 1)
        assert {int(at) // 40_000_000 % 25 for at in kept.received_ns - 2**60} <= {0}
    mixed = [
        message("FILE_TRANSFER_PROTOCOL", k * 1_000_000 + 2**60, payload=[0, 0, 0, code])
        for k, code in enumerate((4, 15, 6, 6, 8))
    ]
    assert [filters.passes(one, 1) for one in mixed] == [False, False, True, False, False]
    assert filters.passes(message("SERIAL_CONTROL", 2**60, flags=2), 1)
    # others let no sender through more seldom
    assert filters.passes(replace(mixed[3], component=2), 1)
    assert filters.passes(replace(mixed[3], fields=mixed[3].fields | {"target_system": 0}), 1)


def test_commands_to_others_are_none(profile: Profile) -> None:
    for more in ({"target_system": 2}, {"target_component": 154}):
        message = long(400, 0.0, 1, **more)
        assert command_sent(message.name, message.fields, 0.0, *STRANGER, 1) is None
    mixed = pack([long(400, 0.0, 1), long(400, 0.0, 1, target_system=7)])
    assert commanded_systems(mixed.columns[0]) == {1, 7}
    assert Pipeline(profile, system=7).accepts(mixed.columns[0])
    assert not Pipeline(profile, system=8).accepts(mixed.columns[0])


@pytest.fixture(scope="module")
def profile(bundled_quad: Profile) -> Profile:
    return bundled_quad


@pytest.fixture(scope="module")
def flight(profile: Profile, data: Path) -> list[Message]:
    messages = list(read_recording(data / "copter_healthy_square.tlog.xz"))
    messages = [message for message in messages if message.received_ns - messages[0].received_ns < 35_000_000_000]
    begin_ns = messages[0].received_ns - 1_000_000_000
    first = next(message for message in messages if Pipeline(profile).identifies(message))
    untimed = replace(first, received_ns=begin_ns, fields={**first.fields, "time_boot_ms": 0, "time_usec": 0})
    return [untimed, disarmed([], begin_ns), long(400, 1.0, begin_ns, GROUND), *messages]


def with_commands(flight: list[Message], commands: list[Message]) -> list[Message]:
    return sorted(flight + commands, key=lambda message: message.received_ns)


def test_a_strangers_commands_in_flight_are_an_alarm(profile: Profile, flight: list[Message]) -> None:
    at_ns = flight[-1].received_ns - 20_000_000_000
    attacked = with_commands(flight, [long(400, 0.0, at_ns), long(176, 1.0, at_ns + 2_000_000_000, (67, 1))])
    events = events_of(profile, attacked)
    assert [(event.channel, event.state, event.severity) for event in events] == [
        ("command", "raised", "critical"),
        ("command", "updated", "critical"),
        ("command", "cleared", "critical"),
    ]
    assert (events[0].observer, events[0].kind, events[0].time_ns) == ("link", "security", at_ns)
    assert events[0].message == "system 66, component 1, which had not commanded before, disarms in flight"
    assert "system 67" in events[1].message
    assert events[2].time_ns == at_ns + 12_000_000_000


def test_a_replay_of_a_daemons_recording_knows_who_commanded_before_any_telemetry(
    profile: Profile, flight: list[Message]
) -> None:
    first_ns = flight[0].received_ns
    at_ns = flight[-1].received_ns - 20_000_000_000
    attacked = with_commands(flight[1:], [long(400, 0.0, at_ns)])
    [live, *_] = [one for one in Pipeline(profile, system=1).run(pack(attacked)) if isinstance(one, AlarmEvent)]
    [replayed, *_] = events_of(profile, [rules_message(DeskRule(), profile, first_ns, 1), *attacked])
    assert (live.severity, replayed.severity) == ("critical", "critical")
    assert replayed == live


def test_the_alarm_lasts_as_long_as_a_stranger_steers_and_says_what_else_he_does(
    profile: Profile, flight: list[Message], tmp_path: Path
) -> None:
    at_ns = flight[-1].received_ns - 20_000_000_000
    ms = 1_000_000
    steers = [message("MANUAL_CONTROL", at_ns + k * 40 * ms, target=1) for k in range(126)]
    others = [long(400, 0.0, at_ns + 300 * ms), *(long(400, 0.0, at_ns + 2600 * ms, (70 + k, 1)) for k in range(9))]
    events = events_of(profile, with_commands(flight, [*steers, *others]))
    assert [(event.state, (event.time_ns - at_ns) // ms) for event in events] == [
        ("raised", 0),
        ("updated", 1000),
        ("updated", 2600),
        ("updated", 3600),
        ("cleared", 15_000),
    ]
    assert "disarms and steers it by joystick in flight" in events[1].message
    assert "system 71" in events[3].message
    assert events[3].message.endswith("; further senders command it, too")
    # A recording holds the commands, though they come from others.
    play(profile, with_commands(flight, [*steers, *others]), record=tmp_path / "flight.mcap")
    assert list(play(profile, read_recording(tmp_path / "flight.mcap")).events) == events


def test_ordinary_commands_raise_nothing(profile: Profile, flight: list[Message]) -> None:
    end_ns = flight[-1].received_ns
    ground = [long(176, 1.0, end_ns - k * 1_000_000_000, GROUND) for k in range(20)]
    asks = [long(512, 30.0, end_ns - k * 1_000_000_000) for k in range(20)]
    others = [long(400, 0.0, end_ns - 10_000_000_000, target_system=9)]
    # A companion computer of the vehicle's own system has sent setpoints since before take-off, at 100 Hz.
    begin_ns = flight[0].received_ns
    setpoints = [
        message("SET_POSITION_TARGET_LOCAL_NED", at_ns, (1, 191), x=1.0)
        for at_ns in range(begin_ns + 10_000_000, end_ns, 10_000_000)
    ]
    assert events_of(profile, with_commands(flight, [*ground, *asks, *others, *setpoints])) == []


def test_one_forged_report_of_landing_makes_no_stranger_known(profile: Profile, flight: list[Message]) -> None:
    at_ns = flight[-1].received_ns - 20_000_000_000
    attack = [disarmed([], at_ns), long(512, 30.0, at_ns + 1_000_000), long(400, 0.0, at_ns + 3_000_000_000)]
    assert [event.channel for event in events_of(profile, with_commands(flight, attack))][:2] == ["impostor", "command"]


def test_a_line_of_the_configuration_switches_it_off(profile: Profile, flight: list[Message]) -> None:
    rule = rules_message(DeskRule(out_of_service=frozenset({"link/command"})), profile, flight[0].received_ns)
    attack = [long(400, 0.0, flight[-1].received_ns - 20_000_000_000)]
    assert events_of(profile, [rule, *with_commands(flight, attack)]) == []


def test_the_review_of_a_log_says_the_same(profile: Profile, data: Path, tmp_path: Path) -> None:
    packets = list(TlogReader(data / "copter_healthy_square.tlog.xz").packets())
    sender = mavlink.MAVLink(None, *STRANGER)
    command = mavlink.MAVLink_command_long_message(1, 1, 246, 0, 1.0, 0, 0, 0, 0, 0, 0)
    at_ns = packets[-1][0] - 30_000_000_000
    packets.append((at_ns, bytes(command.pack(sender))))
    log = tmp_path / "attacked.tlog"
    log.write_bytes(b"".join(struct.pack(">Q", time_ns // 1000) + packet for time_ns, packet in sorted(packets)))
    [event, *_] = [
        event
        for batch in TlogReader(log, Pipeline(profile).interests)
        for event in Pipeline(profile).run(batch)
        if isinstance(event, AlarmEvent)
    ]
    said = [one.judgement for one in review_log(log, learn=False).findings if one.rule.name == "commands_from_outside"]
    assert event.message.startswith("system 66, component 1, which had not commanded before, reboots")
    assert [one.text for one in said] == [event.message]
