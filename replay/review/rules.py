"""The findings that a review looks for, in the order of causes."""

from __future__ import annotations

from typing import Final

from replay.review.findings import commanded, estimator, motion, power, sensors
from replay.review.findings.rule import Rule

RULES: Final[tuple[Rule, ...]] = (
    *commanded.RULES,
    *power.RULES,
    *motion.RULES,
    *sensors.RULES,
    *estimator.RULES,
)
