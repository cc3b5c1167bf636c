"""The findings that a review looks for, in the order of causes."""

from __future__ import annotations

from typing import Final

from replay.review.findings import (
    commanded,
    estimator_reset,
    failsafe,
    gps_lost,
    gps_stuck,
    innovations_refused,
    motion,
    power,
    sensor_effect,
    vibration,
)
from replay.review.findings.rule import Rule

RULES: Final[tuple[Rule, ...]] = (
    *commanded.RULES,
    *power.RULES,
    *motion.RULES,
    gps_lost.RULE,
    gps_stuck.RULE,
    sensor_effect.RULE,
    vibration.RULE,
    innovations_refused.RULE,
    estimator_reset.RULE,
    failsafe.RULE,
)
