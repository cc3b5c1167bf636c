"""A motor, a surface or the steering acted less or more than it did in the flight's other parts."""

from __future__ import annotations

from replay.review.findings.learned_alarms import alarms_of
from replay.review.findings.rule import Rule

_ACTUATORS = "motor", "esc", "prop", "aileron", "elevator", "rudder", "throttle", "steering"


RULE = Rule(
    title="An actuator does less than it did",
    stage="motion",
    physics="Motion follows commands as the first 40 s of the flight show: a copter's angular acceleration follows its "
    "motors, a plane's body rates follow its surfaces times the dynamic pressure, its thrust (forward specific force "
    "and drag) the throttle, a rover's yaw rate its steering times the speed. An actuator that fails leaves that, "
    "whatever the autopilot does to hold the vehicle.",
    evidence="the observer designed from that model raises an alarm of one actuator until the flight ends, or for 12 s",
    counter=(
        "the same command had another effect before: what was so from the begin is how the vehicle is built",
        "wind and load move the estimates of all actuators together, hard turns those of one for some seconds",
        "a size that no actuator can have says that what was learned does not hold, and is not stated",
    ),
    needs=("watch",),
    plots=("motors", "attitude", "airspeed"),
    judge=lambda facts: alarms_of(facts, {_ACTUATORS: 1.0}),
)
