"""What a review learns from the flight itself, as its page draws it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic_run import START_NS, event, trace

from replay.player import Replay
from replay.review.facts.log_facts import LearnedAlarm, LogFacts
from replay.review.learning import _alarms, _estimate


def test_an_estimate_is_drawn_in_the_unit_of_its_alarm_s_sentence() -> None:
    run = trace()
    facts = LogFacts("ArduPilot", "multirotor", 0, 15.0, (), (), {})
    drawn = _estimate([run], LearnedAlarm(10.0, 15.0, "motors", "motor1", 1.0, ""), facts)
    assert drawn is not None
    assert drawn.unit == "% of full thrust"
    assert np.nanmin(drawn.values) == pytest.approx(100.0 * run.isolated[run.armed, 0].min())


def test_an_alarm_lasts_no_longer_than_anything_is_seen_of_it() -> None:
    """A plane that lands is too slow for its surfaces: their alarm stands, and nothing speaks for it."""
    run = trace()
    seen = replace(run, armed=run.armed & (run.vehicle_ns < 11_000_000_000))
    facts = LogFacts("ArduPilot", "plane", START_NS, 15.0, (), ((0.0, 15.0),), {})
    (alarm,) = _alarms(Replay(events=(event(1000, "raised"),), traces=(seen,)), facts, 5.0)
    assert (alarm.start_s, alarm.end_s) == (pytest.approx(10.0), pytest.approx(11.0, abs=0.02))


def test_a_finding_begins_where_its_estimate_left_what_is_usual() -> None:
    run = trace()
    isolated = np.random.default_rng(1).normal(scale=1e-3, size=run.isolated.shape)
    isolated[run.unix_ns >= START_NS + 13_200_000_000] = -0.02
    facts = LogFacts("ArduPilot", "multirotor", START_NS, 15.0, (), ((0.0, 15.0),), {})
    raised = Replay(events=(event(1400, "raised"),), traces=(replace(run, isolated=isolated),))
    (alarm,) = _alarms(raised, facts, 5.0)
    assert (alarm.onset_s, alarm.start_s) == (pytest.approx(13.2, abs=0.02), pytest.approx(14.0))


def test_the_size_of_an_alarm_is_the_one_that_lasted() -> None:
    facts = LogFacts("PX4", "multirotor", START_NS, 15.0, (), ((0.0, 15.0),), {})
    sizes = [(1000, "raised", -0.01), (1001, "updated", -0.02), (1050, "updated", -0.03), (1480, "cleared", 0.0)]
    events = tuple(event(tick, state, estimate=size) for tick, state, size in sizes)
    (alarm,) = _alarms(Replay(events=events, traces=(trace(),)), facts, 5.0)
    assert alarm.size == 0.03
