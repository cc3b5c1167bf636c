"""From a channel's evidence to alarm events: threshold, hysteresis, debounce by time, severity.

Raised after the evidence has stood beyond the threshold for ``raise_s``, cleared after it has stood inside
``clear`` for ``clear_s``. The debounce is a clamped up/down counter of time, so evidence that drops out for a
sample delays an alarm instead of losing it. Samples that are no evidence (not in flight, bridged across lost
measurements) leave everything as it stands.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from adapters.sample import Sample
from monitor.event import AlarmEvent, Kind, Severity, State, alarm_id

_UPDATE_EVERY_NS = 1_000_000_000
_UPDATE_SHARE = 0.15


@dataclass(frozen=True, slots=True)
class AlarmRule:
    """What makes one channel's alarm.

    Parameters
    ----------
    observer, channel : str
        What it watches.
    kind : {"actuator", "sensor", "residual", "stale"}
        Sort of trouble.
    unit : str
        Unit of the thresholds.
    threshold, clear, critical : float
        Size of the evidence that raises the alarm, that clears it, and that makes it critical.
    raise_s, clear_s : float
        How long the evidence has to stand, seconds.
    """

    observer: str
    channel: str
    kind: Kind
    unit: str
    threshold: float
    clear: float
    critical: float
    raise_s: float
    clear_s: float


@dataclass(frozen=True, slots=True)
class _Active:
    """An alarm that stands."""

    id: str
    since_ns: int
    peak: float
    severity: Severity
    reported: float
    reported_ns: int


class Alarm:
    """State of one channel's alarm.

    Parameters
    ----------
    rule : AlarmRule
        Thresholds and times.
    vehicle : str
        The vehicle's name in events.
    count : Callable[[], int]
        Gives the next event's sequence number.
    """

    def __init__(self, rule: AlarmRule, vehicle: str, count: Callable[[], int]) -> None:
        self.rule = rule
        self._vehicle = vehicle
        self._count = count
        self._active: _Active | None = None
        self._counter_ns = 0
        self._last_ns: int | None = None

    @property
    def active(self) -> bool:
        """Whether the alarm stands."""
        return self._active is not None

    def pause(self) -> None:
        """Note that time passes without evidence."""
        self._last_ns = None

    def update(self, sample: Sample, evidence: float, relative: float | None) -> AlarmEvent | None:
        """Take one sample's evidence; return the event it causes, if any.

        Parameters
        ----------
        sample : Sample
            Gives the times.
        evidence : float
            Signed size of the fault, in the rule's unit.
        relative : float | None
            Evidence over command where that makes sense.
        """
        rule = self.rule
        now = sample.vehicle_time_ns
        elapsed = 0 if self._last_ns is None else now - self._last_ns
        self._last_ns = now
        size = abs(evidence)
        if self._active is None:
            if size < rule.threshold:
                self._counter_ns = max(0, self._counter_ns - elapsed)
                return None
            self._counter_ns += elapsed
            if self._counter_ns < rule.raise_s * 1e9:
                return None
            self._counter_ns = 0
            self._active = _Active(
                id=alarm_id(self._vehicle, rule.observer, rule.channel, sample.time_ns),
                since_ns=sample.time_ns,
                peak=evidence,
                severity=self._severity(size),
                reported=evidence,
                reported_ns=now,
            )
            return self._event(sample, "raised", evidence, relative)
        return self._while_active(self._active, sample, evidence, relative, elapsed)

    def _while_active(
        self, active: _Active, sample: Sample, evidence: float, relative: float | None, elapsed: int
    ) -> AlarmEvent | None:
        rule = self.rule
        size = abs(evidence)
        worse: Severity = "critical" if "critical" in (active.severity, self._severity(size)) else "warning"
        self._active = replace(active, peak=max(active.peak, evidence, key=abs), severity=worse)
        if size < rule.clear:
            self._counter_ns += elapsed
            if self._counter_ns >= rule.clear_s * 1e9:
                event = self._event(sample, "cleared", evidence, relative)
                self._active = None
                self._counter_ns = 0
                return event
            return None
        self._counter_ns = max(0, self._counter_ns - elapsed)
        moved = abs(evidence - active.reported) > max(_UPDATE_SHARE * abs(active.reported), rule.threshold / 2)
        due = sample.vehicle_time_ns - active.reported_ns >= _UPDATE_EVERY_NS
        if worse != active.severity or (moved and due):
            self._active = replace(self._active, reported=evidence, reported_ns=sample.vehicle_time_ns)
            return self._event(sample, "updated", evidence, relative)
        return None

    def _severity(self, size: float) -> Severity:
        return "critical" if size >= self.rule.critical else "warning"

    def _event(self, sample: Sample, state: State, evidence: float, relative: float | None) -> AlarmEvent:
        active = self._active
        assert active is not None  # noqa: S101 - an event is only made while the alarm stands
        rule = self.rule
        return AlarmEvent(
            id=active.id,
            vehicle=self._vehicle,
            observer=rule.observer,
            channel=rule.channel,
            kind=rule.kind,
            state=state,
            severity=active.severity,
            estimate=evidence,
            relative=relative,
            unit=rule.unit,
            threshold=rule.threshold,
            time_ns=sample.time_ns,
            vehicle_time_ms=sample.vehicle_time_ns // 1_000_000,
            since_ns=active.since_ns,
            peak=active.peak,
            message=alarm_message(rule, state, evidence, relative),
            seq=self._count(),
        )


def alarm_message(rule: AlarmRule, state: State, evidence: float, relative: float | None) -> str:
    """Return the sentence a pilot reads."""
    if state == "cleared":
        return f"{rule.channel} is back to normal"
    if rule.kind == "actuator" and relative is not None:
        direction = "less" if relative < 0 else "more"
        return f"{rule.channel} delivers {100 * abs(relative):.0f} % {direction} than commanded"
    if rule.kind == "residual":
        return f"{rule.observer}: no known fault explains what is measured ({evidence:.1f} times healthy)"
    if rule.kind == "sensor":
        return f"{rule.channel} reads {_size(evidence, rule.unit)} off"
    return f"{rule.channel} is off by {_size(evidence, rule.unit)}"


def _size(value: float, unit: str) -> str:
    return f"{value:+.3g} {unit}".rstrip()
