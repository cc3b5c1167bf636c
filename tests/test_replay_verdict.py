"""One sentence says what happened; silence of the autopilot is told only where the log would show its words."""

from __future__ import annotations

from loopback import START_NS
from synthetic_run import event

from monitor.trace import alarm_spans
from replay.reports.findings import Finding
from replay.reports.verdict import run_sentence
from replay.review.facts.log_facts import UNKNOWN_LEVEL, LogFacts, Statement

EVENTS = [event(1020, "raised", channel="motor1"), event(1300, "cleared", channel="motor1")]
[SPAN] = alarm_spans(EVENTS)
FOUND = Finding(SPAN, EVENTS[0], None, None, False, None, None, "motor1 delivers 5 % less than commanded", None)
ONSET_S = 10.2


def facts(*said: Statement) -> LogFacts:
    return LogFacts("ArduPilot", "multirotor", START_NS, 60.0, (), (), {}, said)


def test_what_when_and_how_many_more() -> None:
    said = run_sentence([FOUND, FOUND], None)
    assert said.startswith("motor1 delivers 5 % less than commanded from ")
    assert said.endswith(" on for 2.8 s; 1 other alarm")


def test_the_autopilot_s_warning_during_the_alarm_is_quoted_and_no_routine() -> None:
    routine = Statement(ONSET_S + 1.0, "text", "Mission: 3 WP", 6)
    before = Statement(ONSET_S - 5.0, "text", "GPS Glitch", 2)
    during = Statement(ONSET_S + 2.0, "text", "Thrust Loss (2)", 2)
    assert run_sentence([FOUND], facts(routine, before, during)).endswith("the autopilot said “Thrust Loss (2)”")
    assert run_sentence([FOUND], facts(routine, before)).endswith("the autopilot said nothing")


def test_a_log_that_does_not_say_how_severe_its_texts_are_tells_failsafes_and_no_silence() -> None:
    text = Statement(ONSET_S + 1.0, "text", "EKF3 lane switch 1", UNKNOWN_LEVEL)
    failsafe = Statement(ONSET_S + 1.0, "failsafe", "GPS (code 2)", 1)
    assert "autopilot" not in run_sentence([FOUND], facts(text))
    assert "autopilot" not in run_sentence([FOUND], facts())
    assert run_sentence([FOUND], facts(text, failsafe)).endswith("the autopilot said “GPS (code 2)”")
