"""A sensor no longer agreed with the others as it did at the begin of the flight."""

from __future__ import annotations

from math import inf

from replay.review.findings.learned_alarms import alarms_of
from replay.review.findings.rule import Rule

_OUTSIDE = 3.0
"""Measured on fifteen healthy flights learned from their first 40 s: alarms of GPS that last come up to 1.9 times their
threshold (wind that the begin did not have), of gyros and accelerometers none lasts. Of faults they are 3.2 times and
more; smaller ones stay information."""


_CHANNELS = {("gyro_", "accel_"): 1.0, ("gps_", "baro", "motion_"): _OUTSIDE, ("compass",): inf}
"""How many times its threshold an alarm has to be, by the begin of the channel's name. Of a compass it stays
information: its error goes with the heading, of which 40 s show a few (14 degrees in a healthy flight that turned)."""


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
