"""A motor, a surface or the steering acted less or more than it did in the flight's other parts."""

from __future__ import annotations

from collections.abc import Iterator

from replay.review.facts.log_facts import LogFacts
from replay.review.findings.learned_alarms import alarms_of
from replay.review.findings.rule import Judgement, Rule


def _judge(facts: LogFacts) -> Iterator[Judgement]:
    return alarms_of(
        facts,
        ("motor", "esc", "prop", "aileron", "elevator", "rudder", "throttle", "steering"),
        1.0,
        ("the same command had another effect before", "wind and load move the estimates of all actuators together"),
        ("motors", "attitude", "airspeed"),
    )


RULE = Rule(
    name="actuator_effect",
    title="An actuator does less than it did",
    stage="motion",
    physics="Motion follows commands as the first 40 s of the flight show: a copter's angular acceleration follows its "
    "motors, a plane's body rates follow its surfaces times the dynamic pressure, its thrust (forward specific force "
    "and drag) the throttle, a rover's yaw rate its steering times the speed. An actuator that fails leaves that, "
    "whatever the autopilot does to hold the vehicle.",
    evidence="the observer designed from that model raises an alarm of one actuator until the flight ends, or for 12 s",
    counter="what was so from the begin cannot be told from how the vehicle is built; shorter alarms; a size that no "
    "actuator can have, which says that what was learned does not hold",
    needs=("watch",),
    judge=_judge,
)
