"""The findings that a review looks for, in the order of causes."""

from __future__ import annotations

from typing import Final

from replay.review.findings import (
    commanded,
    estimator_reset,
    failsafe,
    innovations_refused,
    motion,
    power,
    sensors,
)
from replay.review.findings.rule import Rule

RULES: Final[tuple[Rule, ...]] = (
    *commanded.RULES,
    *power.RULES,
    *motion.RULES,
    *sensors.RULES,
    innovations_refused.RULE,
    estimator_reset.RULE,
    failsafe.RULE,
)
