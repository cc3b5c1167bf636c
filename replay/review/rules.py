"""The findings that a review looks for, in the order of causes."""

from __future__ import annotations

from typing import Final

from replay.review.findings import (
    actuator_effect,
    attitude_not_followed,
    commanded,
    descent_not_followed,
    estimator_reset,
    failsafe,
    gps_lost,
    gps_stuck,
    innovations_refused,
    motor_at_limit,
    power,
    sensor_effect,
    turned_over,
    vibration,
)
from replay.review.findings.rule import Rule

RULES: Final[tuple[Rule, ...]] = (
    *commanded.RULES,
    *power.RULES,
    motor_at_limit.RULE,
    actuator_effect.RULE,
    descent_not_followed.RULE,
    turned_over.RULE,
    attitude_not_followed.RULE,
    gps_lost.RULE,
    gps_stuck.RULE,
    sensor_effect.RULE,
    vibration.RULE,
    innovations_refused.RULE,
    estimator_reset.RULE,
    failsafe.RULE,
)
