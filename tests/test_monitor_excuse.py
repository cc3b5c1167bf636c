"""Excuses: while one alarm stands, and a while after, what it explains raises no other."""

import re
from pathlib import Path

import pytest

from adapters.errors import ProfileError
from monitor.alarms.excuse import ExcuseRule, Excuses, excuse_tables, read_excuses
from monitor.event import AlarmEvent, State
from monitor.tables import Table

RULE = ExcuseRule(("gps_velocity_north",), ("gyro_x", "gyro_y"), 20.0)
KNOWN = ("gps_velocity_north", "gyro_x", "gyro_y")


def event(channel: str, state: State, seconds: float, identity: str = "a") -> AlarmEvent:
    moment = round(seconds * 1000)
    names = (identity, "v", "motors", channel, "sensor", state, "warning")
    return AlarmEvent(*names, 0.1, None, "rad/s", 0.05, 0, moment, 0, 0.1, "", 1)


def test_evidence_is_excused_while_the_cause_stands_and_for_its_time_after() -> None:
    excuses = Excuses((RULE,))
    assert not excuses.excused("gps_velocity_north", 10**9)
    excuses.note(event("gyro_x", "raised", 1.0))
    assert excuses.excused("gps_velocity_north", 500 * 10**9)
    assert not excuses.excused("gps_velocity_east", 2 * 10**9)
    excuses.note(event("gyro_x", "cleared", 10.0))
    assert excuses.excused("gps_velocity_north", 29 * 10**9)
    assert not excuses.excused("gps_velocity_north", 31 * 10**9)


def test_two_alarms_of_one_channel_both_have_to_clear() -> None:
    excuses = Excuses((RULE,))
    excuses.note(event("gyro_x", "raised", 1.0, "motors"))
    excuses.note(event("gyro_x", "raised", 2.0, "inertial"))
    excuses.note(event("gyro_x", "cleared", 3.0, "motors"))
    assert excuses.excused("gps_velocity_north", 100 * 10**9)


def test_rules_read_back_as_written(tmp_path: Path) -> None:
    tables = [Table("profile.toml", f"excuses[{i}].", table) for i, table in enumerate(excuse_tables([RULE]))]
    assert read_excuses(tables, KNOWN) == (RULE,)


@pytest.mark.parametrize(
    ("table", "complaint"),
    [
        ({"channels": ["gyro_x"], "by": []}, "'excuses.by' is empty"),
        ({"channels": ["wheel"], "by": ["gyro_x"]}, "'excuses.channels' names 'wheel', which has no alarm"),
        ({"channels": ["gyro_x"], "by": ["gyro_x"]}, "'gyro_x' would excuse itself"),
        ({"channels": ["gyro_x"], "by": ["gyro_y"], "for": 1}, "'excuses.for' is not a key"),
    ],
)
def test_a_mistake_is_one_line_that_names_file_and_key(table: dict[str, object], complaint: str) -> None:
    with pytest.raises(ProfileError, match=re.escape(complaint)):
        read_excuses([Table("profile.toml", "excuses.", table)], KNOWN)
