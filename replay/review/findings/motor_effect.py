"""A motor gave less or more than it gave at the begin of the flight."""

from __future__ import annotations

from collections.abc import Iterator

from replay.review.facts.log_facts import LogFacts
from replay.review.findings.learned_alarms import alarms_of
from replay.review.findings.rule import Judgement, Rule


def _judge(facts: LogFacts) -> Iterator[Judgement]:
    return alarms_of(
        facts,
        ("motor", "esc", "prop"),
        1.0,
        (
            "the same command gave another angular acceleration before",
            "wind and load move all motors' estimates together",
        ),
        ("motors", "attitude"),
    )


RULE = Rule(
    name="motor_effect",
    title="A motor gives less than it did",
    stage="motion",
    physics="Angular acceleration follows the motors' commands by a matrix that the first 40 s of the flight show; a "
    "motor that loses thrust leaves it, whatever the autopilot does to hold the vehicle.",
    evidence="the observer designed from that matrix raises an alarm of one motor for 5 s or longer",
    counter="what was so from the begin cannot be told from how the vehicle is built; shorter alarms",
    needs=("watch",),
    judge=_judge,
    multirotor=True,
)
