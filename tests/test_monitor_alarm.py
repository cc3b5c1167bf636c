"""The alarm state machine: its paths, debounce by time, hysteresis, severity, latching, updates, identity."""

import json
import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from adapters.sample import Samples
from monitor.alarms.alarm import Alarm, AlarmRule, retuned
from monitor.core.alarms import CLEARED, ChainRows, Weighing, walk
from monitor.event import AlarmEvent, event_from_json

STEP_NS = 10_000_000
RULE = AlarmRule(
    observer="motors",
    channel="motor1",
    kind="actuator",
    unit="fraction of full command",
    threshold=0.02,
    clear=0.01,
    critical=0.15,
    raise_s=0.15,
    clear_s=0.5,
)


def new_alarm(rule: AlarmRule = RULE) -> Alarm:
    return Alarm(rule, "copter-1")


def process(
    alarm: Alarm,
    evidence: NDArray[np.float64],
    times_ns: NDArray[np.int64],
    *,
    restart: NDArray[np.bool_] | None = None,
    speaking: NDArray[np.bool_] | None = None,
    unix_minus_vehicle_ns: int = 10**18,
    relative: float | None = None,
    sd: NDArray[np.float64] | None = None,
    noise: NDArray[np.float64] | None = None,
    commands: NDArray[np.float64] | None = None,
    rival: NDArray[np.intp] | None = None,
    frozen: NDArray[np.bool_] | None = None,
) -> list[AlarmEvent]:
    """Return the events of one batch of evidence; the command is 0.5 unless the share or ``commands`` are given."""
    count = len(evidence)
    restart = np.zeros(count, np.bool_) if restart is None else restart
    speaking = np.ones(count, np.bool_) if speaking is None else speaking
    always, nothing = np.ones(count, np.bool_), np.zeros((count, 0))
    unix_ns = times_ns + unix_minus_vehicle_ns
    samples = Samples(
        np.arange(count), times_ns, unix_ns, nothing, nothing, restart, always, times_ns, always, nothing > 0
    )
    column = [None if one is None else one[:, None] for one in (sd, noise, commands)]
    rows = ChainRows(
        [alarm.state],
        np.arange(count),
        times_ns,
        restart,
        evidence[:, None],
        speaking[:, None],
        sd=column[0],
        noise=column[1],
        command=column[2],
        rival=None if rival is None else rival[:, None],
        frozen=None if frozen is None else frozen[:, None],
    )
    events: list[AlarmEvent] = []

    def on_event(_observer: int, row: int, _alarm: int, code: int) -> None:
        command = 0.5 if commands is None else float(commands[row])
        instead = f"motor{alarm.state.rival}" if alarm.state.rival >= 0 and code != CLEARED else None
        command_of = command if relative is None else None
        events.append(alarm.event(code, samples, row, command_of, relative, instead=instead))

    walk([rows], on_event)
    return events


def run(alarm: Alarm, values: list[float], start: int = 0, restart_first: bool = False) -> list[AlarmEvent]:
    evidence = np.array(values, np.float64)
    restart = np.zeros(len(evidence), np.bool_)
    restart[:1] = restart_first
    return process(alarm, evidence, (start + np.arange(len(evidence))) * STEP_NS, restart=restart)


def pause(alarm: Alarm) -> None:
    """Let a row pass that is no evidence."""
    process(alarm, np.zeros(1), np.zeros(1, np.int64), speaking=np.zeros(1, np.bool_))


def test_evidence_that_stands_shorter_than_the_debounce_raises_nothing() -> None:
    assert run(new_alarm(), [0.05] * 14 + [0.0] * 100) == []


def test_evidence_that_stands_raises_once_and_clears_once_with_the_same_id() -> None:
    events = run(new_alarm(), [0.0] * 10 + [-0.05] * 100 + [0.0] * 100)
    assert [event.state for event in events] == ["raised", "cleared"]
    raised, cleared = events
    assert raised.id == cleared.id
    assert len(raised.id) == 26
    assert raised.vehicle_time_ms == (10 + 14) * 10
    assert cleared.vehicle_time_ms == (110 + 49) * 10
    assert raised.since_ns == cleared.since_ns == raised.time_ns
    assert raised.message == "motor1 delivers 10 % less than commanded"
    assert cleared.message == "motor1 is back to normal"


def test_a_frozen_sensor_is_raised_at_once_and_clears_after_its_end_whatever_its_size() -> None:
    frozen = np.zeros(1000, np.bool_)
    frozen[100:600] = True
    events = process(new_alarm(), np.zeros(1000), np.arange(1000) * STEP_NS, frozen=frozen)
    assert [event.state for event in events] == ["raised", "cleared"]
    assert events[0].message == "motor1: frozen, it repeats one reading exactly"
    assert [event.vehicle_time_ms for event in events] == [1000, (600 + 49) * 10]


def test_a_sensor_that_freezes_beside_another_active_alarm_raises_nothing() -> None:
    other, frozen = new_alarm(), new_alarm()
    count = 400
    times_ns, always = np.arange(count) * STEP_NS, np.ones((count, 2), np.bool_)
    evidence, stands = np.zeros((count, 2)), np.zeros((count, 2), np.bool_)
    evidence[:, 0], stands[100:, 1] = 0.05, True
    codes: list[int] = []
    rows = ChainRows(
        [other.state, frozen.state], np.arange(count), times_ns, ~always[:, 0], evidence, always, frozen=stands
    )
    walk([rows], lambda _observer, _row, alarm, _code: codes.append(alarm))
    assert set(codes) == {0}


def test_evidence_between_clear_and_threshold_neither_raises_nor_clears() -> None:
    assert run(new_alarm(), [0.015] * 300) == []
    events = run(new_alarm(), [0.05] * 20 + [0.015] * 500)
    assert [event.state for event in events] == ["raised", "updated"]


def test_a_dropped_sample_of_evidence_delays_the_alarm_instead_of_losing_it() -> None:
    values = ([0.05] * 4 + [0.0]) * 10
    assert run(new_alarm(), values)[0].state == "raised"


def test_severity_rises_at_once_and_does_not_fall_back() -> None:
    events = run(new_alarm(), [-0.05] * 20 + [-0.2] * 5 + [-0.05] * 400)
    assert [(event.state, event.severity) for event in events][:2] == [
        ("raised", "warning"),
        ("updated", "critical"),
    ]
    assert all(event.severity == "critical" for event in events[1:])
    assert events[-1].peak == -0.2


def test_a_constant_share_of_a_command_that_changes_is_no_update() -> None:
    times = np.arange(600) * STEP_NS
    commands = np.where(times < 3_000_000_000, 0.6, 0.3)
    events = process(new_alarm(), -0.1 * commands, times, commands=commands)
    assert [event.state for event in events] == ["raised"]
    share = np.where(times < 3_000_000_000, -0.1, -0.2)
    events = process(new_alarm(), share * commands, times, commands=commands)
    assert [event.message for event in events] == [
        "motor1 delivers 10 % less than commanded",
        "motor1 delivers 20 % less than commanded",
    ]


def test_a_size_that_moves_less_than_three_standard_deviations_is_no_update() -> None:
    times = np.arange(600) * STEP_NS
    manoeuvre = times >= 3_000_000_000
    evidence, sd = np.where(manoeuvre, -0.07, -0.05), np.where(manoeuvre, 0.015, 0.001)
    assert [event.state for event in process(new_alarm(), evidence, times, sd=sd)] == ["raised"]
    sd[:] = 0.006  # of either size, so that of their difference is 0.0085
    assert [event.state for event in process(new_alarm(), evidence, times, sd=sd)] == ["raised"]
    sd[:] = 0.001
    assert [event.state for event in process(new_alarm(), evidence, times, sd=sd)] == ["raised", "updated"]


def test_an_edge_below_its_own_noise_raises_nothing_and_one_that_has_just_moved_is_raised_at_once() -> None:
    times, evidence, sd = np.arange(600) * STEP_NS, np.full(600, -0.07), np.full(600, 0.1)
    edge = new_alarm(replace(RULE, raise_s=0.0, fast=math.inf, slow=math.inf))
    assert process(edge, evidence, times, sd=sd, noise=np.full(600, 0.08)) == []
    assert [event.state for event in process(edge, evidence, times, sd=sd, noise=np.full(600, 0.06))] == ["raised"]


def test_an_alarm_says_which_channel_it_may_be_instead_until_the_two_are_told_apart() -> None:
    evidence, rival = np.full(400, 0.05), np.repeat([4, 5, -1, -1], 100)
    events = process(new_alarm(), evidence, np.arange(400) * STEP_NS, rival=rival)
    assert [event.instead for event in events[:3]] == ["motor4", "motor5", None]
    assert "it may be motor4 instead" in events[0].message
    assert "instead" not in events[2].message


def test_updates_come_at_most_once_a_second() -> None:
    values = [0.05] * 20 + [0.05 + 0.001 * (k % 60) for k in range(1000)]
    events = run(new_alarm(), values)
    times = [event.vehicle_time_ms for event in events]
    assert len(events) > 2
    assert min(b - a for a, b in pairwise(times)) >= 1000


def test_pausing_freezes_the_debounce() -> None:
    alarm = new_alarm()
    assert run(alarm, [0.05] * 14) == []
    pause(alarm)
    assert run(alarm, [0.05], start=1000) == []
    assert [event.state for event in run(alarm, [0.05] * 3, start=1001)] == ["raised"]


def test_an_event_survives_its_json_form() -> None:
    event = run(new_alarm(), [0.05] * 30)[0]
    assert event_from_json(event.to_json()) == event


def test_a_large_fault_takes_the_fast_path() -> None:
    rule = replace(RULE, fast=0.1, fast_s=0.05)
    (event,) = run(new_alarm(rule), [0.0] * 10 + [0.12] * 12)
    assert event.vehicle_time_ms == (10 + 4) * 10
    assert event.threshold == 0.1
    assert run(new_alarm(rule), [0.0] * 10 + [0.09] * 12) == []


def test_a_small_fault_that_stays_takes_the_slow_path_and_clears_with_its_mean() -> None:
    rule = replace(RULE, slow=0.005, slow_s=1.0)
    raised, *_, cleared = run(new_alarm(rule), [-0.008] * 200 + [0.0] * 400)
    assert raised.state == "raised"
    assert raised.estimate == pytest.approx(-0.005, abs=1e-4)
    assert raised.vehicle_time_ms == pytest.approx(-1000 * np.log(1 - 5 / 8), abs=20)
    assert cleared.state == "cleared"
    assert run(new_alarm(rule), [0.004, -0.004] * 500) == []


LASTING = replace(RULE, lasting=0.005, lasting_s=4.0)


def test_a_small_fault_that_lasts_for_all_of_a_flight_is_raised_by_its_mean_and_stands_as_long() -> None:
    noise = np.tile([-0.009, 0.009], 1500)
    raised, *_, cleared = run(new_alarm(LASTING), [*(noise[:1000] - 0.006), *noise[1000:]])
    assert (raised.state, raised.vehicle_time_ms) == ("raised", 4000)
    assert raised.estimate == pytest.approx(-0.006, abs=0.002)
    assert cleared.state == "cleared"
    assert cleared.vehicle_time_ms > 20_000
    assert run(new_alarm(LASTING), noise.tolist()) == []


def test_a_large_fault_that_was_seen_and_ended_is_forgotten_by_the_mean() -> None:
    events = run(new_alarm(LASTING), [-0.05] * 600 + [0.0] * 1000)
    assert [event.state for event in events if event.state != "updated"] == ["raised", "cleared"]


def raised_at_scale(rule: AlarmRule, evidence: NDArray[np.float64], scale: NDArray[np.float64]) -> AlarmEvent:
    """Return the only event that evidence causes whose sizes have to be ``scale`` times as large."""
    alarm, count = new_alarm(rule), len(evidence)
    times_ns, always, nothing = np.arange(count) * STEP_NS, np.ones(count, np.bool_), np.zeros((count, 0))
    samples = Samples(
        np.arange(count), times_ns, times_ns, nothing, nothing, ~always, always, times_ns, always, nothing > 0
    )
    events: list[AlarmEvent] = []
    rows = ChainRows(
        [alarm.state], np.arange(count), times_ns, ~always, evidence[:, None], always[:, None], scale[:, None]
    )
    walk([rows], lambda _observer, row, _alarm, code: events.append(alarm.event(code, samples, row, 0.5)))
    (raised,) = events
    return raised


def test_what_lasts_counts_per_the_scale_of_its_sizes_and_is_shown_as_it_is() -> None:
    # twice the scale at the end: what was asked for all along is shown, not what is now
    scale = np.where(np.arange(500) < 400, 5.0, 10.0)
    raised = raised_at_scale(LASTING, -0.006 * scale, scale)
    assert raised.estimate == pytest.approx(-0.03, rel=0.01)
    assert (raised.threshold, raised.creeping) == (pytest.approx(0.025, rel=0.01), True)


def test_what_the_slow_mean_raises_is_shown_with_its_whole_size() -> None:
    rule = replace(RULE, slow=0.005, slow_s=1.0, threshold=0.06, clear=0.03, critical=1.0)
    # five times twice ``slow``, with which evidence enters the mean that decides
    raised = raised_at_scale(rule, np.full(80, -0.25), np.full(80, 5.0))
    assert raised.estimate == pytest.approx(-0.25 * (1.0 - 0.5), rel=0.02)
    assert (raised.threshold, raised.creeping) == (pytest.approx(0.025), True)


def test_an_alarm_that_comes_and_goes_is_active_until_it_was_quiet_for_longer_than_before() -> None:
    rule = replace(RULE, latch_s=20.0)
    burst = [-0.05] * 30 + [0.0] * 200
    events = run(new_alarm(rule), burst * 5 + [0.0] * 2500)
    states = [event.state for event in events]
    assert states == ["raised", "cleared", "raised", "cleared", "raised", *["updated"] * 5, "cleared"]
    assert events[4].message.endswith("less than commanded (it comes and goes)")
    # in each pause what is seen now is said, and one longer than those before ends it
    assert [event.estimate for event in events[5:]] == [0.0, -0.05, 0.0, -0.05, 0.0, 0.0]
    assert events[9].message == "motor1: nothing is seen of it now (it comes and goes)"
    quiet_ms = events[10].vehicle_time_ms - (5 * len(burst) - 200) * STEP_NS // 1_000_000
    assert 2_000 < quiet_ms - 1_000 * RULE.clear_s < 2_200
    assert len([event for event in run(new_alarm(), burst * 5) if event.state == "raised"]) == 5
    # a size that passes through zero is that of one fault
    events = run(new_alarm(rule), (burst + [-size for size in burst]) * 5)
    assert [event.state for event in events] == ["raised", "cleared"] * 10


def test_an_alarm_whose_raises_were_forged_clears_as_if_it_had_been_raised_once() -> None:
    alarm, burst = new_alarm(replace(RULE, latch_s=20.0)), [-0.05] * 30 + [0.0] * 100
    assert run(alarm, burst * 3)[-1].recurring
    alarm.state.forget_recurrences()
    assert [event.state for event in run(alarm, [0.0] * 100, start=390)] == ["cleared"]


def test_a_fault_that_was_let_go_is_not_said_to_be_gone() -> None:
    alarm, one, none = new_alarm(), np.ones(1, np.int64), np.zeros((1, 0))
    run(alarm, [-0.05] * 30)
    samples = Samples(one, one, one, none, none, one < 0, one > 0, one, one > 0, none > 0)
    assert alarm.event(CLEARED, samples, 0).message == "motor1 is back to normal"
    assert "whether the fault is gone is not known" in alarm.event(CLEARED, samples, 0, let_go=True).message


@given(st.lists(st.floats(-1, 1, allow_nan=False), max_size=400))
def test_events_alternate_between_raised_and_cleared_whatever_comes(values: list[float]) -> None:
    events = run(new_alarm(), values)
    states = [event.state for event in events if event.state != "updated"]
    assert states == (["raised", "cleared"] * len(states))[: len(states)]
    for event in events:
        if event.state == "raised":
            assert abs(event.estimate or 0.0) >= RULE.threshold


def test_a_share_that_is_known_by_itself_is_reported_as_it_is() -> None:
    (raised,) = process(new_alarm(), np.full(20, -0.05), np.arange(20) * STEP_NS, relative=-0.3)
    assert (raised.estimate, raised.relative) == (-0.05, -0.3)


def test_a_fault_that_grows_is_critical_before_it_is_large() -> None:
    events = run(new_alarm(), [-0.0002 * k for k in range(600)])
    critical = next(event for event in events if event.severity == "critical")
    assert critical.state == "updated"
    assert abs(critical.estimate or 0.0) < 0.12
    blind = run(new_alarm(replace(RULE, critical_ahead_s=0.0)), [-0.0002 * k for k in range(600)])
    assert {event.severity for event in blind} == {"warning"}


def test_an_observer_that_starts_anew_is_no_growth_of_the_fault() -> None:
    alarm = new_alarm()
    events = run(alarm, [0.08] * 500)
    events += run(alarm, [0.0] * 40, start=500, restart_first=True)
    events += run(alarm, [0.08] * 500, start=540)
    assert {event.severity for event in events} == {"warning"}


def at_times(alarm: Alarm, vehicle_s: float, unix_s: float, values: list[float], restart: bool) -> list[AlarmEvent]:
    times_ns = round(vehicle_s * 1e9) + np.arange(len(values)) * STEP_NS
    first = np.arange(len(values)) == (0 if restart else -1)
    offset_ns = round((unix_s - vehicle_s) * 1e9)
    return process(alarm, np.array(values), times_ns, restart=first, unix_minus_vehicle_ns=offset_ns)


@pytest.mark.parametrize("gone", [False, True])
def test_a_reboot_during_an_alarm_neither_loses_nor_mutes_it_nor_raises_it_twice(gone: bool) -> None:
    alarm = new_alarm()
    events = at_times(alarm, 1000, 5000, [0.05] * 100, restart=False)
    pause(alarm)
    events += at_times(alarm, 2, 5010, [0.0 if gone else 0.1] * 300, restart=True)
    if not gone:
        assert alarm.state.active
        events += at_times(alarm, 5, 5013, [0.0] * 100, restart=False)
    assert [event.state for event in events] == (["raised", "cleared"] if gone else ["raised", "updated", "cleared"])
    assert len({event.id for event in events}) == 1
    assert not alarm.state.active


def test_an_adopted_alarm_goes_on_under_its_id_and_clears() -> None:
    (raised,) = run(new_alarm(), [0.05] * 30)
    alarm = new_alarm()
    alarm.adopt(raised)
    assert alarm.state.active
    told = run(alarm, [0.05] * 300 + [0.1] * 100 + [0.0] * 100, start=1000)
    assert [event.state for event in told] == ["updated", "updated", "cleared"]
    assert {(event.id, event.since_ns) for event in told} == {(raised.id, raised.since_ns)}
    assert told[-1].peak == 0.1
    alarm.adopt(raised)
    alarm.adopt(replace(raised, state="cleared"))
    assert not alarm.state.active


def test_a_rule_takes_numbers_that_make_sense_and_leaves_the_rest() -> None:
    nonsense = {
        "threshold": "1",
        "clear": None,
        "critical": True,
        "raise_s": -1.0,
        "clear_s": float("nan"),
        "kind": "x",
    }
    assert retuned(RULE, nonsense) == RULE
    assert retuned(RULE, {"threshold": 1, "slow": 0.5}) == replace(RULE, threshold=1.0, slow=0.5)


def test_sizes_and_times_that_no_rule_can_have_change_nothing() -> None:
    odd = {"threshold": 10**400, "raise_s": math.nan, "slow_s": 0.0, "clear": -1, "critical": True, "fast": "1"}
    assert retuned(RULE, odd) == RULE
    assert retuned(RULE, {"threshold": 1, "slow": math.inf}) == replace(RULE, threshold=1.0)


def test_an_alarm_without_a_threshold_is_gone_on_from_with_the_rules_own() -> None:
    before = run(new_alarm(), [0.05] * 20)[0]
    alarm = new_alarm()
    alarm.adopt(replace(before, threshold=None))  # type: ignore[arg-type]
    events = run(alarm, [0.05] * 5 + [0.0] * 100)
    assert [(event.state, event.threshold) for event in events][-1] == ("cleared", RULE.threshold)


SLOW = replace(RULE, slow=0.008, slow_s=4.0, clear_s=0.5)


def handed_over(events: list[AlarmEvent], rule: AlarmRule) -> Alarm:
    """Return the alarm of a new process that goes on from the last event, as the journal has it."""
    alarm = new_alarm(rule)
    alarm.adopt(event_from_json(json.loads(json.dumps(events[-1].to_json()))))
    return alarm


@pytest.mark.parametrize("rule", [SLOW, replace(SLOW, slow=math.inf, lasting=0.008)])
def test_an_adopted_alarm_of_a_mean_stands_as_long_as_that_does(rule: AlarmRule) -> None:
    evidence = [0.009] * 2000
    before = run(new_alarm(rule), evidence)
    assert before[-1].creeping
    after = handed_over(before, rule)
    # a new process begins with an observer that starts anew
    assert run(after, [0.009], 2000, restart_first=True) == []
    assert run(after, evidence, 2001) == []
    *_, cleared = run(after, [0.0] * 4000, 4001)
    assert (cleared.state, cleared.id) == ("cleared", before[0].id)


def test_an_adopted_alarm_that_comes_and_goes_still_needs_its_long_quiet() -> None:
    rule = replace(RULE, latch_s=5.0)
    before = run(new_alarm(rule), ([0.05] * 20 + [0.0] * 60) * 2 + [0.05] * 20)
    assert before[-1].recurring
    after = handed_over(before, rule)
    (updated,) = run(after, [0.0] * 400, 200)
    assert (updated.state, updated.estimate) == ("updated", 0.0)
    (cleared,) = run(after, [0.0] * 200, 600)
    assert (cleared.state, cleared.id) == ("cleared", before[-1].id)


def streams(count: int) -> st.SearchStrategy[tuple[NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_]]]:
    def build(seed: int, loudness: float) -> tuple[NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_]]:
        rng = np.random.default_rng(seed)
        evidence = loudness * np.repeat(rng.normal(0, 1, count // 20 + 1), 20)[:count] + rng.normal(0, 0.2, count)
        evidence[rng.random(count) < 0.002] = rng.choice([np.nan, np.inf, -np.inf])
        speaking = np.repeat(rng.random(count // 10 + 1) < 0.9, 10)[:count]
        return evidence, speaking, rng.random(count) < 0.005

    return st.builds(build, st.integers(0, 2**32 - 1), st.sampled_from([0.1, 0.5, 1.0, 2.0]))


@given(stream=streams(600), cuts=st.lists(st.integers(0, 600), max_size=6), slow=st.sampled_from([0.2, 0.6, math.inf]))
def test_events_do_not_depend_on_where_batches_end(
    stream: tuple[NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_]], cuts: list[int], slow: float
) -> None:
    evidence, speaking, restart = stream
    rule = AlarmRule("motors", "motor1", "actuator", "1", 1.0, 0.6, 3.0, 0.05, 0.1, fast=2.0, slow=slow, slow_s=0.5)
    rule = replace(rule, lasting=slow / 2, lasting_s=0.5)
    whole, parts, times_ns = new_alarm(rule), new_alarm(rule), np.arange(600) * STEP_NS
    expected = process(whole, evidence, times_ns, restart=restart, speaking=speaking)
    events = []
    for a, b in pairwise([0, *sorted(cuts), 600]):
        part = slice(a, b)
        events += process(parts, evidence[part], times_ns[part], restart=restart[part], speaking=speaking[part])
    assert repr(events) == repr(expected)


def sudden(
    alarm: Alarm,
    rows: list[tuple[float, float, float]],
    onset: int = 0,
    start: int = 0,
    growth: float = 0.0,
    sd: tuple[float, float] = (np.nan, np.nan),
) -> list[AlarmEvent]:
    """Return the events of rows of evidence, nats and size of a change that began at sample ``onset``.

    ``sd`` is that of the change's size and that of the evidence.
    """
    evidence, nats, size = np.array(rows).T
    count = len(evidence)
    times_ns = (start + np.arange(count)) * STEP_NS
    always, nothing = np.ones(count, np.bool_), np.zeros((count, 0))
    samples = Samples(
        np.arange(count), times_ns, times_ns, nothing, nothing, ~always, always, times_ns, always, nothing > 0
    )
    onset_ns = np.full(count, onset * STEP_NS)
    changed = np.zeros(count, np.intp)
    found = [alarm.state], np.arange(count), times_ns, ~always, evidence[:, None], always[:, None]
    events: list[AlarmEvent] = []
    walk(
        [
            ChainRows(
                *found,
                None,
                changed,
                nats,
                size,
                np.full(count, growth),
                onset_ns,
                np.full(count, sd[0]),
                np.full((count, 1), sd[1]),
            )
        ],
        lambda _observer, row, _alarm, code: events.append(alarm.event(code, samples, row, 0.5)),
    )
    return events


SUDDEN = replace(RULE, nats=100.0, least=0.008)


@pytest.mark.parametrize(("sd", "updates"), [(0.004, [1000]), (0.006, [])])
def test_a_first_size_is_corrected_a_second_later_where_it_is_known_twice_as_well(
    sd: float, updates: list[int]
) -> None:
    events = sudden(new_alarm(SUDDEN), [(0.0, 100.0, -0.05), *[(-0.046, 0.0, 0.0)] * 400], sd=(0.01, sd))
    assert [event.state for event in events] == ["raised", *["updated"] * len(updates)]
    assert [event.vehicle_time_ms for event in events[1:]] == updates
    assert all((event.estimate, event.peak) == (-0.046, -0.046) for event in events[1:])


def test_a_sudden_change_that_is_certain_raises_at_once() -> None:
    (event,) = sudden(new_alarm(SUDDEN), [(0.0, 99.0, -0.05), (0.0, 100.0, -0.05), (0.0, 300.0, -0.06)])
    assert (event.state, event.estimate, event.vehicle_time_ms) == ("raised", -0.05, 10)


def test_a_sudden_change_that_is_too_small_for_an_alarm_raises_nothing() -> None:
    assert not sudden(new_alarm(SUDDEN), [(0.0, 1e4, -0.007)] * 5)


@pytest.mark.parametrize("size", [0.02, 0.1])
def test_no_path_raises_below_a_users_smallest_size(size: float) -> None:
    rule = replace(SUDDEN, fast=0.04, slow=0.01, slow_s=1.0, lasting=0.01, lasting_s=1.0, smallest=size)
    for below, above in ((0.9 * size, 1.1 * size), (-0.9 * size, -1.1 * size)):
        assert run(new_alarm(rule), [below] * 2000) == []
        assert [event.state for event in run(new_alarm(rule), [above] * 200)] == ["raised"]
    assert not sudden(new_alarm(rule), [(0.0, 1e4, -0.9 * size)] * 5)
    assert sudden(new_alarm(rule), [(0.0, 1e4, -1.1 * size)] * 5)[0].state == "raised"


def test_a_change_that_grows_to_an_alarms_size_raises_before_it_has_it() -> None:
    rows = [(0.0, 200.0, -0.003)] * 650
    assert not sudden(new_alarm(SUDDEN), rows, growth=-0.0009)
    events = sudden(new_alarm(SUDDEN), rows, growth=-0.0011)
    assert [(event.state, event.estimate) for event in events] == [("raised", -0.003)]


def test_an_estimate_that_raises_the_alarm_on_its_way_to_a_change_gives_the_changes_size() -> None:
    rows = [(-0.06, 50.0, -0.2)] * 20
    (event,) = sudden(new_alarm(SUDDEN), rows)
    assert (event.state, event.estimate) == ("raised", -0.2)
    (event,) = sudden(new_alarm(SUDDEN), [(-0.06, 50.0, 0.2)] * 20)
    assert (event.state, event.estimate) == ("raised", -0.06)


def test_a_change_to_more_than_commanded_waits_for_the_estimate() -> None:
    alarm = new_alarm(SUDDEN)
    assert not sudden(alarm, [(0.005, 1e4, 0.05)] * 5)
    assert sudden(alarm, [(0.012, 1e4, 0.05)], start=5)[0].state == "raised"


def test_a_change_that_has_been_reported_and_has_ended_is_not_raised_again() -> None:
    alarm = new_alarm(SUDDEN)
    events = sudden(alarm, [(-0.05, 200.0, -0.05)] * 20 + [(0.0, 200.0, -0.05)] * 80)
    assert [event.state for event in events] == ["raised", "cleared"]
    assert sudden(alarm, [(0.0, 200.0, -0.05)], onset=110, start=115)[0].state == "raised"


def test_a_sudden_change_that_no_estimate_shows_yet_waits_for_it_two_seconds() -> None:
    rows = [(0.0, 200.0, -0.05)] * 150
    assert [event.state for event in sudden(new_alarm(SUDDEN), rows)] == ["raised"]
    events = sudden(new_alarm(SUDDEN), rows * 2)
    assert [event.state for event in events] == ["raised", "cleared"]
    assert events[1].vehicle_time_ms == pytest.approx(2000 + 1000 * SUDDEN.clear_s, abs=20)


def test_a_fault_whose_uncertainty_is_known_does_not_count_larger_with_the_others() -> None:
    ones, yes, beyond = np.ones((1, 2)), np.ones((1, 2), np.bool_), np.array([[2.0, 1.0]])
    weighing = Weighing([0, 1], 3, np.ones((2, 1), np.bool_), np.array([0.5, 0.5]), [])
    _, _, scale, _ = weighing.run(
        ones, np.ones(1), yes[:, 0], yes, np.zeros((1, 1), np.bool_), np.ones(1), beyond, None
    )
    assert scale.tolist() == [[2.0, 1.0, 2.0]]
