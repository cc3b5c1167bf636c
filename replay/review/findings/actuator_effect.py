"""A motor, a surface or the steering had less or more effect than in the other parts of the flight."""

from replay.review.findings.learned_alarms import alarms_of
from replay.review.findings.rule import Rule

_ACTUATORS = "motor", "esc", "prop", "aileron", "elevator", "rudder", "throttle", "steering"


RULE = Rule(
    title="An actuator does less than before",
    stage="motion",
    physics="The first 40 s of the flight show how motion follows commands: a copter's angular acceleration follows "
    "its motors, a plane's body rates follow its surfaces times the dynamic pressure, its thrust (forward specific "
    "force and drag) the throttle, a rover's yaw rate its steering times the speed. After a failure an actuator no "
    "longer follows, whatever the autopilot does to hold the vehicle.",
    evidence="the observer designed from that model raises an alarm of one actuator for 12 s, or until the flight ends",
    counter=(
        "the same command had another effect before: a difference from the begin on belongs to the vehicle",
        "wind and load move the estimates of all actuators together, hard turns those of one for some seconds",
        "an impossible size shows that the learned model does not fit, and is not reported",
    ),
    needs=("watch",),
    plots=("motors", "attitude", "airspeed"),
    judge=lambda facts: alarms_of(facts, {_ACTUATORS: 1.0}),
)
