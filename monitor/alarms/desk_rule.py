"""What the alarm desk does with which channels, and the same as fields of a message."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

MAX_FLOOD = 1_000_000
"""Alarms and seconds that a rule may state. Chosen: what is beyond is a mistake in a recorded rule."""


@dataclass(frozen=True, slots=True)
class DeskRule:
    """What the desk does with which channels; a channel is written ``observer/channel``."""

    latched: frozenset[str] = frozenset()  # channels whose alarms stay until reset
    out_of_service: frozenset[str] = frozenset()  # channels that say nothing
    # number of alarms raised within ``flood_s`` seconds from which on there is a flood; 0: never
    flood_raised: int = 10
    flood_s: float = 60.0


def desk_rule(fields: Mapping[str, object], default: DeskRule) -> DeskRule:
    """Return the rule that a message's fields describe; what they lack or spell wrong stays as it is."""

    def names(key: str, before: frozenset[str]) -> frozenset[str]:
        found = fields.get(key)
        if not isinstance(found, Sequence) or isinstance(found, str):
            return before
        return frozenset(name for name in found if isinstance(name, str))

    raised, within = fields.get("flood_raised"), fields.get("flood_s")
    return DeskRule(
        latched=names("latched", default.latched),
        out_of_service=names("out_of_service", default.out_of_service),
        flood_raised=raised if isinstance(raised, int) and 0 <= raised <= MAX_FLOOD else default.flood_raised,
        flood_s=float(within) if isinstance(within, int | float) and 0 < within <= MAX_FLOOD else default.flood_s,
    )


def rule_fields(rule: DeskRule) -> dict[str, object]:
    """Return the fields that :func:`desk_rule` reads back."""
    return {
        "latched": sorted(rule.latched),
        "out_of_service": sorted(rule.out_of_service),
        "flood_raised": rule.flood_raised,
        "flood_s": rule.flood_s,
    }
