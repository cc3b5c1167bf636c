"""Alarms about the link instead of the vehicle: forged or replayed packets, no heartbeat, no telemetry at all.

They depend only on messages and their times of arrival, like everything in the pipeline.
"""

from collections.abc import Sequence
from dataclasses import replace

from adapters.mavlink.heartbeat import is_autopilot_heartbeat
from adapters.message import LATEST_NS, Message
from adapters.source import LINK, MAVLINK
from monitor.alarms.alarm import with_affected
from monitor.alarms.command_watch import CommandFinding
from monitor.event import AlarmEvent, Kind, Severity, State, fixed_rule_event, next_event

OBSERVER = "link"
SIGNING = "signing"
HEARTBEAT = "link"
TELEMETRY = "telemetry"
IMPOSTOR = "impostor"
COMMAND = "command"

_QUIET_NS = 10_000_000_000
"""Time without a wrong signature, or without a command, after which an attack is over. Chosen: as long as for the
heartbeat."""
HEARTBEAT_NS = 10_000_000_000
"""Ten heartbeats at MAVLink's rate of one a second. A link that loses 10 % at random misses ten in a row once in 350
years, one that loses 30 % once in three days."""
_ENDS = {SIGNING: "no more packets with a wrong signature", COMMAND: "such commands have ended"}
"""For each channel, the sentence with which an alarm of single messages clears."""
_MOST_PACKETS = 1 << 62
"""Counts of a recording are limited to this, so that the sum of three fits into 64 bits."""
SET_BACK_NS = 10_000_000_000
"""A message that seems to be earlier by this much was not late: the clock was set back. Datagrams wait in the kernel
for less (``adapters/mavlink/byte_link.py``)."""
_UPDATE_NS = 1_000_000_000
"""Updates are published at most once a second, as for all alarms."""
_MOST_SAID = 3
"""Senders that an alarm of commands names. Chosen: what a sentence can hold."""


class LinkAlarms:
    """The link's alarms of one vehicle.

    ``signing`` is raised by the first packet whose signature is forged, replayed or missing although one is required,
    reports their number once a second, and clears after 10 s without another. ``link`` is raised if other telemetry
    goes on but the autopilot's heartbeat has not come for 10 s. ``impostor`` is active while messages contradict each
    other in a way that only two senders explain. ``command`` reports all risky commands of new senders in flight and
    floods of commands, and clears 10 s after the last of them.
    """

    def __init__(self, vehicle: str) -> None:
        self._vehicle = vehicle
        self._active: dict[str, AlarmEvent] = {}
        self._affected: list[str] = []  # channels that the active impostor alarm explains
        self._commanded: dict[tuple[int, int] | str | None, str] = {}  # what the alarm of commands says, by sender
        self._commanded_ns = 0  # when that changed
        self._severity: Severity = "warning"  # of that alarm
        self._counts: dict[str, int] = {}
        self._baseline = 0
        self._last_ns: dict[str, int] = {}  # time of the last wrong signature, and of the last command
        self._heartbeat_ns: int | None = None
        self._vehicle_ms = 0

    def process(self, message: Message, vehicle_ns: int) -> list[AlarmEvent]:
        """Process any message of the vehicle's link, with the newest time of its clock.

        Return the events that it causes.
        """
        now_ns = message.received_ns
        self._vehicle_ms = vehicle_ns // 1_000_000
        events = self.quiet(now_ns)
        if message.source is LINK and message.name == "signing":
            return [*events, *self._attacked(message, now_ns)]
        if message.source is MAVLINK:
            if is_autopilot_heartbeat(message):
                self._heartbeat_ns = now_ns
                if HEARTBEAT in self._active:
                    events.append(self._clear(HEARTBEAT, now_ns, "the autopilot's heartbeat is back"))
            elif HEARTBEAT not in self._active and now_ns - (self._heartbeat_ns or now_ns) >= HEARTBEAT_NS:
                text = "no heartbeat of the autopilot for 10 s while other telemetry goes on"
                events.append(self._raise(HEARTBEAT, "stale", "warning", now_ns, None, "s", text))
        return events

    @property
    def heartbeat_ns(self) -> int:
        """When the autopilot's last heartbeat came; 0 before the first."""
        return self._heartbeat_ns or 0

    @property
    def awaits_heartbeat(self) -> bool:
        """Whether the alarm of missing heartbeats is active."""
        return HEARTBEAT in self._active

    @property
    def due_ns(self) -> int:
        """Unix time from which on a message may cause an event."""
        due = [self._last_ns[channel] + _QUIET_NS for channel in _ENDS if channel in self._active]
        return min([*due, self._command_due_ns], default=LATEST_NS)

    @property
    def _command_due_ns(self) -> int:
        """Unix time from which on the alarm of commands is updated: once a second at most."""
        active = self._active.get(COMMAND)
        if active is None or not self._commanded or active.message == "; ".join(self._commanded.values()):
            return LATEST_NS
        return max(self._commanded_ns, active.time_ns + _UPDATE_NS)

    def pass_over(self, heartbeat_ns: int, vehicle_ns: int) -> None:
        """Follow messages that cause no event: the newest heartbeat, and the vehicle's time at the last of them."""
        self._vehicle_ms = vehicle_ns // 1_000_000
        self._heartbeat_ns = heartbeat_ns or self._heartbeat_ns

    def contradict(self, contested: Sequence[str], now_ns: int, severity: Severity = "critical") -> list[AlarmEvent]:
        """Follow the contradictions at a Unix time, a sentence for each; return the events that a change causes."""
        active = self._active.get(IMPOSTOR)
        if not contested:
            return [] if active is None else [self._clear(IMPOSTOR, now_ns, "the contradictions have ended")]
        text = f"a second sender uses the vehicle's id: {'; '.join(contested)}"
        if active is None:
            self._affected = []
            return [self._raise(IMPOSTOR, "security", severity, now_ns, None, "", text)]
        text = with_affected(text, self._affected)
        if active.message == text:
            return []
        return [self._event(IMPOSTOR, replace(active, severity=severity), "updated", now_ns, None, text)]

    def affect(self, channel: str, time_ns: int, vehicle_ns: int) -> AlarmEvent | None:
        """Add that forged values explain a channel's evidence; return the event, or None if that is known."""
        active = self._active.get(IMPOSTOR)
        if active is None or channel in self._affected:
            return None
        self._affected.append(channel)
        self._vehicle_ms = vehicle_ns // 1_000_000
        text = with_affected(active.message, self._affected)
        return self._event(IMPOSTOR, active, "updated", max(time_ns, active.time_ns), None, text)

    def quiet(self, now_ns: int) -> list[AlarmEvent]:
        """Advance the Unix time to ``now_ns``; return the events that this causes."""
        said = self._command_said(now_ns)
        # At the end of the 10 s, regardless of when the next message comes.
        over = [
            (self._last_ns[channel] + _QUIET_NS, channel)
            for channel in _ENDS
            if channel in self._active and now_ns - self._last_ns[channel] >= _QUIET_NS
        ]
        return said + [self._clear(channel, end_ns, _ENDS[channel]) for end_ns, channel in sorted(over)]

    def commanded(self, finding: CommandFinding, now_ns: int) -> list[AlarmEvent]:
        """Follow what a command shows; return the events that this causes."""
        if finding.weight == "information":
            return []
        self._last_ns[COMMAND] = now_ns
        if COMMAND not in self._active:
            self._commanded, self._severity = {finding.sender: finding.text}, finding.weight
            return [self._raise(COMMAND, "security", finding.weight, now_ns, None, "", finding.text)]
        if finding.weight == "critical":
            self._severity = "critical"
        sender: tuple[int, int] | str | None = finding.sender
        text = finding.text
        if sender not in self._commanded and len(self._commanded) >= _MOST_SAID:
            sender, text = "others", "further senders command it, too"
        if self._commanded.get(sender) != text:
            self._commanded[sender], self._commanded_ns = text, now_ns
        return self._command_said(now_ns)

    def _command_said(self, now_ns: int) -> list[AlarmEvent]:
        due_ns, active = self._command_due_ns, self._active.get(COMMAND)
        if active is None or now_ns < due_ns:
            return []
        active, text = replace(active, severity=self._severity), "; ".join(self._commanded.values())
        return [self._event(COMMAND, active, "updated", due_ns, None, text)]

    def silent(self) -> None:
        """Forget the heartbeat, since all telemetry has stopped: it is not missed until it has come again."""
        self._heartbeat_ns = None

    def adopt(self, event: AlarmEvent) -> None:
        """Continue from an event that an earlier run, or another monitor, has published."""
        if event.state == "cleared":
            self._active.pop(event.channel, None)
            return
        self._active[event.channel] = event
        if event.channel == COMMAND:
            self._commanded, self._severity = {}, event.severity
        if event.channel in _ENDS:
            self._last_ns[event.channel] = event.time_ns

    def _attacked(self, message: Message, now_ns: int) -> list[AlarmEvent]:
        counts = {name: _count(message.fields.get(name)) for name in ("forged", "replayed", "unsigned")}
        total = sum(counts.values())
        if SIGNING not in self._active:
            self._baseline = sum(self._counts.values())
        # A link that was reopened counts from zero.
        if total < sum(self._counts.values()):
            self._baseline = 0
        self._counts = counts
        self._last_ns[SIGNING] = now_ns
        counted = ", ".join(f"{count} {name}" for name, count in counts.items() if count)
        text = f"packets with the vehicle's id and a wrong signature were refused: {counted} so far"
        severity: Severity = "critical" if counts["forged"] or counts["replayed"] else "warning"
        size = float(total - self._baseline)
        active = self._active.get(SIGNING)
        if active is None:
            return [self._raise(SIGNING, "security", severity, now_ns, size, "packets", text)]
        if now_ns - active.time_ns < _UPDATE_NS:
            return []
        return [self._event(SIGNING, replace(active, severity=severity), "updated", now_ns, size, text)]

    def _raise(
        self, channel: str, kind: Kind, severity: Severity, now_ns: int, size: float | None, unit: str, text: str
    ) -> AlarmEvent:
        event = self._active[channel] = fixed_rule_event(
            self._vehicle,
            OBSERVER,
            channel,
            kind=kind,
            state="raised",
            severity=severity,
            estimate=size,
            unit=unit,
            threshold=HEARTBEAT_NS / 1e9 if channel == HEARTBEAT else 1.0,
            time_ns=now_ns,
            vehicle_time_ms=self._vehicle_ms,
            message=text,
        )
        return event

    def _clear(self, channel: str, now_ns: int, text: str) -> AlarmEvent:
        active = self._active[channel]
        event = self._event(channel, active, "cleared", now_ns, active.estimate, text)
        del self._active[channel]
        return event

    def _event(
        self, channel: str, active: AlarmEvent, state: State, now_ns: int, size: float | None, text: str
    ) -> AlarmEvent:
        event = next_event(active, state, now_ns, self._vehicle_ms, text, estimate=size, peak=size)
        self._active[channel] = event
        return event


def _count(value: object) -> int:
    """Return a count within the limits of a recording: whole, and no larger than any link counts to."""
    return min(value, _MOST_PACKETS) if isinstance(value, int) and not isinstance(value, bool) and value > 0 else 0


class StaleAlarm:
    """The stale alarm of one vehicle: silence of its telemetry, never mixed with a fault of the vehicle.

    The alarm is raised ``stale_s`` seconds after the last message that carried a channel, and cleared by the next such
    message. A replay finds the same two moments in the recording.
    """

    def __init__(self, vehicle: str, stale_s: float) -> None:
        self._vehicle = vehicle
        self.limit_ns = round(stale_s * 1e9)
        self._carried_ns: int | None = None
        self._vehicle_ns = 0
        self._since_ns: int | None = None

    @property
    def active(self) -> bool:
        """Whether telemetry is stale."""
        return self._since_ns is not None

    @property
    def carried_ns(self) -> int | None:
        """When a message last carried a channel; None before the first, and while telemetry is stale."""
        return None if self.active else self._carried_ns

    def follow(self, received_ns: int, vehicle_ns: int) -> list[AlarmEvent]:
        """Process a message that carries a channel; return the events of a silence before it and of its end.

        The message arrived at Unix time ``received_ns``; ``vehicle_ns`` is the newest known time of the vehicle's
        clock.
        """
        events = self.silence(received_ns)
        if self._since_ns is not None:
            silent_ns = received_ns - (self._carried_ns or received_ns)
            # The vehicle's clock is known from before the silence only; the message's own time is processed later.
            back_ns = max(vehicle_ns, self._vehicle_ns + silent_ns)
            text = f"telemetry is back after {silent_ns / 1e9:.1f} s"
            # The message may have waited in a queue, and have arrived before the silence was long enough for an alarm.
            events.append(self._event("cleared", max(received_ns, self._since_ns), back_ns, text))
            self._since_ns = None
        self.pass_over(received_ns, vehicle_ns)
        return events

    def due(self, now_ns: int) -> bool:
        """Return whether the silence is long enough for an alarm at Unix time ``now_ns``, and not yet raised."""
        return self.carried_ns is not None and now_ns - self.carried_ns >= self.limit_ns

    def silence(self, now_ns: int) -> list[AlarmEvent]:
        """Advance the Unix time to ``now_ns``; return the event of telemetry that goes stale, once."""
        if self._carried_ns is not None and self._carried_ns - now_ns >= SET_BACK_NS:
            self._carried_ns = now_ns
        if self._carried_ns is None or not self.due(now_ns):
            return []
        self._since_ns = self._carried_ns + self.limit_ns
        return [
            self._event(
                "raised",
                self._since_ns,
                self._vehicle_ns + self.limit_ns,
                f"no telemetry for {self.limit_ns / 1e9:g} s: nothing is being watched",
            )
        ]

    def pass_over(self, received_ns: int, vehicle_ns: int) -> None:
        """Follow messages without a silence.

        Arguments are the newest that carried a channel, and the vehicle's time at the last of them.
        """
        carried_ns = self._carried_ns
        if carried_ns is None or not 0 <= carried_ns - received_ns < SET_BACK_NS:
            self._carried_ns = received_ns
        self._vehicle_ns = vehicle_ns

    def adopt(self, event: AlarmEvent) -> None:
        """Continue from an event that an earlier run, or another monitor, has published."""
        self._since_ns = None if event.state == "cleared" else event.since_ns
        if self._carried_ns is None:
            self._carried_ns = event.since_ns - self.limit_ns

    def _event(self, state: State, time_ns: int, vehicle_ns: int, message: str) -> AlarmEvent:
        return fixed_rule_event(
            self._vehicle,
            OBSERVER,
            TELEMETRY,
            kind="stale",
            state=state,
            unit="s",
            threshold=self.limit_ns / 1e9,
            time_ns=time_ns,
            vehicle_time_ms=vehicle_ns // 1_000_000,
            since_ns=self._since_ns,
            message=message,
        )
