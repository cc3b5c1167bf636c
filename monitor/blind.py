"""Whether evidence flows: when each observer and each sensor had some last, why not, and the alarm of a blind vehicle.

A vehicle without an alarm is healthy only where it is watched. So where an observer of a flying vehicle, or one of the
sensors it compares, has had no evidence for 5 s, ``monitor/blind`` is raised and says which and why. It clears when
evidence has come again, or with the flight, or when estimates begin anew and lack nothing but the time to settle, for
which it would not be raised. If they settle in vain it is raised again, until evidence comes. On the ground, and before
any telemetry came, nothing is expected, and while telemetry is stale its own alarm says so. A message that never came
is no loss but a link or a log without it: the status and a replay's verdict name it, and the alarm does where nothing
else of the vehicle is watched.

Decided on messages and their times of arrival alone, like everything in the pipeline.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from adapters.batch import Batch, arrival_times
from adapters.message import SECOND_NS
from monitor.alarms.alarm import with_affected
from monitor.alarms.desk import OBSERVER as MONITOR
from monitor.alarms.link_alarms import SET_BACK_NS
from monitor.event import AlarmEvent, Severity, State, fixed_rule_event, next_event
from monitor.profile import newly_watched

if TYPE_CHECKING:
    from monitor.chain import ChainRun, ObserverChain

OBSERVER: Final = MONITOR
CHANNEL: Final = "blind"
LIMIT_NS = 5_000_000_000
"""Time without evidence that raises the alarm: twice the longest time without evidence of a sensor in flight over 90
recordings, which is 2.5 s for a GPS over a radio, and 0.2 s for onboard links and logs."""
_LEAST_SAMPLES = 3
"""Least number of missing samples that raises the alarm, for an observer that has fewer in that time. Over a radio at
1,200 bytes a second an observer has one in 6.8 s; chosen, since one may be lost."""
_AFTER_RESTART_NS = SECOND_NS
"""Time beyond settling for which no evidence is expected after a restart, after a reboot for instance: until samples
come again, for which a second was enough in all recordings with an inserted reboot."""
_DOWN_NS = 5_500_000_000
"""How long no evidence is expected of motors whose command says that the vehicle came down: PX4 reports for 3 to 5 s
after touch-down that it flies. Afterwards one of the two is not true."""
_SLOT_NS = 500_000_000
"""Period at which an active alarm is checked. Chosen: its end is known half a second late at most."""
_UPDATE_NS = SECOND_NS
"""Least time between updates, the same as for all alarms."""
_SHARE_S = 60
"""Length of the time before now, seconds, of which the status gives the share with evidence."""
_AGAIN = "the vehicle is watched again"
_SENSORS = {"gps": "GPS", "lat": "GPS", "lon": "GPS", "baro": "barometer", "heading": "compass", "xmag": "compass"}
"""Sensors by the first part of a channel's name; other channels are grouped by their messages."""


@dataclass(slots=True)
class _Group:
    """Outputs of an observer that have or lack evidence together."""

    label: str  # the sensor's name; empty for outputs that belong to no sensor
    messages: tuple[str, ...]
    columns: list[int]  # indices among the observer's outputs
    since_ns: int = 0  # Unix time from which evidence is awaited: that of the last evidence
    granted_ns: int = LIMIT_NS  # how long evidence is awaited
    evidence_ns: int = 0  # when the last evidence came; 0: never


@dataclass(frozen=True, slots=True)
class Watching:
    """The state of an observer's evidence now."""

    share: float  # share of the last minute of vehicle time in which it had evidence
    last_ns: int | None  # Unix time of its last evidence; None: never
    why_not: str | None  # a word for the reason why it has no evidence; None if it has
    sensors: Mapping[str, int | None]  # when each of its sensors last had evidence

    def age_s(self, now_ns: int) -> float | None:
        """Return the time since its last evidence, seconds; None if it never had any."""
        return None if self.last_ns is None else max(0.0, (now_ns - self.last_ns) / 1e9)


class EvidenceFlow:
    """Times and reasons of one observer's evidence."""

    def __init__(self, chain: ObserverChain) -> None:
        self.chain = chain
        layout = chain.layout
        self.name = layout.observer
        self.messages = dict.fromkeys(sorted(chain.sampler.interests), 0)
        grouped: dict[str, list[int]] = {}
        for column, output in enumerate(layout.outputs):
            grouped.setdefault(_sensor(output), []).append(column)
        named = {
            label: tuple(
                sorted({channel.message for channel in chain.source.channels if _sensor(channel.name) == label})
            )
            for label in grouped
        }
        self.groups = [_Group(label, named[label], columns) for label, columns in grouped.items()]
        self._period_ns = round(1e9 / layout.rate_hz)
        self.limit_ns = max(LIMIT_NS, _LEAST_SAMPLES * self._period_ns)
        # A message that has been missing for this long is the reason: over a radio the longest step was 2.5 s
        # (LIMIT_NS).
        self.missing_ns = self.limit_ns // 2
        self.settle_ns = round(chain.settle_s * 1e9)
        # Before the first sample each message has to come twice, and the next one has to show that none is late.
        self.first_ns = self.limit_ns + max(self.settle_ns, _LEAST_SAMPLES * self._period_ns)
        self._inputs = len(layout.inputs)
        self._rows_ns = self._restart_ns = 0  # Unix times of the newest sample, and of the newest that began anew
        self._granted = False  # whether the time to settle was granted to an active alarm since the last evidence
        self._overdue: list[bool] = [False]
        self._lost: tuple[str, ...] = ()
        self.altered = False  # whether its commands, or their effects, are known to be altered: it shows nothing then
        self._seconds: deque[tuple[int, int]] = deque()

    def wait_from(self, now_ns: int) -> None:
        """Expect no evidence until a Unix time; after it, allow the time to the first evidence and the alarm's own."""
        for group in self.groups:
            if now_ns >= group.since_ns:
                group.since_ns, group.granted_ns = now_ns, self.first_ns

    def receive(self, name: str, first_ns: int, last_ns: int) -> None:
        """Follow messages of one name, the first and the last of which came at these Unix times."""
        if not self.messages[name]:
            for group in self.groups:
                if not group.evidence_ns:
                    group.since_ns, group.granted_ns = first_ns, self.first_ns
        self.messages[name] = last_ns

    def follow(self, run: ChainRun, received: Callable[[int], int]) -> None:
        """Follow samples; ``received`` returns when the message of a position arrived."""
        armed, samples, position = run.estimates.armed, run.estimates.samples, run.position
        self._rows_ns = received(int(position[-1]))
        lost = samples.lost[:, self._inputs :]
        came = armed
        if run.unflown is not None:
            # Telemetry that comes but is unlike the fitted flights is not missing.
            lost, came = lost & ~run.unflown[:, None], armed | run.unflown
        is_lost = np.count_nonzero(lost) > 0
        self._lost = ()
        if is_lost:
            self._lost = tuple(self._name_of(group) for group in self.groups if lost[-1, group.columns].all())
        restarts, cames = samples.restart.nonzero()[0], came.nonzero()[0]
        if restarts.size:
            restart_ns, again_ns = received(int(position[restarts[-1]])), self.settle_ns + _AFTER_RESTART_NS
            self._restart_ns = restart_ns
            for group in self.groups:
                # Before the first evidence, settling begins anew, but not for ever.
                gone_ns = 0 if group.evidence_ns else min(restart_ns - group.since_ns, self.limit_ns + self.settle_ns)
                # The sample that begins anew is no evidence, and is one of the few of a slow observer.
                group.granted_ns = max(group.granted_ns, gone_ns + again_ns, self.limit_ns + self._period_ns)
        if not cames.size or self.altered:
            return
        self._granted = False
        count = cames.size if came is armed else int(np.count_nonzero(armed))
        second = int(samples.vehicle_time_ns[-1]) // SECOND_NS
        if self._seconds and self._seconds[-1][0] == second:
            count += self._seconds.pop()[1]
        self._seconds.append((second, count))
        for group in self.groups:
            rows = (came & ~lost[:, group.columns].all(axis=1)).nonzero()[0] if is_lost else cames
            if rows.size:
                group.since_ns = group.evidence_ns = received(int(position[rows[-1]]))
                restarted = restarts.size and restarts[-1] > rows[-1]
                group.granted_ns = max(self.limit_ns, self.settle_ns + _AFTER_RESTART_NS if restarted else 0)

    def settles(self, now_ns: int, contested: bool) -> bool:
        """Return whether its overdue evidence lacks nothing but the time to settle, the first time since the last."""
        again = 0 <= now_ns - self._restart_ns < self.settle_ns + _AFTER_RESTART_NS
        return again and not self._granted and self.reason(now_ns, contested)[1] == "settling"

    def grant(self) -> None:
        """Await its evidence from its newest restart on."""
        self._granted = True
        for group in self.groups:
            group.since_ns = self._restart_ns
            group.granted_ns = max(self.limit_ns, self.settle_ns + _AFTER_RESTART_NS)

    def stand(self) -> None:
        """Expect no evidence for a while, as the vehicle came down by its command."""
        for group in self.groups:
            group.granted_ns = max(group.granted_ns, _DOWN_NS)

    @property
    def overdue(self) -> bool:
        """Whether all evidence is overdue at the time of the latest :meth:`lacks`."""
        return all(self._overdue)

    def awaits(self, now_ns: int) -> bool:
        """Return whether the first evidence of one of its sensors may still come in time."""
        return any(not group.evidence_ns and now_ns - group.since_ns < group.granted_ns for group in self.groups)

    @property
    def frozen(self) -> dict[str, int]:
        """Messages that stand still of those that sensors are compared with, and since when, in vehicle time."""
        late = [group for group, late in zip(self.groups, self._overdue, strict=False) if late and not group.label]
        still = self.chain.still if late else {}
        return {name: still[name] for group in late for name in group.messages if name in still}

    def lacks(self, now_ns: int, contested: bool, *, any_message: bool) -> list[tuple[str, str]]:
        """Return the reasons of overdue evidence, in people's words and as the status's word.

        ``any_message`` is whether messages that never came are reasons.
        """
        self._overdue = [now_ns - group.since_ns >= group.granted_ns for group in self.groups]
        if True not in self._overdue:
            return []
        never = {name for name, came_ns in self.messages.items() if not came_ns and not any_message}
        if self.overdue:
            return [] if never else [self.reason(now_ns, contested)]
        return [
            (f"no {self._name_of(group)}", f"no_message {group.messages[0]}")
            for group, late in zip(self.groups, self._overdue, strict=True)
            if late and group.messages and not never.issuperset(group.messages)
        ]

    def reason(self, now_ns: int, vehicle_contested: bool) -> tuple[str, str]:
        """Return why the observer has no evidence, in people's words and as the status's word."""
        missing = [name for name, came_ns in self.messages.items() if now_ns - came_ns >= self.missing_ns]
        if self.altered:
            return "altered commands or rates", "contradicted"
        if vehicle_contested:
            return "contradictory telemetry", "contradicted"
        if missing:
            labels = dict.fromkeys(self._label_of(name) for name in missing)
            return f"no {' and no '.join(labels)}", f"no_message {missing[0]}"
        if now_ns - self._rows_ns >= self.missing_ns:
            return "measurements with no times in common", "gap"
        if seldom := self.chain.sampler.seldom:
            return f"{' and '.join(seldom)} slower than in the fitted flights", "gap"
        lift = self.chain.source.lift
        if lift is not None and not self.chain.gate.carried:
            return f"flight not carried by its {lift.by} alone", "not_carried"
        if self.chain.gate.down:
            return "commands too small for flight", "contradicted"
        if still := self.chain.still:
            return f"{' and '.join(still)} frozen", "gap"
        if self._lost:
            return f"no {' and no '.join(self._lost)}", "gap"
        return "estimates without time to settle", "settling"

    def watching(self, now_ns: int, vehicle_ns: int, flying: bool, contested: bool) -> Watching:
        """Return the state of its evidence at a Unix time."""
        second = vehicle_ns // SECOND_NS
        while self._seconds and not second - _SHARE_S <= self._seconds[0][0] <= second:
            self._seconds.popleft()
        span_s = min(_SHARE_S, second - self._seconds[0][0] + 1) if self._seconds else 1
        share = min(1.0, sum(count for _, count in self._seconds) / (self.chain.layout.rate_hz * span_s))
        last_ns = max((group.evidence_ns for group in self.groups), default=0)
        why = None
        if not flying:
            why = "on_ground"
        elif now_ns - last_ns >= self.missing_ns:
            why = self.reason(now_ns, contested)[1]
        sensors = {group.label or self.name: group.evidence_ns or None for group in self.groups}
        return Watching(round(share, 3), last_ns or None, why, sensors)

    def _name_of(self, group: _Group) -> str:
        # messages that come without evidence may be too late, or have no usable time
        return group.label or f"usable {' and '.join(group.messages) or self.name}"

    def _label_of(self, message: str) -> str:
        return next((group.label for group in self.groups if group.label and message in group.messages), message)


class BlindAlarm:
    """State of the alarm of a vehicle that flies and is not watched."""

    def __init__(self, vehicle: str, chains: Sequence[ObserverChain]) -> None:
        self._vehicle = vehicle
        self.flows = [EvidenceFlow(chain) for chain in chains]
        self._receivers: dict[str, list[EvidenceFlow]] = {}
        for flow in self.flows:
            for name in flow.messages:
                self._receivers.setdefault(name, []).append(flow)
        new = newly_watched(chain.layout.faults for chain in chains)
        # an observer beside a faster one of the same faults is not needed: without it, the vehicle is not blind
        self._needed = [flow for flow, faults in zip(self.flows, new, strict=True) if faults]
        self.active: AlarmEvent | None = None  # the last event of the active alarm
        self._slot = 0
        self._started = False
        self.received = False  # whether any telemetry came since the start
        self._affected: list[str] = []  # channels that the active alarm explains
        # messages that stand still while the alarm is active, and since when, in vehicle time
        self.frozen: Mapping[str, int] = {}

    def due_ns(self, flying: bool, now_ns: int) -> int:
        """Return the Unix time from which a message may cause an event here."""
        if self.active is not None:
            return (self._slot + 1) * _SLOT_NS
        if not flying:
            # If the vehicle takes off during the next messages, evidence is overdue this much later at the earliest.
            return now_ns + LIMIT_NS
        due = [group.since_ns + group.granted_ns for flow in self._needed for group in flow.groups]
        # Evidence that is overdue stays overdue, unless a message comes for the first time: then it is awaited anew.
        return min([now_ns + LIMIT_NS, *(due_ns for due_ns in due if due_ns > now_ns)])

    def receive(self, batch: Batch) -> None:
        """Record when messages of each name came."""
        if not self.received and batch.count:
            self.received = True
            self.wait_from(int(arrival_times(batch).min()))
        for columns in batch.columns:
            if columns.name in self._receivers:
                first_ns, last_ns = int(columns.received_ns[0]), int(columns.received_ns[-1])
                for flow in self._receivers[columns.name]:
                    flow.receive(columns.name, first_ns, last_ns)
        for message in batch.others.values():
            for flow in self._receivers.get(message.name, ()):
                flow.receive(message.name, message.received_ns, message.received_ns)

    def pause(self, now_ns: int) -> None:
        """Expect no evidence while telemetry is stale, which has its own alarm.

        Evidence that was overdue before stays so.
        """
        if self.active is None:
            self.wait_from(now_ns)

    def wait_from(self, now_ns: int) -> None:
        """Expect no evidence until a Unix time."""
        for flow in self.flows:
            flow.wait_from(now_ns)

    def process(
        self, now_ns: int, vehicle_ns: int, flying: bool, contested: bool, *, recorded: bool = True
    ) -> list[AlarmEvent]:
        """Advance the Unix time to ``now_ns``; return the events that this causes.

        ``flying`` is whether evidence is expected, ``contested`` whether the telemetry contradicts itself. Passing time
        is recorded only if it causes an event: with ``recorded`` false the state changes only with an event, as in a
        replay, which does not have the rest.
        """
        before = self._slot
        events = self._look(now_ns, vehicle_ns, flying, contested, recorded)
        if not (events or recorded):
            self._slot = before
        return events

    def _look(self, now_ns: int, vehicle_ns: int, flying: bool, contested: bool, recorded: bool) -> list[AlarmEvent]:
        if not self._started:
            self._started = True
            self.wait_from(now_ns)
        for flow in self.flows:
            for group in flow.groups:
                # the time of a clock that was set back
                if group.since_ns - now_ns >= SET_BACK_NS:
                    group.since_ns, group.evidence_ns = now_ns, min(group.evidence_ns, now_ns)
        slot, active = now_ns // _SLOT_NS, self.active
        if active is None and not (flying and self.received):
            return []
        if active is not None:
            if 0 <= self._slot - slot < SET_BACK_NS // _SLOT_NS:
                return []
            self._slot = slot
        needed = self._needed
        lacks = {flow.name: flow.lacks(now_ns, contested, any_message=False) for flow in needed} if flying else {}
        nothing = flying and all(flow.overdue for flow in needed)
        if nothing:
            lacks = {flow.name: flow.lacks(now_ns, contested, any_message=True) for flow in needed}
        if not any(lacks.values()):
            if active is None or (flying and any(flow.awaits(now_ns) for flow in needed)):
                return []
            return [self._clear(active, now_ns, vehicle_ns, _AGAIN if flying else "the vehicle is no longer in flight")]
        late = [flow for flow in needed if lacks[flow.name]]
        if all(flow.settles(now_ns, contested) for flow in late):
            if active is None and not recorded:
                # A replay does not have this moment: the time to settle is granted at the next one that it has.
                return []
            for flow in late:
                flow.grant()
            longest_s = max(flow.settle_ns for flow in late) / 1e9
            text = f"{_AGAIN}, as soon as estimates settle ({longest_s:.2g} s)"
            return [] if active is None else [self._clear(active, now_ns, vehicle_ns, text)]
        texts = [
            f"{flow.name}: {why} for {flow.limit_ns / 1e9:.2g} s" for flow in needed for why, _ in lacks[flow.name]
        ]
        text = "the vehicle flies and is not watched: " + "; ".join(texts)
        severity: Severity = "critical" if nothing else "warning"
        if active is not None:
            text = with_affected(text, self._affected)
            if (active.message, active.severity) == (text, severity) or now_ns - active.time_ns < _UPDATE_NS:
                return []
            return [self._next(active, "updated", now_ns, vehicle_ns, text, severity)]
        self._slot = slot
        return [self._raise(now_ns, vehicle_ns, text, severity)]

    def affect(self, channel: str, time_ns: int, vehicle_ns: int) -> AlarmEvent | None:
        """Add that frozen values explain a channel's evidence; return the event, or None if that is known."""
        active = self.active
        if active is None or channel in self._affected:
            return None
        self._affected.append(channel)
        text = with_affected(active.message, self._affected)
        return self._next(active, "updated", time_ns, vehicle_ns, text, active.severity)

    def adopt(self, event: AlarmEvent) -> None:
        """Continue from an event that an earlier run, or another monitor, has published."""
        self.active = None if event.state == "cleared" else event

    def watching(self, now_ns: int, vehicle_ns: int, flying: bool, contested: bool) -> dict[str, Watching]:
        """Return the state of each observer's evidence at a Unix time."""
        return {flow.name: flow.watching(now_ns, vehicle_ns, flying, contested) for flow in self.flows}

    def _raise(self, now_ns: int, vehicle_ns: int, text: str, severity: Severity) -> AlarmEvent:
        self._affected = []
        self.frozen = {name: since_ns for flow in self.flows for name, since_ns in flow.frozen.items()}
        self.active = fixed_rule_event(
            self._vehicle,
            OBSERVER,
            CHANNEL,
            kind="blind",
            state="raised",
            severity=severity,
            unit="s",
            threshold=LIMIT_NS / 1e9,
            time_ns=now_ns,
            vehicle_time_ms=vehicle_ns // 1_000_000,
            message=text,
        )
        return self.active

    def _clear(self, active: AlarmEvent, now_ns: int, vehicle_ns: int, text: str) -> AlarmEvent:
        event = self._next(active, "cleared", now_ns, vehicle_ns, text, active.severity)
        self.active, self.frozen = None, {}
        return event

    def _next(
        self, active: AlarmEvent, state: State, now_ns: int, vehicle_ns: int, text: str, severity: Severity
    ) -> AlarmEvent:
        time_ns = max(now_ns, active.time_ns)
        self.active = next_event(active, state, time_ns, vehicle_ns // 1_000_000, text, severity=severity)
        return self.active


def _sensor(channel: str) -> str:
    """Return the sensor that a channel's name belongs to; empty if it belongs to none."""
    return _SENSORS.get(channel.partition("_")[0], "")
