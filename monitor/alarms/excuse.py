"""Alarms that another alarm explains: a gyro jump tilts the attitude, and the tilt looks like a GPS that drifts away.

While a channel is excused, its evidence raises no alarm. An alarm that is active already follows its evidence as usual:
it clears when the evidence is gone, or ends at once if the rule says that a consequence may be raised before its cause.

A fault may make evidence of a known size elsewhere: a gyro's bias b looks like a motor that lacks b (1 - a) / B, with
damping a and effect B. While its alarm is active, that much evidence raises no alarm.

If two observers watch one channel (a gyro, by the motors' and by the inertial observer), both see one fault: while the
alarm of one is active, the other raises none.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adapters.message import LATEST_NS
from adapters.toml_tables import Table
from monitor.alarms.alarm import LATELY_NS
from monitor.core.alarms import AlarmState
from monitor.estimation.bank import HOLD_S
from monitor.event import AlarmEvent

Affect = Callable[[str, int, int], AlarmEvent | None]
Withdraw = Callable[[int, int, str], AlarmEvent | None]


@dataclass(frozen=True, slots=True)
class ExcuseRule:
    """While an alarm of ``during`` is active, and for some time after, it explains the evidence on ``channels``."""

    channels: tuple[str, ...]  # channels that are excused
    by: tuple[str, ...]  # channels whose alarms excuse them
    for_s: float  # how long they are excused after such an alarm has cleared, seconds
    # whether these alarms name the same cause more exactly: an alarm that is raised while one of the channels has an
    # active alarm becomes part of that alarm (:mod:`monitor.alarms.desk`)
    same_cause: bool = False
    # whether an alarm of the channels may be raised before the alarm that explains it: one of the last 10 s then ends
    precedes: bool = False

    def among(self, alarms: Collection[str]) -> ExcuseRule:
        """Return the rules of these channels."""
        channels, by = (tuple(name for name in names if name in alarms) for names in (self.channels, self.by))
        return replace(self, channels=channels, by=by)


class Doubt(NamedTuple):
    """Why what an observer reads is not the vehicle's present motion."""

    affect: Affect  # lists a channel under the alarm that says so
    why: str  # text of alarms that end because of it
    since_ns: int  # alarms raised since this Unix time end
    whole: bool  # whether actuators are excused, too: what is measured of their effect is not true


class Excuses:
    """Follows a vehicle's alarms, and tells the alarms that they excuse by the profile's rules."""

    def __init__(self, rules: Sequence[ExcuseRule]) -> None:
        self._doubted: dict[AlarmState, Affect] = {}
        self._rules: dict[str, list[ExcuseRule]] = {}
        for rule in rules:
            for channel in rule.channels:
                self._rules.setdefault(channel, []).append(rule)
        self._active: dict[str, dict[str, float]] = {}  # sizes by id
        self._made: dict[AlarmState, Mapping[str, float]] = {}
        self._cleared_ns: dict[str, int] = {}
        self._alarms: dict[str, list[AlarmState]] = {}
        self._lasting_cleared_ns: dict[str, int] = {}
        self._jumps: dict[str, list[tuple[str, AlarmState]]] = {}
        self._affect: dict[str, list[Affect]] = {}
        self._withdraw: dict[str, list[Withdraw]] = {}
        self._beside: dict[AlarmState, tuple[str, frozenset[str], float]] = {}
        self._named: dict[str, set[str]] = {}
        self._named_until_ns: dict[str, int] = {}

    def add(
        self,
        channel: str,
        alarm: AlarmState,
        observer: str = "",
        *,
        jumps: bool = False,
        affect: Affect | None = None,
        withdraw: Withdraw | None = None,
        made: Mapping[str, float] = MappingProxyType({}),
    ) -> None:
        """Register an alarm of this channel: the rules, and alarms of other observers, excuse it from now on.

        ``jumps``: its observer sees the begin and the end of a fault as jumps, and not that the fault lasts. ``affect``
        is called with the channels that the alarm explains; ``withdraw`` ends the alarm if a later one explains it.
        ``made`` is how much evidence of this channel a unit of other faults makes, by channel.
        """
        self._alarms.setdefault(channel, []).append(alarm)
        if jumps:
            self._jumps.setdefault(channel, []).append((observer, alarm))
        if affect is not None:
            self._affect.setdefault(channel, []).append(affect)
        if withdraw is not None:
            self._withdraw.setdefault(channel, []).append(withdraw)
        if made:
            self._made[alarm] = made

    def add_beside(self, channel: str, alarm: AlarmState, sooner: Collection[str], for_s: float) -> None:
        """Excuse an alarm while an observer that sees its faults sooner has named one, and for some time after.

        Another observer of the same motion cannot name that fault better.
        """
        self._beside[alarm] = channel, frozenset(sooner), for_s

    def explained(
        self, channel: str, time_ns: int, vehicle_ns: int, alarm: AlarmState | None = None
    ) -> AlarmEvent | None:
        """Return the event by which an active alarm lists the channel that it explains, if any does."""
        if alarm in self._doubted:
            return self._doubted[alarm](channel, time_ns, vehicle_ns)
        causes = [cause for rule in self._rules.get(channel, ()) if not rule.same_cause for cause in rule.by]
        causes += () if alarm is None else self._made.get(alarm, ())
        for cause in (cause for cause in causes if self._active.get(cause)):
            for affect in self._affect.get(cause, ()):
                if (event := affect(channel, time_ns, vehicle_ns)) is not None:
                    return event
        return None

    def may_precede(self, channel: str) -> bool:
        """Return whether a channel's alarm may be raised before the one that explains it, and ends it."""
        return any(rule.precedes for rule in self._rules.get(channel, ()))

    def consequences(self, event: AlarmEvent) -> list[AlarmEvent]:
        """End the alarms that a newly raised alarm explains, and list those that ended by themselves lately.

        Return the events. Call :meth:`follow` for that alarm first.
        """
        events: list[AlarmEvent | None] = []
        vehicle_ns = event.vehicle_time_ms * 1_000_000
        rules = self._rules.items() if event.state == "raised" else ()
        for channel in (name for name, of in rules if any(event.channel in rule.by for rule in of if rule.precedes)):
            for withdraw in self._withdraw.get(channel, ()):
                ended = withdraw(event.time_ns, vehicle_ns, f"explained by {event.channel}")
                events += self.consequence(ended)
                if ended is None and self.ended_lately(channel, vehicle_ns):
                    events.append(self.explained(channel, event.time_ns, vehicle_ns))
        return [listed for listed in events if listed is not None]

    def ended_lately(self, channel: str, vehicle_ns: int) -> bool:
        """Return whether the channel's alarm has ended at most 10 s before a vehicle time."""
        cleared_ns = self._cleared_ns.get(channel, -LATEST_NS)
        return not self._active.get(channel) and 0 <= vehicle_ns - cleared_ns <= LATELY_NS

    def consequence(self, ended: AlarmEvent | None, alarm: AlarmState | None = None) -> list[AlarmEvent]:
        """Follow the end of an alarm that another one explains.

        Return its event, and the event by which the other lists it.
        """
        if ended is None:
            return []
        self.follow(ended)
        listed = self.explained(ended.channel, ended.time_ns, ended.vehicle_time_ms * 1_000_000, alarm)
        return [ended] if listed is None else [ended, listed]

    def distrust(self, channel: str, alarm: AlarmState, affect: Affect | None) -> bool:
        """Excuse an alarm because of untrue values from now on; None: no longer. Return whether that is a change.

        ``affect`` lists it under the alarm that tells of them.
        """
        if affect == self._doubted.get(alarm):
            return False
        if affect is None:
            del self._doubted[alarm]
        else:
            self._doubted[alarm] = affect
        self._set(channel, [alarm])
        return True

    def follow(self, event: AlarmEvent) -> None:
        """Follow an event of any channel: the rows after it are excused accordingly."""
        active = self._active.setdefault(event.channel, {})
        if event.state == "cleared":
            active.pop(event.id, None)
            self._cleared_ns[event.channel] = event.vehicle_time_ms * 1_000_000
        else:
            active[event.id] = abs(event.estimate or 0.0)
        for alarm, made in self._made.items():
            if event.channel in made:
                sizes = (size * made[name] for name in made for size in self._active.get(name, {}).values())
                alarm.allow(max(sizes, default=0.0))
        for channel, alarms in self._alarms.items():
            shared = channel == event.channel and len(alarms) > 1
            if shared or any(event.channel in rule.by for rule in self._rules.get(channel, ())):
                jumps = self._jumps.get(channel, ())
                # Another observer has followed this fault, so the jump is the fault's end.
                followed = event.channel == channel and event.observer not in {observer for observer, _ in jumps}
                if followed and event.state == "cleared":
                    self._lasting_cleared_ns[channel] = self._cleared_ns[channel]
                self._set(channel, alarms)
        if event.kind == "residual":
            return
        named = self._named.setdefault(event.observer, set())
        (named.discard if event.state == "cleared" else named.add)(event.id)
        self._named_until_ns[event.observer] = event.vehicle_time_ms * 1_000_000
        for alarm, (channel, sooner, _) in self._beside.items():
            if event.observer in sooner:
                self._set(channel, [alarm])

    def _set(self, channel: str, alarms: Sequence[AlarmState]) -> None:
        """Tell the alarms of a channel when they are excused."""
        now, spans = self._excuse(channel)
        ended = spans
        if (cleared_ns := self._lasting_cleared_ns.get(channel)) is not None:
            ended = np.concatenate([spans, np.array([_about(cleared_ns, HOLD_S)], np.int64)])
        jumps = {alarm for _, alarm in self._jumps.get(channel, ())}
        for alarm in alarms:
            _, sooner, for_s = self._beside.get(alarm, ("", frozenset[str](), 0.0))
            named, until_ns = any(self._named.get(observer) for observer in sooner), self._named_until_ns
            after = [_about(until_ns[observer], for_s) for observer in sooner if observer in until_ns]
            times = np.concatenate([ended if alarm in jumps else spans, np.array(after, np.int64).reshape(-1, 2)])
            alarm.set_excuse(now or named or alarm in self._doubted, times)

    def _excuse(self, channel: str) -> tuple[bool, NDArray[np.int64]]:
        """Return whether a channel is excused all the time, and the spans of vehicle time in which it is (m, 2), ns."""
        if len(self._alarms.get(channel, ())) > 1 and self._active.get(channel):
            return True, np.empty((0, 2), np.int64)
        spans = []
        for rule in self._rules.get(channel, ()):
            for cause in rule.by:
                if self._active.get(cause):
                    return True, np.empty((0, 2), np.int64)
                if (cleared_ns := self._cleared_ns.get(cause)) is not None:
                    spans.append(_about(cleared_ns, rule.for_s))
        return False, np.array(spans, np.int64).reshape(-1, 2)


def _about(cleared_ns: int, for_s: float) -> tuple[int, int]:
    """Return the span of vehicle time in which a cleared alarm still excuses others, ns.

    An event carries the time at which its sample was known; the rows that follow it may be of an earlier time.
    """
    after_ns = min(int(for_s * 1e9), LATEST_NS)
    return cleared_ns - after_ns, cleared_ns + after_ns


def general_of(rules: Sequence[ExcuseRule]) -> dict[str, tuple[str, ...]]:
    """Return, for each channel of findings, the channels whose causes it names more exactly."""
    finer = {cause for rule in rules if rule.same_cause for cause in rule.by}
    return {
        cause: tuple(channel for rule in rules if rule.same_cause and cause in rule.by for channel in rule.channels)
        for cause in sorted(finer)
    }


def read_excuses(tables: Iterable[Table], known: Sequence[str]) -> tuple[ExcuseRule, ...]:
    """Return the rules of a profile with the alarm channels ``known``; mistakes are recorded in its file."""
    rules = []
    for table in tables:
        rule = ExcuseRule(
            table.texts("channels"),
            table.texts("by"),
            table.number("for_s", 0.0, at_least=0.0),
            table.boolean("same_cause", False),
            table.boolean("precedes", False),
        )
        table.done()
        for key, names in (("channels", rule.channels), ("by", rule.by)):
            if table.good(key) and (not names or (strange := [name for name in names if name not in known])):
                found = f"names '{strange[0]}', which has no alarm" if names else "is empty"
                table.mistake(key, f"{found}; alarms are {', '.join(known)}")
        if both := set(rule.channels) & set(rule.by):
            table.mistake("by", f": '{min(both)}' would excuse itself")
        rules.append(rule)
    return tuple(rules)


def excuse_tables(rules: Sequence[ExcuseRule]) -> list[dict[str, Any]]:
    """Return the tables that :func:`read_excuses` reads back as the same rules."""
    return [
        {"channels": list(rule.channels), "by": list(rule.by), "for_s": rule.for_s}
        | {name: True for name in ("same_cause", "precedes") if getattr(rule, name)}
        for rule in rules
    ]
