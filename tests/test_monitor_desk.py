"""The alarm desk: every life an alarm may have under operators' hands, in a flood and over a restart."""

from dataclasses import replace
from itertools import count
from typing import Any

from hypothesis import given
from hypothesis import strategies as st
from loopback import START_NS, event

from monitor.alarms.desk import FLOOD, OBSERVER, AlarmDesk, DeskRule, desk_rule, rule_fields
from monitor.event import AlarmEvent

SECOND = 1_000_000_000
CHANNELS = ("motor1", "motor2", "motor3", "motor4")
NAMES = tuple(f"motors/{channel}" for channel in CHANNELS)
WATCHED = {("motors", channel) for channel in CHANNELS}


def at(seconds: float) -> int:
    return START_NS + round(seconds * SECOND)


def raw(channel: str, state: str, seconds: float = 0.0, **changes: Any) -> AlarmEvent:
    return event(0, channel, state=state, time_ns=at(seconds), **changes)


def operate(desk: AlarmDesk, verb: str, channel: str, seconds: float = 0.0, **fields: Any) -> list[AlarmEvent]:
    return desk.operate(verb, {"channel": f"motors/{channel}", **fields}, at(seconds))


def states(events: list[AlarmEvent]) -> list[str]:
    return [told.state for told in events]


def test_what_nobody_touches_is_passed_on_and_numbered() -> None:
    desk = AlarmDesk("copter-1", DeskRule())
    told = [
        *desk.process(raw("motor1", "raised")),
        *desk.process(raw("motor1", "updated")),
        *desk.process(raw("motor1", "cleared")),
    ]
    assert states(told) == ["raised", "updated", "cleared"]
    assert [one.seq for one in told] == [1, 2, 3]
    assert desk.active == ()


def test_an_acknowledgement_stays_until_the_alarm_becomes_critical() -> None:
    desk = AlarmDesk("copter-1", DeskRule())
    desk.process(raw("motor1", "raised"))
    (told,) = operate(desk, "ack", "motor1", by="Ann", reason="seen")
    assert (told.state, told.acknowledged) == ("acknowledged", True)
    assert told.message == f"{raw('motor1', 'raised').message} (acknowledged by Ann: seen)"
    assert operate(desk, "ack", "motor1", by="Ann") == []
    assert desk.process(raw("motor1", "updated", 1.0))[0].acknowledged
    assert not desk.process(raw("motor1", "updated", 2.0, severity="critical"))[0].acknowledged
    assert not desk.process(raw("motor1", "updated", 3.0, severity="critical"))[0].acknowledged


def test_a_shelved_alarm_is_quiet_and_raised_anew_with_its_id_when_the_time_is_over() -> None:
    desk = AlarmDesk("copter-1", DeskRule())
    (raised,) = desk.process(raw("motor1", "raised"))
    (shelved,) = operate(desk, "shelve", "motor1", until_ns=at(60))
    assert (shelved.state, shelved.shelved_until_ns) == ("shelved", at(60))
    assert desk.process(raw("motor1", "updated", 1.0, severity="critical")) == []
    assert desk.tick(at(59.9)) == []
    (again,) = desk.tick(at(75))
    assert (again.state, again.id, again.severity) == ("raised", raised.id, "critical")
    assert (again.shelved_until_ns, again.time_ns) == (None, at(60))
    assert desk.shelved == {}


def test_an_alarm_of_a_shelved_channel_enters_as_shelved_and_its_end_is_told() -> None:
    desk = AlarmDesk("copter-1", DeskRule())
    assert operate(desk, "shelve", "motor1", until_ns=at(60)) == []
    assert states(desk.process(raw("motor1", "raised", 1.0))) == ["shelved"]
    assert states(desk.process(raw("motor1", "cleared", 2.0))) == ["cleared"]
    assert desk.tick(at(61)) == []


def test_unshelving_lets_an_alarm_speak_at_once() -> None:
    desk = AlarmDesk("copter-1", DeskRule())
    desk.process(raw("motor1", "raised"))
    operate(desk, "shelve", "motor1", until_ns=at(60))
    assert states(operate(desk, "unshelve", "motor1", 1.0)) == ["raised"]
    assert desk.tick(at(61)) == []


def test_a_latched_alarm_stays_without_its_cause_until_it_is_reset() -> None:
    desk = AlarmDesk("copter-1", DeskRule(latched=frozenset({"motors/motor1"})))
    (raised,) = desk.process(raw("motor1", "raised"))
    (kept,) = desk.process(raw("motor1", "cleared", 1.0))
    assert (kept.state, kept.latched) == ("updated", True)
    (reset,) = operate(desk, "reset", "motor1", 2.0)
    assert (reset.state, reset.latched, reset.id) == ("cleared", False, raised.id)
    assert desk.active == ()


def test_a_latched_alarm_that_returns_keeps_its_id_and_loses_its_acknowledgement() -> None:
    desk = AlarmDesk("copter-1", DeskRule(latched=frozenset({"motors/motor1"})))
    (raised,) = desk.process(raw("motor1", "raised"))
    operate(desk, "ack", "motor1")
    desk.process(raw("motor1", "cleared", 1.0))
    (back,) = desk.process(raw("motor1", "raised", 2.0, id="other", since_ns=at(2.0)))
    assert (back.state, back.id, back.since_ns) == ("updated", raised.id, raised.since_ns)
    assert not back.acknowledged
    assert not back.latched


def test_a_channel_that_goes_out_of_service_clears_and_is_a_new_alarm_when_it_comes_back() -> None:
    desk = AlarmDesk("copter-1", DeskRule())
    (raised,) = desk.process(raw("motor1", "raised"))
    out = DeskRule(out_of_service=frozenset({"motors/motor1"}))
    (gone,) = desk.set_rule(out, at(1))
    assert (gone.state, gone.id) == ("cleared", raised.id)
    assert desk.active == ()
    assert desk.process(raw("motor1", "updated", 2.0, severity="critical")) == []
    (back,) = desk.set_rule(DeskRule(), at(3))
    assert (back.state, back.severity, back.since_ns) == ("raised", "critical", at(3))
    assert back.id != raised.id
    assert desk.process(raw("motor1", "cleared", 4.0))[0].id == back.id


def test_nothing_comes_back_into_service_that_cleared_in_between() -> None:
    desk = AlarmDesk("copter-1", DeskRule(out_of_service=frozenset({"motors/motor1"})))
    assert desk.process(raw("motor1", "raised")) == []
    assert desk.process(raw("motor1", "cleared", 1.0)) == []
    assert desk.set_rule(DeskRule(), at(2)) == []


def test_a_flood_shelves_further_warnings_says_so_once_and_ends() -> None:
    desk = AlarmDesk("copter-1", DeskRule(flood_raised=2, flood_s=10.0))
    told = [one for channel in CHANNELS for one in desk.process(raw(channel, "raised"))]
    assert [(one.channel, one.state) for one in told] == [
        ("motor1", "raised"),
        ("motor2", "raised"),
        (FLOOD, "raised"),
        ("motor3", "shelved"),
        ("motor4", "shelved"),
    ]
    over = desk.tick(at(11))
    assert [(one.channel, one.state) for one in over] == [
        ("motor3", "raised"),
        ("motor4", "raised"),
        (FLOOD, "cleared"),
    ]
    assert {one.time_ns for one in over} == {at(10)}


def test_what_is_or_becomes_critical_is_not_held_back_by_a_flood() -> None:
    desk = AlarmDesk("copter-1", DeskRule(flood_raised=1, flood_s=10.0))
    for channel in ("motor1", "motor2", "motor3"):
        desk.process(raw(channel, "raised"))
    assert states(desk.process(raw("motor4", "raised", severity="critical"))) == ["raised"]
    assert states(desk.process(raw("motor2", "updated", 1.0, severity="critical"))) == ["raised"]
    desk.process(raw("motor3", "cleared", 1.0))
    assert states(desk.process(raw("motor3", "raised", 2.0, id="new", severity="critical"))) == ["raised"]
    assert desk.shelved == {}


def test_a_flood_that_goes_on_keeps_holding_back_and_its_alarm_obeys_operators_too() -> None:
    desk = AlarmDesk("copter-1", DeskRule(flood_raised=1, flood_s=10.0, latched=frozenset({f"{OBSERVER}/{FLOOD}"})))
    for channel in ("motor1", "motor2"):
        desk.process(raw(channel, "raised"))
    desk.process(raw("motor3", "raised", 8.0))
    assert desk.tick(at(12)) == []
    over = desk.tick(at(30))
    assert [(one.channel, one.state, one.time_ns) for one in over] == [
        ("motor2", "raised", at(18)),
        ("motor3", "raised", at(18)),
        (FLOOD, "updated", at(18)),
    ]
    assert desk.tick(at(40)) == []
    assert states(desk.operate("reset", {"channel": FLOOD}, at(41))) == ["cleared"]


def test_what_an_operator_is_refused_says_why_and_changes_nothing() -> None:
    desk = AlarmDesk("copter-1", DeskRule())
    desk.process(raw("motor1", "raised"))
    before = desk.active
    for verb, fields, reason in (
        ("explode", {"channel": "motor1"}, "is no command"),
        ("ack", {"channel": "motor9"}, "no alarm 'motor9' is active"),
        ("ack", {"id": "nonsense", "channel": "motor1"}, "no alarm 'nonsense' is active"),
        ("ack", {"channel": "motors/motor2"}, "no alarm of motors/motor2 is active"),
        ("unshelve", {"channel": "motor1"}, "not shelved"),
        ("shelve", {"channel": "motor1"}, "until_ns"),
        ("shelve", {"channel": "motor1", "until_ns": True}, "until_ns"),
        ("ack", {}, "is active"),
        ("ack", {"id": 7}, "is active"),
    ):
        assert reason in (desk.refusal(verb, fields) or "")
        assert desk.operate(verb, fields, at(1)) == []
    assert desk.active == before


def test_alarms_that_stood_come_back_with_their_ids_flags_and_numbers() -> None:
    old = AlarmDesk("copter-1", DeskRule(latched=frozenset({"motors/motor3"})))
    for channel in CHANNELS:
        old.process(raw(channel, "raised"))
    operate(old, "ack", "motor1")
    operate(old, "shelve", "motor2", until_ns=at(60))
    old.process(raw("motor3", "cleared", 1.0))
    new = AlarmDesk("copter-1", old.rule)
    new.seq = old.seq
    told = new.adopt(old.active, WATCHED, at(20))
    assert states(told) == ["updated", "shelved", "updated", "updated"]
    assert [one.seq for one in told] == list(range(old.seq + 1, old.seq + 5))
    assert _life(new) == _life(old)
    assert states(new.tick(at(60))) == ["raised"]


def test_an_adopted_alarm_that_nobody_watches_any_longer_clears() -> None:
    desk = AlarmDesk("copter-1", DeskRule(out_of_service=frozenset({"motors/motor2"})))
    told = desk.adopt([raw(channel, "raised") for channel in ("motor1", "motor2", "wing")], WATCHED, at(1))
    assert [(one.channel, one.state) for one in told] == [
        ("motor1", "updated"),
        ("motor2", "cleared"),
        ("wing", "cleared"),
    ]
    assert states(desk.set_rule(DeskRule(), at(2))) == ["raised"]


def test_shelving_that_ended_while_no_monitor_ran_is_told_of_in_order() -> None:
    desk = AlarmDesk("copter-1", DeskRule())
    (adopted,) = desk.adopt([raw("motor1", "shelved", shelved_until_ns=at(5))], WATCHED, at(100))
    (again,) = desk.tick(at(101))
    assert again.state == "raised"
    assert again.time_ns >= adopted.time_ns


def test_a_rule_survives_its_message_and_nonsense_changes_nothing() -> None:
    rule = DeskRule(frozenset({"a/b"}), frozenset({"c/d"}), 3, 4.5)
    assert desk_rule(rule_fields(rule), DeskRule()) == rule
    nonsense = {"latched": "abc", "out_of_service": 7, "flood_raised": 10**30, "flood_s": float("inf")}
    assert desk_rule(nonsense, rule) == rule
    assert desk_rule({"flood_raised": -1, "flood_s": float("nan")}, rule) == rule


def _life(desk: AlarmDesk) -> set[tuple[str, str, bool, bool, int | None]]:
    return {(one.id, one.channel, one.acknowledged, one.latched, one.shelved_until_ns) for one in desk.active}


STEP = st.tuples(
    st.sampled_from(("evidence", "evidence", "evidence", "ack", "shelve", "unshelve", "reset", "service")),
    st.sampled_from(CHANNELS),
    st.floats(0.0, 20.0),
    st.booleans(),
)


@given(
    steps=st.lists(STEP, max_size=60),
    latched=st.frozensets(st.sampled_from(NAMES)),
    flood=st.integers(0, 3),
)
def test_the_life_of_every_alarm_is_in_order_whatever_happens(
    steps: list[tuple[str, str, float, bool]], latched: frozenset[str], flood: int
) -> None:
    desk = AlarmDesk("copter-1", DeskRule(latched, flood_raised=flood, flood_s=5.0))
    active: dict[str, AlarmEvent] = {}
    by_operators: set[str] = set()
    told: list[AlarmEvent] = []
    serial, seconds = count(), 0.0

    def note(events: list[AlarmEvent]) -> None:
        for one in events:
            key = f"{one.observer}/{one.channel}"
            if key in by_operators:
                assert one.state in ("shelved", "cleared", "acknowledged")
        told.extend(events)

    for what, channel, wait, flag in steps:
        seconds += wait + 0.001
        # The end of shelving is told before anything else of that moment.
        events = desk.tick(at(seconds))
        by_operators &= set(desk.shelved)
        note(events)
        if what == "evidence":
            before = active.get(channel)
            if before is None:
                one = raw(channel, "raised", seconds, id=f"{channel}-{next(serial)}", severity=_severity(flag))
                active[channel] = one
            elif flag:
                one = raw(channel, "cleared", seconds, id=before.id, severity=before.severity)
                del active[channel]
            else:
                one = active[channel] = raw(channel, "updated", seconds, id=before.id, severity="critical")
            events = desk.process(one)
            note(events)
            in_service = f"motors/{channel}" not in desk.rule.out_of_service
            if one.severity == "critical" and one.state != "cleared" and in_service:
                assert events or f"motors/{channel}" in by_operators
        elif what == "service":
            out = frozenset({f"motors/{channel}"}) if flag else frozenset()
            note(desk.set_rule(replace(desk.rule, out_of_service=out), at(seconds)))
        else:
            named = [one for one in desk.active if one.channel == channel]
            events = operate(desk, what, channel, seconds, until_ns=at(seconds + 10))
            if what == "reset":
                assert bool(events) == bool(named)
                # The observer of an alarm that was closed begins anew: what it finds again is a new alarm.
                if named:
                    active.pop(channel, None)
            if what == "shelve":
                by_operators.add(f"motors/{channel}")
            by_operators &= set(desk.shelved)
            note(events)

    standing = {one.id for one in desk.active}
    note([])
    end = desk.tick(at(seconds + 3600))
    by_operators.clear()
    note(end)
    assert desk.shelved == {}
    assert all(one.shelved_until_ns is None for one in desk.active)
    assert [one.seq for one in told] == list(range(1, len(told) + 1))
    lives: dict[str, list[str]] = {}
    for one in told:
        lives.setdefault(one.id, []).append(one.state)
    for states_of in lives.values():
        assert states_of[0] in ("raised", "shelved")
        assert "cleared" not in states_of[:-1]
    assert standing >= {one.id for one in desk.active}
    assert {one for one, life in lives.items() if life[-1] != "cleared"} == {one.id for one in desk.active}
    new = AlarmDesk("copter-1", desk.rule)
    new.adopt(desk.active, WATCHED, at(seconds + 3601))
    assert _life(new) == _life(desk)


@given(st.lists(st.tuples(st.sampled_from(CHANNELS), st.floats(0.0, 3.0)), max_size=20), st.integers(1, 5))
def test_it_does_not_matter_how_often_somebody_looks_at_the_clock(raised: list[tuple[str, float]], every: int) -> None:
    rule = DeskRule(flood_raised=2, flood_s=5.0)
    rarely, often = AlarmDesk("copter-1", rule), AlarmDesk("copter-1", rule)
    told: dict[AlarmDesk, list[AlarmEvent]] = {rarely: [], often: []}
    seconds = 0.0
    for number, (channel, wait) in enumerate([*raised, ("motor1", 60.0)]):
        for k in range(int(wait * every)):
            told[often] += often.tick(at(seconds + k / every))
        seconds += wait
        for desk in (rarely, often):
            told[desk] += desk.tick(at(seconds))
            told[desk] += operate(desk, "shelve", channel, seconds, until_ns=at(seconds + 2))
            told[desk] += desk.process(raw(channel, "raised", seconds, id=str(number)))
    assert told[rarely] == told[often]


def _severity(flag: bool) -> str:
    return "critical" if flag else "warning"


def test_channels_shelved_without_an_alarm_stay_shelved_after_a_restart() -> None:
    old = AlarmDesk("copter-1", DeskRule(flood_raised=1, flood_s=10.0))
    operate(old, "shelve", "motor1", until_ns=at(60))
    operate(old, "shelve", "motor2", until_ns=at(5))
    for channel in ("motor3", "motor4"):
        old.process(raw(channel, "raised"))
    # what a flood holds back is not what operators have shelved
    assert old.shelved_by_operators == {"motors/motor1": at(60), "motors/motor2": at(5)}
    new = AlarmDesk("copter-1", DeskRule())
    assert new.adopt([], WATCHED, at(10), old.shelved_by_operators) == []
    assert new.shelved == {"motors/motor1": at(60)}
    assert states(new.process(raw("motor1", "raised", 20.0))) == ["shelved"]
    assert states(new.process(raw("motor2", "raised", 20.0))) == ["raised"]
    assert states(new.tick(at(60))) == ["raised"]


def test_a_channel_whose_alarm_was_unshelved_last_is_not_shelved_by_an_older_note() -> None:
    desk = AlarmDesk("copter-1", DeskRule())
    desk.adopt([raw("motor1", "raised")], WATCHED, at(1), {"motors/motor1": at(60)})
    assert desk.shelved == {}


FINER = {"esc1": ("motor1",), "prop1": ("motor1",)}


def finding(state: str, seconds: float, channel: str = "esc1", **changes: Any) -> AlarmEvent:
    made = raw(channel, state, seconds, **{"message": f"{channel} is slow"} | changes)
    return replace(made, observer="esc")


def test_what_names_an_active_alarms_cause_is_said_in_it_and_is_no_alarm_of_its_own() -> None:
    desk = AlarmDesk("copter-1", DeskRule(), FINER)
    own = raw("motor1", "raised").message
    told = [
        *desk.process(raw("motor1", "raised")),
        *desk.process(finding("raised", 1.0)),
        *desk.process(finding("updated", 2.0, message="esc1 is slower")),
        *desk.process(raw("motor1", "updated", 3.0)),
        *desk.process(raw("motor1", "cleared", 4.0)),
        *desk.process(finding("updated", 5.0)),
        *desk.process(finding("cleared", 6.0)),
    ]
    assert [one.message for one in told[:-1]] == [
        own,
        f"{own}; esc1 is slow",
        f"{own}; esc1 is slower",
        "esc1 is slower",
        "esc1 is slow",
    ]
    assert states(told) == ["raised", "updated", "updated", "updated", "updated", "cleared"]
    assert [one.part for one in told] == [None, *["esc1"] * 5]
    assert {(one.channel, one.id) for one in told} == {("motor1", told[0].id)}
    assert told[-1].time_ns == at(6.0)
    assert desk.active == ()


def test_a_finding_that_is_over_first_leaves_the_alarm_and_what_it_named() -> None:
    desk = AlarmDesk("copter-1", DeskRule(), FINER)
    own = raw("motor1", "raised").message
    desk.process(raw("motor1", "raised"))
    (critical,) = desk.process(finding("raised", 1.0, severity="critical"))
    assert critical.severity == "critical"
    (alone,) = desk.process(finding("cleared", 2.0))
    assert (alone.message, alone.part) == (own, "esc1")
    assert states(desk.process(raw("motor1", "cleared", 3.0))) == ["cleared"]


def test_an_alarm_that_is_back_while_its_cause_is_still_named_goes_on() -> None:
    desk = AlarmDesk("copter-1", DeskRule(), FINER)
    desk.process(raw("motor1", "raised"))
    desk.process(finding("raised", 1.0))
    desk.process(raw("motor1", "cleared", 2.0))
    (again,) = desk.process(raw("motor1", "raised", 3.0, id="another"))
    assert (again.state, again.id) == ("updated", raw("motor1", "raised").id)
    assert desk.findings(("motors", "motor1")) == (("esc", "esc1"),)


def test_a_finding_about_another_motor_or_none_is_an_alarm() -> None:
    desk = AlarmDesk("copter-1", DeskRule(), FINER)
    desk.process(raw("motor2", "raised"))
    assert states(desk.process(finding("raised", 1.0))) == ["raised"]
    assert len(desk.active) == 2


def test_a_finding_is_raised_when_its_alarm_is_taken_out_of_service() -> None:
    desk = AlarmDesk("copter-1", DeskRule(), FINER)
    desk.process(raw("motor1", "raised"))
    desk.process(finding("raised", 1.0))
    told = desk.set_rule(DeskRule(out_of_service=frozenset({"motors/motor1"})), at(2.0))
    assert [(one.channel, one.state) for one in told] == [("motor1", "cleared"), ("esc1", "raised")]
