"""What the table of alarms shows: what stands, worst first, and for a while what has gone."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from loopback import START_NS, event

from monitor.console.alarm_table import MAX_ALARMS, AlarmTable, age
from monitor.event import AlarmEvent

SECOND = 1_000_000_000


def rows(*events: AlarmEvent, after_s: float = 1.0) -> list[tuple[str, str, str]]:
    """Return group, channel and state of what is shown some time after the last event."""
    table = AlarmTable()
    for one in events:
        table.take(one, START_NS)
    return [(row.group, row.channel, row.state) for row in table.rows(START_NS + round(after_s * SECOND))]


def test_a_row_says_what_how_much_since_when_and_how_bad_it_was() -> None:
    table = AlarmTable()
    table.take(event(1, estimate=-0.0212, relative=-0.05, unit="fraction of full command"), START_NS)
    row = table.rows(START_NS + 125 * SECOND)[0]
    assert (row.severity, row.vehicle, row.channel) == ("warning", "copter-1", "motors/motor1")
    assert (row.size, row.age) == ("-5 % of thrust", "2 min")
    assert (row.group, row.state, row.message) == ("active", "raised", "motor1 delivers less")


def test_a_size_that_is_not_known_is_left_out() -> None:
    table = AlarmTable()
    table.take(event(1, kind="stale", estimate=None, peak=None), START_NS)
    assert table.rows(START_NS)[0].size == ""


def test_critical_comes_first_then_the_newest_then_shelved_then_cleared() -> None:
    hour = START_NS + 3600 * SECOND
    assert [channel for _, channel, _ in rows(
        event(1, "gone"),
        event(2, "gone", state="cleared", severity="critical"),
        event(3, "quiet", state="shelved", severity="critical", shelved_until_ns=hour),
        event(4, "old"),
        event(5, "new", since_ns=START_NS + 5),
        event(6, "bad", severity="critical"),
    )] == ["motors/bad", "motors/new", "motors/old", "motors/quiet", "motors/gone"]  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "group", "state"),
    [
        ({"state": "acknowledged", "acknowledged": True}, "active", "acknowledged"),
        ({"latched": True}, "active", "latched"),
        ({"latched": True, "acknowledged": True}, "active", "acknowledged, latched"),
        ({"shelved_until_ns": START_NS + 600 * SECOND}, "shelved", "shelved until 09:15Z"),
        ({"shelved_until_ns": START_NS}, "active", "raised"),
        ({"shelved_until_ns": 10**40}, "shelved", "shelved until ?"),
    ],
)
def test_the_state_says_what_operators_did(changes: dict[str, Any], group: str, state: str) -> None:
    assert rows(event(1, **changes)) == [(group, "motors/motor1", state)]


def test_a_cleared_alarm_is_shown_for_a_while() -> None:
    told = (event(1), event(2, state="cleared"))
    assert rows(*told, after_s=29.0) == [("cleared", "motors/motor1", "cleared")]
    assert rows(*told, after_s=31.0) == []


def test_an_alarm_that_cleared_before_anyone_looked_is_not_shown() -> None:
    assert rows(event(2, state="cleared")) == []


def test_an_alarm_that_comes_back_takes_its_own_place() -> None:
    again = event(3, id="01J-again", since_ns=START_NS + 3)
    assert rows(event(1), event(2, state="cleared"), again, after_s=100.0) == [("active", "motors/motor1", "raised")]


def test_what_arrives_late_changes_nothing() -> None:
    assert rows(event(1), event(3, state="cleared"), event(2, state="updated")) == [
        ("cleared", "motors/motor1", "cleared")
    ]
    newer = event(5, id="01J-newer", since_ns=START_NS + 3)
    assert rows(event(1), newer, event(2, state="cleared")) == [("active", "motors/motor1", "raised")]


def test_vehicles_with_the_same_channel_have_rows_of_their_own() -> None:
    assert len(rows(event(1), event(1, vehicle="copter-2"))) == 2


def test_endless_names_do_not_fill_the_memory_and_the_latest_stay() -> None:
    found = rows(*(event(k, f"c{k}") for k in range(MAX_ALARMS + 100)))
    assert len(found) == MAX_ALARMS
    assert ("active", f"motors/c{MAX_ALARMS + 99}", "raised") in found


def test_the_sentence_says_the_size_of_now_and_keeps_what_is_behind_it() -> None:
    table = AlarmTable()
    said = "motor1 delivers 5 % less than commanded; affected: motor2"
    raised = event(1, message=said, estimate=-0.02, relative=-0.05, unit="fraction of full command")
    table.take(raised, 0)
    table.resize(raised.vehicle, raised.observer, {raised.channel: -0.04}, {})
    [row] = table.rows(START_NS)
    assert (row.size, row.message) == ("-10 % of thrust", said.replace("5 %", "10 %"))
    table.resize(raised.vehicle, raised.observer, {raised.channel: -0.04}, {raised.channel: -0.08})
    assert table.rows(START_NS)[0].size == "-8 % of thrust"
    table.resize(raised.vehicle, raised.observer, {raised.channel: -0.04}, {raised.channel: math.nan})
    assert table.rows(START_NS)[0].size == "-10 % of thrust"


@given(st.text(max_size=8), st.text(max_size=8), st.integers(), st.floats())
def test_no_column_holds_control_characters(text: str, unit: str, time_ns: int, size: float) -> None:
    table = AlarmTable()
    table.take(event(1, text, vehicle=text, severity=text, message=text, unit=unit, since_ns=time_ns, estimate=size), 0)
    row = table.rows(START_NS)[0]
    names = ("severity", "vehicle", "channel", "size", "age", "state", "message")
    assert all(getattr(row, name).isprintable() for name in names)


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(-5, "0 s"), (59.9, "59 s"), (60, "1 min"), (3599, "59 min"), (7500, "2 h 5 min"), (4 * 86_400, "4 d")],
)
def test_an_age_is_told_in_its_largest_unit(seconds: float, text: str) -> None:
    assert age(round(seconds * SECOND)) == text
