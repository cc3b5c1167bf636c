"""The findings that a review looks for."""

from typing import Final

from replay.review.findings import (
    actuator_effect,
    attitude_contradicted,
    attitude_not_followed,
    battery_low,
    commands_from_outside,
    descent_not_followed,
    esc_stopped,
    estimator_reset,
    failsafe,
    gps_lost,
    gps_stuck,
    innovations_refused,
    log_ends_in_flight,
    motor_at_limit,
    motor_command_stopped,
    motors_stopped_in_air,
    position_altered,
    sensor_effect,
    turned_over,
    vibration,
)
from replay.review.findings.rule import Rule

RULES: Final[tuple[Rule, ...]] = tuple(
    finding.RULE for finding in (
        commands_from_outside, position_altered, motors_stopped_in_air,
        motor_command_stopped, battery_low, log_ends_in_flight, esc_stopped, motor_at_limit, actuator_effect,
        descent_not_followed, turned_over, attitude_not_followed, gps_lost, gps_stuck, sensor_effect,
        vibration, attitude_contradicted, innovations_refused, estimator_reset, failsafe,
    )
)  # fmt: skip
