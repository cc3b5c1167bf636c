"""Excuses: while one alarm stands, and a while after, what it explains raises no other."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adapters.errors import ProfileError
from adapters.toml_tables import TomlFile
from monitor.alarms.alarm import Alarm, AlarmRule
from monitor.alarms.excuse import ExcuseRule, Excuses, excuse_tables, general_of, read_excuses
from monitor.core.alarms import CLEARED, EXPLAINED, RAISED, AlarmState, ChainRows, walk
from monitor.event import AlarmEvent, State

RULE = ExcuseRule(("gps_velocity_north",), ("gyro_x", "gyro_y"), 20.0)
KNOWN = ("gps_velocity_north", "gyro_x", "gyro_y")


def event(channel: str, state: State, seconds: float, identity: str = "a") -> AlarmEvent:
    moment = round(seconds * 1000)
    names = (identity, "v", "motors", channel, "sensor", state, "warning")
    return AlarmEvent(*names, 0.1, None, "rad/s", 0.05, 0, moment, 0, 0.1, "", 1)


def excused(alarm: AlarmState, seconds: float) -> bool:
    """Return whether evidence beyond any size raises nothing at a time, as it would without an excuse."""
    raised: list[int] = []
    times_ns = np.array([round(seconds * 1e9)])
    always = np.ones((1, 1), np.bool_)
    rows = ChainRows([alarm], np.zeros(1, np.int64), times_ns, np.zeros(1, np.bool_), np.full((1, 1), 9.0), always)
    walk([rows], lambda _observer, _row, _alarm, code: raised.append(code))
    alarm.deactivate()
    return RAISED not in raised


def watched(excuses: Excuses, channel: str) -> AlarmState:
    alarm = AlarmState()
    alarm.set_rule(AlarmRule("inertial", channel, "sensor", "m/s", 1.0, 0.5, 20.0, raise_s=0.0, clear_s=1.0))
    excuses.add(channel, alarm)
    return alarm


def test_an_active_alarm_clears_although_another_explains_its_evidence() -> None:
    excuses, codes = Excuses((RULE,)), list[int]()
    north = watched(excuses, "gps_velocity_north")
    north.resume(9.0, 9.0, 1.0, np.nan, 0, False, False, False)
    excuses.follow(event("gyro_x", "raised", 1.0))
    times_ns, always = np.arange(2, 5) * 1_000_000_000, np.ones((3, 1), np.bool_)
    rows = ChainRows([north], np.arange(3), times_ns, np.zeros(3, np.bool_), np.zeros((3, 1)), always)
    walk([rows], lambda _observer, _row, _alarm, code: codes.append(code))
    assert codes == [CLEARED]


def test_evidence_is_excused_while_the_cause_is_active_and_for_its_time_after() -> None:
    excuses = Excuses((RULE,))
    north, east = watched(excuses, "gps_velocity_north"), watched(excuses, "gps_velocity_east")
    assert not excused(north, 1)
    excuses.follow(event("gyro_x", "raised", 1.0))
    assert excused(north, 500)
    assert not excused(east, 2)
    excuses.follow(event("gyro_x", "cleared", 10.0))
    assert excused(north, 29)
    assert not excused(north, 31)


def test_evidence_of_the_sample_that_cleared_the_cause_is_excused() -> None:
    excuses = Excuses((RULE,))
    north = watched(excuses, "gps_velocity_north")
    excuses.follow(event("gyro_x", "raised", 1.0))
    excuses.follow(event("gyro_x", "cleared", 10.2))  # known a fifth of a second after its sample
    assert excused(north, 10)


def test_what_a_gyros_bias_makes_of_a_motors_evidence_raises_no_alarm_but_more_does() -> None:
    excuses = Excuses(())
    motor = watched(excuses, "motor1")
    for factor, seconds, silent in ((50.0, 2, False), (90.0, 4, True)):
        # evidence is 9, the threshold 1, the gyro's bias 0.1
        excuses.add("motor1", motor, made={"gyro_z": factor})
        excuses.follow(event("gyro_z", "raised", seconds - 1.0))
        assert excused(motor, seconds) == silent
    excuses.follow(event("gyro_z", "cleared", 5.0))
    assert not excused(motor, 6)


def test_an_observer_is_silent_while_one_that_sees_its_faults_sooner_names_any() -> None:
    excuses = Excuses(())
    trim = watched(excuses, "motor1")
    excuses.add_beside("motor1", trim, ["motors"], 10.0)
    excuses.follow(replace(event("unexplained", "raised", 1.0), kind="residual"))
    excuses.follow(replace(event("motor3", "raised", 1.0), observer="esc"))
    assert not excused(trim, 2)
    excuses.follow(event("motor2", "raised", 3.0))
    assert excused(trim, 500)
    excuses.follow(event("motor2", "cleared", 510.0))
    assert excused(trim, 519)
    assert not excused(trim, 521)


def test_what_an_active_alarm_explains_is_listed_under_it_once() -> None:
    told: list[str] = []

    def affect(channel: str, time_ns: int, vehicle_ns: int) -> AlarmEvent | None:
        told.append(channel)
        return replace(event("gyro_x", "updated", vehicle_ns / 1e9), message=f"gyro x; affected: {channel}")

    excuses = Excuses((RULE,))
    north = watched(excuses, "gps_velocity_north")
    excuses.add("gyro_x", AlarmState(), affect=affect)
    assert excuses.explained("gps_velocity_north", 0, 0) is None
    excuses.follow(event("gyro_x", "raised", 1.0))
    codes: list[int] = []
    times_ns, always = np.arange(2, 6) * 1_000_000_000, np.ones((4, 1), np.bool_)
    rows = ChainRows([north], np.arange(4), times_ns, np.zeros(4, np.bool_), np.full((4, 1), 9.0), always)
    walk([rows], lambda _observer, _row, _alarm, code: codes.append(code))
    assert codes == [EXPLAINED]
    listed = excuses.explained("gps_velocity_north", 0, 2_000_000_000)
    assert listed is not None
    assert listed.message.endswith("affected: gps_velocity_north")
    assert told == ["gps_velocity_north"]


def test_an_alarm_lists_each_channel_it_affects_once_while_it_is_active() -> None:
    rule = AlarmRule("inertial", "gyro_x", "sensor", "rad/s", 1.0, 0.5, 20.0, raise_s=0.0, clear_s=1.0)
    alarm = Alarm(rule, "v")
    assert alarm.affect("compass", 0, 0) is None
    alarm.adopt(event("gyro_x", "raised", 1.0))
    first = alarm.affect("compass", 2, 2_000_000)
    assert first is not None
    assert (first.state, first.id, first.message) == ("updated", "a", "; affected: compass")
    assert alarm.affect("compass", 3, 3_000_000) is None
    second = alarm.affect("accel_z", 3, 3_000_000)
    assert second is not None
    assert second.message == "; affected: compass, accel_z"
    assert alarm.close(4, 4_000_000, "over").message == "over"
    assert alarm.affect("compass", 5, 5_000_000) is None


def test_the_end_of_a_fault_that_another_observer_followed_is_no_jump_the_other_way() -> None:
    excuses = Excuses(())
    jumping, lasting = watched(excuses, "gyro_x"), AlarmState()
    excuses = Excuses(())
    excuses.add("gyro_x", jumping, "motors", jumps=True)
    excuses.add("gyro_x", lasting, "inertial")
    excuses.follow(replace(event("gyro_x", "raised", 1.0), observer="inertial"))
    assert excused(jumping, 2)
    excuses.follow(replace(event("gyro_x", "cleared", 3.0), observer="inertial"))
    assert excused(jumping, 12)
    assert not excused(jumping, 14)
    excuses.follow(replace(event("gyro_x", "raised", 20.0), observer="motors"))
    excuses.follow(replace(event("gyro_x", "cleared", 30.0), observer="motors"))
    assert not excused(jumping, 31)


@pytest.mark.parametrize(
    ("precedes", "gone", "seconds", "states"),
    [
        (True, False, 4.0, ["cleared", "updated"]),
        (True, False, 12.0, []),
        (False, False, 4.0, []),
        (True, True, 4.0, ["updated"]),
        (True, True, 14.0, []),
    ],
)
def test_an_alarm_that_came_first_ends_as_a_consequence_or_is_listed_if_it_has_gone(
    precedes: bool, gone: bool, seconds: float, states: list[str]
) -> None:
    excuses = Excuses((ExcuseRule(("steering",), ("gyro_z",), 4.0, precedes=precedes),))
    steering, gyro = (
        Alarm(AlarmRule("drive", name, "sensor", "", 1.0, 0.5, 5.0, raise_s=0.1, clear_s=0.1), "v")
        for name in ("steering", "gyro_z")
    )
    for alarm in (steering, gyro):
        name = alarm.rule.channel
        excuses.add(name, alarm.state, affect=alarm.affect, withdraw=alarm.withdraw)
    if gone:
        excuses.follow(event("steering", "cleared", 3.0))
    else:
        steering.adopt(replace(event("steering", "raised", 1.0), since_ns=1_000_000_000))
    cause = replace(event("gyro_z", "raised", seconds), time_ns=round(seconds * 1e9))
    gyro.adopt(cause)
    excuses.follow(cause)
    events = excuses.consequences(cause)
    assert [found.state for found in events] == states
    assert steering.state.active is not (gone or bool(states))
    assert [found.message for found in events] == ["explained by gyro_z", "; affected: steering"][2 - len(states) :]


def test_two_alarms_of_one_channel_both_have_to_clear() -> None:
    excuses = Excuses((RULE,))
    north = watched(excuses, "gps_velocity_north")
    excuses.follow(event("gyro_x", "raised", 1.0, "motors"))
    excuses.follow(event("gyro_x", "raised", 2.0, "inertial"))
    excuses.follow(event("gyro_x", "cleared", 3.0, "motors"))
    assert excused(north, 100)


def test_a_rule_says_nothing_of_channels_without_an_alarm() -> None:
    rule = ExcuseRule(("steering", "throttle"), ("gyro_z", "accel_x"), 4.0)
    assert rule.among(("steering", "gyro_z", "compass")) == ExcuseRule(("steering",), ("gyro_z",), 4.0)


def test_rules_read_back_as_written(tmp_path: Path) -> None:
    rules = RULE, ExcuseRule(("gyro_x",), ("gyro_y",), 2.0, same_cause=True), replace(RULE, precedes=True)
    file = TomlFile("profile.toml", {"excuses": excuse_tables(rules)}, ProfileError)
    assert read_excuses(file.root.tables("excuses"), KNOWN) == rules
    assert general_of(rules) == {"gyro_y": ("gyro_x",)}
    file.check()


@pytest.mark.parametrize(
    ("table", "complaint"),
    [
        ({"channels": ["gyro_x"], "by": []}, "'excuses[0].by' is empty"),
        ({"channels": ["wheel"], "by": ["gyro_x"]}, "'excuses[0].channels' names 'wheel', which has no alarm"),
        ({"channels": ["gyro_x"], "by": ["gyro_x"]}, "'gyro_x' would excuse itself"),
        ({"channels": ["gyro_x"], "by": ["gyro_y"], "for": 1}, "'excuses[0].for' is not a key"),
    ],
)
def test_a_mistake_is_one_line_that_names_file_and_key(table: dict[str, object], complaint: str) -> None:
    file = TomlFile("profile.toml", {"excuses": [table]}, ProfileError)
    read_excuses(file.root.tables("excuses"), KNOWN)
    with pytest.raises(ProfileError, match=re.escape(complaint)):
        file.check()
