"""Alarms about the link rather than the vehicle: forged or replayed packets, and an autopilot whose heartbeat stopped.

Decided on messages and their times of arrival alone, like everything in the pipeline.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from adapters.mavlink.heartbeat import is_autopilot_heartbeat
from adapters.message import Message
from adapters.source import LINK, MAVLINK
from monitor.event import UNNUMBERED, AlarmEvent, Kind, Severity, State, alarm_id

OBSERVER = "link"
SIGNING = "signing"
HEARTBEAT = "link"

_QUIET_NS = 10_000_000_000
_HEARTBEAT_NS = 10_000_000_000
_MOST_PACKETS = 1 << 62
_SECOND_NS = 1_000_000_000


class LinkAlarms:
    """State of the link's alarms of one vehicle.

    ``signing`` is raised by the first packet whose signature is forged, replayed or missing where one is required,
    says once a second how many there were, and clears after 10 s without another. ``link`` is raised where other
    telemetry goes on but the autopilot's heartbeat has not come for 10 s.

    Parameters
    ----------
    vehicle : str
        The vehicle's name in events.
    """

    def __init__(self, vehicle: str) -> None:
        self._vehicle = vehicle
        self._standing: dict[str, AlarmEvent] = {}
        self._counts: dict[str, int] = {}
        self._baseline = 0
        self._attacked_ns = 0
        self._heartbeat_ns: int | None = None
        self._vehicle_ms = 0

    def feed(self, message: Message, vehicle_ns: int) -> list[AlarmEvent]:
        """Take any message of the vehicle's link, and the newest time of its clock; return the events it causes."""
        now_ns = message.received_ns
        self._vehicle_ms = vehicle_ns // 1_000_000
        events = self.quiet(now_ns)
        if message.source is LINK and message.name == "signing":
            return [*events, *self._attacked(message, now_ns)]
        if message.source is MAVLINK:
            if is_autopilot_heartbeat(message):
                self._heartbeat_ns = now_ns
                if HEARTBEAT in self._standing:
                    events.append(self._clear(HEARTBEAT, now_ns, "the autopilot's heartbeat is back"))
            elif HEARTBEAT not in self._standing and now_ns - (self._heartbeat_ns or now_ns) >= _HEARTBEAT_NS:
                text = "no heartbeat of the autopilot for 10 s while other telemetry goes on"
                events.append(self._raise(HEARTBEAT, "stale", "warning", now_ns, None, "s", text))
        return events

    def first_due(self, received_ns: NDArray[np.int64], heartbeats: NDArray[np.intp]) -> int:
        """Return the index of the first message that may cause an event here, the number of messages if there is none.

        Parameters
        ----------
        received_ns : NDArray[np.int64]
            Times of arrival of m messages (m,).
        heartbeats : NDArray[np.intp]
            Indices of the heartbeats of the autopilot among them, ascending.
        """
        count = len(received_ns)
        first = count
        if SIGNING in self._standing:
            first = _first(received_ns - self._attacked_ns >= _QUIET_NS)
        if HEARTBEAT in self._standing:
            return min([first, *heartbeats[:1].tolist()])
        beats = received_ns[heartbeats]
        latest_ns = int(received_ns.max()) if count else 0
        oldest_ns = min([*([self._heartbeat_ns] if self._heartbeat_ns else []), *beats.tolist()], default=latest_ns)
        if latest_ns - oldest_ns < _HEARTBEAT_NS:
            return first
        known_ns = np.concatenate(([self._heartbeat_ns or 0], beats))
        before_ns = known_ns[np.searchsorted(heartbeats, np.arange(count), side="right")]
        return min(first, _first((before_ns > 0) & (received_ns - before_ns >= _HEARTBEAT_NS)))

    def pass_over(self, heartbeat_ns: int | None, vehicle_ns: int) -> None:
        """Note the newest heartbeat of messages that caused nothing, and the vehicle's time at the last of them."""
        self._vehicle_ms = vehicle_ns // 1_000_000
        if heartbeat_ns is not None:
            self._heartbeat_ns = heartbeat_ns

    def quiet(self, now_ns: int) -> list[AlarmEvent]:
        """Note that Unix time has come to ``now_ns``; return the events that causes."""
        if SIGNING not in self._standing or now_ns - self._attacked_ns < _QUIET_NS:
            return []
        # At the end of the 10 s, whenever somebody looks.
        return [self._clear(SIGNING, self._attacked_ns + _QUIET_NS, "no more packets with a wrong signature")]

    def silent(self) -> None:
        """Note that all telemetry stopped: a missing heartbeat says nothing more until it comes again."""
        self._heartbeat_ns = None

    def adopt(self, event: AlarmEvent) -> None:
        """Go on from an event that another run of the monitor, or another monitor, made."""
        if event.state == "cleared":
            self._standing.pop(event.channel, None)
            return
        self._standing[event.channel] = event
        if event.channel == SIGNING:
            self._attacked_ns = event.time_ns

    def _attacked(self, message: Message, now_ns: int) -> list[AlarmEvent]:
        counts = {name: _count(message.fields.get(name)) for name in ("forged", "replayed", "unsigned")}
        total = sum(counts.values())
        if SIGNING not in self._standing:
            self._baseline = sum(self._counts.values())
        # A link that was opened anew counts from zero.
        if total < sum(self._counts.values()):
            self._baseline = 0
        self._counts = counts
        self._attacked_ns = now_ns
        said = ", ".join(f"{count} {name}" for name, count in counts.items() if count)
        text = f"packets with a wrong signature in the vehicle's name were refused: {said} so far"
        severity: Severity = "critical" if counts["forged"] or counts["replayed"] else "warning"
        size = float(total - self._baseline)
        standing = self._standing.get(SIGNING)
        if standing is None:
            return [self._raise(SIGNING, "security", severity, now_ns, size, "packets", text)]
        if now_ns - standing.time_ns < _SECOND_NS:
            return []
        return [self._event(SIGNING, replace(standing, severity=severity), "updated", now_ns, size, text)]

    def _raise(
        self, channel: str, kind: Kind, severity: Severity, now_ns: int, size: float | None, unit: str, text: str
    ) -> AlarmEvent:
        first = AlarmEvent(
            id=alarm_id(self._vehicle, OBSERVER, channel, now_ns),
            vehicle=self._vehicle,
            observer=OBSERVER,
            channel=channel,
            kind=kind,
            state="raised",
            severity=severity,
            estimate=size,
            relative=None,
            unit=unit,
            threshold=1.0 if channel == SIGNING else _HEARTBEAT_NS / 1e9,
            time_ns=now_ns,
            vehicle_time_ms=self._vehicle_ms,
            since_ns=now_ns,
            peak=size,
            message=text,
            seq=UNNUMBERED,
        )
        return self._event(channel, first, "raised", now_ns, size, text)

    def _clear(self, channel: str, now_ns: int, text: str) -> AlarmEvent:
        standing = self._standing[channel]
        event = self._event(channel, standing, "cleared", now_ns, standing.estimate, text)
        del self._standing[channel]
        return event

    def _event(
        self, channel: str, standing: AlarmEvent, state: State, now_ns: int, size: float | None, text: str
    ) -> AlarmEvent:
        event = replace(
            standing,
            state=state,
            time_ns=now_ns,
            vehicle_time_ms=self._vehicle_ms,
            estimate=size,
            peak=size,
            message=text,
            seq=UNNUMBERED,
        )
        self._standing[channel] = event
        return event


def _first(due: NDArray[np.bool_]) -> int:
    """Return the first index that is due, the number of them where none is."""
    return int(np.argmax(due)) if due.any() else len(due)


def _count(value: object) -> int:
    """Return a count as a recording may hold it: whole, and no larger than any link counts to."""
    return min(value, _MOST_PACKETS) if isinstance(value, int) and not isinstance(value, bool) and value > 0 else 0
