"""Alarm sentences: which part, what is wrong with it, by how much, in words a pilot knows."""

import pytest

from monitor.alarms.alarm import DEFLECTION, alarm_message
from monitor.event import Kind


@pytest.mark.parametrize(
    ("channel", "kind", "unit", "size", "relative", "sentence"),
    [
        ("motor2", "actuator", "fraction of full command", -0.1, -0.15, "motor2 delivers 15 % less than commanded"),
        ("steering", "actuator", DEFLECTION, -0.1, -0.5, "steering turns 50 % less than commanded"),
        ("throttle", "actuator", DEFLECTION, -0.1, -0.2, "throttle pushes 20 % less than commanded"),
        ("aileron", "actuator", DEFLECTION, -0.1, -0.2, "aileron has 20 % less effect than commanded"),
        ("aileron", "actuator", DEFLECTION, 0.1, 0.2, "aileron has 20 % more effect than commanded"),
        ("rudder", "actuator", DEFLECTION, 0.1, None, "rudder is 10 % of full deflection off its command"),
        ("gps_north", "sensor", "m", 12.0, None, "GPS is 12 m north of where the inertial sensors say"),
        ("gps_east", "sensor", "m", -3.21, None, "GPS is 3.21 m west of where the inertial sensors say"),
        ("gps_down", "sensor", "m", -4.0, None, "GPS is 4 m above where the inertial sensors say"),
        ("gps_velocity_east", "sensor", "m/s", 1.5, None, "GPS velocity is 1.5 m/s too much east"),
        (
            "motion_north",
            "sensor",
            "m/s",
            -1.2,
            None,
            "GPS velocity and accelerations differ by 1.2 m/s south: GPS, accelerometer, gyro or attitude is wrong; "
            "which one cannot be told",
        ),
        ("baro", "sensor", "m", 8.0, None, "barometer reads 8 m too high"),
        ("compass", "sensor", "rad", -0.3491, None, "compass is 20 degrees too far anticlockwise"),
        ("compass", "sensor", "rad", 7.1733, None, "compass is 51 degrees too far clockwise"),
        ("gyro_x", "sensor", "rad/s", 0.08, None, "gyro x reads 4.58 degrees/s too much"),
        ("airspeed", "sensor", "m/s", -2.5, None, "airspeed reads 2.5 m/s too slow"),
        ("encoder", "sensor", "rad", 2.0, None, "encoder reads +115 degrees off"),
        ("pump", "actuator", "bar", -1.5, None, "pump is off by -1.5 bar"),
        ("unexplained", "residual", "", 7.0, None, "o: no known fault explains what is measured (7 times healthy)"),
    ],
)
def test_a_sentence_names_part_direction_and_size(
    channel: str, kind: Kind, unit: str, size: float, relative: float | None, sentence: str
) -> None:
    assert alarm_message("o", channel, kind, unit, "raised", size, relative) == sentence


def test_a_cleared_alarm_says_so() -> None:
    assert alarm_message("o", "baro", "sensor", "m", "cleared", 0.1, None) == "baro is back to normal"
