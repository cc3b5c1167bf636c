"""Alarms that another one explains: a gyro jump tilts the attitude, and the tilt looks like a GPS that speeds away."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adapters.errors import ProfileError
from monitor.event import AlarmEvent
from monitor.tables import Table


@dataclass(frozen=True, slots=True)
class ExcuseRule:
    """While one of these alarms stands, and for some time after, evidence on those channels speaks for nothing new.

    Parameters
    ----------
    channels : tuple[str, ...]
        Channels that are excused.
    by : tuple[str, ...]
        Channels whose alarms excuse them.
    for_s : float
        How long after such an alarm has cleared, seconds.
    """

    channels: tuple[str, ...]
    by: tuple[str, ...]
    for_s: float


class Excuses:
    """Follows a vehicle's alarms.

    Parameters
    ----------
    rules : Sequence[ExcuseRule]
        The profile's rules.
    """

    def __init__(self, rules: Sequence[ExcuseRule]) -> None:
        self._rules: dict[str, list[ExcuseRule]] = {}
        for rule in rules:
            for channel in rule.channels:
                self._rules.setdefault(channel, []).append(rule)
        self._active: dict[str, set[str]] = {}
        self._cleared_ns: dict[str, int] = {}

    def note(self, event: AlarmEvent) -> None:
        """Take an event of any channel."""
        standing = self._active.setdefault(event.channel, set())
        if event.state == "cleared":
            standing.discard(event.id)
            self._cleared_ns[event.channel] = event.vehicle_time_ms * 1_000_000
        else:
            standing.add(event.id)

    def touched(self, cause: str) -> frozenset[str]:
        """Return the channels whose excuse depends on alarms of ``cause``."""
        return frozenset(name for name, rules in self._rules.items() if any(cause in rule.by for rule in rules))

    def excused_rows(self, channel: str, vehicle_times_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return :meth:`excused` for many times at once, as long as no event is noted."""
        found = np.zeros(len(vehicle_times_ns), np.bool_)
        for rule in self._rules.get(channel, ()):
            for cause in rule.by:
                if self._active.get(cause):
                    found[:] = True
                elif (cleared_ns := self._cleared_ns.get(cause)) is not None:
                    since = vehicle_times_ns - cleared_ns
                    found |= (since >= 0) & (since <= rule.for_s * 1e9)
        return found

    def excused(self, channel: str, vehicle_time_ns: int) -> bool:
        """Return whether a channel's evidence at a time is explained by another alarm."""
        for rule in self._rules.get(channel, ()):
            for cause in rule.by:
                cleared_ns = self._cleared_ns.get(cause)
                if self._active.get(cause) or (
                    cleared_ns is not None and 0 <= vehicle_time_ns - cleared_ns <= rule.for_s * 1e9
                ):
                    return True
        return False


def read_excuses(tables: Iterable[Table], known: Sequence[str]) -> tuple[ExcuseRule, ...]:
    """Return the rules of a profile whose alarm channels are ``known``.

    Raises
    ------
    ProfileError
        A rule names a channel that has no alarm, or excuses a channel by itself.
    """
    rules = []
    for table in tables:
        rule = ExcuseRule(table.texts("channels", ()), table.texts("by", ()), table.number("for_s", 0.0, at_least=0.0))
        table.done()
        for key, names in (("channels", rule.channels), ("by", rule.by)):
            if not names or (strange := [name for name in names if name not in known]):
                found = f"names '{strange[0]}', which has no alarm" if names else "is empty"
                raise ProfileError(f"{table.where(key)} {found}; alarms are {', '.join(known)}")
        if both := set(rule.channels) & set(rule.by):
            raise ProfileError(f"{table.where('by')}: '{min(both)}' would excuse itself")
        rules.append(rule)
    return tuple(rules)


def excuse_tables(rules: Sequence[ExcuseRule]) -> list[dict[str, Any]]:
    """Return the tables that :func:`read_excuses` reads back as the same rules."""
    return [{"channels": list(rule.channels), "by": list(rule.by), "for_s": rule.for_s} for rule in rules]
