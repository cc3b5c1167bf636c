"""A sensor no longer agreed with the others as it did at the begin of the flight."""

from math import inf

from replay.review.findings.learned_alarms import alarms_of
from replay.review.findings.rule import Rule

_OUTSIDE = 3.0
"""Ratio to the threshold from which an alarm is more than information. Measured on fifteen healthy flights learned from
their first 40 s: lasting alarms of GPS reach up to 1.9 times their threshold (wind that the begin did not have), and
no alarm of gyros and accelerometers lasts. Alarms of faults reach 3.2 times and more; smaller ones stay information."""


_CHANNELS = {("gyro_", "accel_"): 1.0, ("gps_", "baro", "motion_"): _OUTSIDE, ("compass",): inf}
"""Ratio to the threshold that an alarm has to reach, by the begin of the channel's name. An alarm of a compass stays
information: the compass error depends on the heading, and 40 s show few headings (14 degrees in a healthy flight
that turned)."""


RULE = Rule(
    title="A sensor disagrees with the others",
    stage="sensor",
    physics="Kinematics connect GPS, barometer, compass, gyros and accelerometers: the deviation of one from the "
    "others is estimated, with the noise of the flight's own first 40 s.",
    evidence="the observer raises an alarm of one sensor for 12 s, or until the flight ends; for GPS and barometer "
    "at 3 times the threshold",
    counter=(
        "it agreed with the other sensors at the begin of the flight, and those agree with each other now",
        "new wind moves the estimates of GPS: up to 2.5 m, its own accuracy, is no finding",
    ),
    needs=("watch",),
    plots=("height", "height_estimate", "ratios"),
    judge=lambda facts: alarms_of(facts, _CHANNELS),
)
