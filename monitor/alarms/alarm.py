"""From a channel's evidence to alarm events: three paths to raise it, hysteresis, debounce by time, severity, latching.

Paths, each with its own size and time, whichever comes first:

- fast: evidence beyond ``fast`` for ``fast_s``, for large faults;
- plain: evidence beyond ``threshold`` for ``raise_s``;
- slow: the exponentially weighted mean over ``slow_s`` beyond ``slow``, for small and creeping faults; evidence enters
  it with twice ``slow`` at most, so that it forgets a large fault as fast as a small one.

The alarm clears after the evidence has stood inside ``clear`` for ``clear_s``, and where only the slow path has seen it
the mean inside half of ``slow``.
It is critical from the size ``critical`` on, and already where its growth leads there within ``critical_ahead_s``.
One that is raised for the third time within ``latch_s`` comes and goes: it is latched, which is to say it clears only
after ``latch_s`` of quiet. The debounce is a clamped up/down counter of time, so evidence that drops out for a sample
delays an alarm instead of losing it. Samples that are no evidence (not in flight, bridged across lost measurements)
leave everything as it stands. An event carries the time at which its sample was known, so none comes before its cause.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from adapters.sample import Sample
from monitor.alarms.alarm_message import alarm_message
from monitor.alarms.trend import Trend
from monitor.estimation.input_curve import relative_loss
from monitor.event import UNNUMBERED, AlarmEvent, Kind, Severity, State, alarm_id

_UPDATE_EVERY_NS = 1_000_000_000
_UPDATE_SHARE = 0.15
_COMES_AND_GOES = 3
_LEAST = {"slow_s": 0.01}
_LARGEST = 1e300


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
        Unit of the sizes.
    threshold, clear, critical : float
        Size of the evidence that raises the alarm, that clears it, and that makes it critical.
    raise_s, clear_s : float
        How long the evidence has to stand, seconds.
    fast, fast_s : float
        Size that raises it after a shorter time; infinite size: no such path.
    slow, slow_s : float
        Size of the mean that raises it, and the mean's time constant; infinite size: no such path.
    latch_s : float
        Quiet that an alarm which comes and goes needs before it clears; 0: never latched.
    critical_ahead_s : float
        How far ahead its growth is looked at for severity, seconds; 0: not at all.
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
    fast: float = math.inf
    fast_s: float = 0.05
    slow: float = math.inf
    slow_s: float = 2.0
    latch_s: float = 0.0
    critical_ahead_s: float = 5.0


TUNABLE = (
    "threshold",
    "clear",
    "critical",
    "raise_s",
    "clear_s",
    "fast",
    "fast_s",
    "slow",
    "slow_s",
    "latch_s",
    "critical_ahead_s",
)
"""Keys of a rule that may change while the monitor runs."""


def retuned(rule: AlarmRule, values: Mapping[str, object]) -> AlarmRule:
    """Return a rule with those of its sizes and times changed that are named and are numbers it can have."""
    found = {
        key: float(value)
        for key in TUNABLE
        if isinstance(value := values.get(key), int | float)
        and not isinstance(value, bool)
        and (_LEAST.get(key, 0.0) <= value <= _LARGEST or value == math.inf)
    }
    return replace(rule, **found)  # type: ignore[arg-type]


@dataclass(frozen=True, slots=True)
class _Active:
    """An alarm that stands."""

    id: str
    since_ns: int
    threshold: float
    peak: float
    severity: Severity
    reported: float
    reported_ns: int
    creeping: bool
    latched: bool


@dataclass(frozen=True, slots=True)
class Standing:
    """What an alarm that stands remembers from one sample to the next, besides its latest event.

    Parameters
    ----------
    mean : float
        Weighted mean of the evidence.
    trend : tuple[float, float, float]
        State of its growth.
    peak : float
        Largest evidence by size.
    counter_ns : int
        How long the evidence has stood inside ``clear``.
    last_ns : int | None
        Vehicle time of the last sample that was evidence.
    """

    mean: float
    trend: tuple[float, float, float]
    peak: float
    counter_ns: int
    last_ns: int | None


class Alarm:
    """State of one channel's alarm.

    Parameters
    ----------
    rule : AlarmRule
        Sizes and times.
    vehicle : str
        The vehicle's name in events.
    """

    def __init__(self, rule: AlarmRule, vehicle: str) -> None:
        self.rule = rule
        self._vehicle = vehicle
        self._active: _Active | None = None
        self._counter_ns = self._fast_ns = 0
        self._mean = 0.0
        self._relative: float | None = None
        self._last_ns: int | None = None
        self._trend = Trend()
        self._raised_ns: deque[int] = deque(maxlen=_COMES_AND_GOES)

    @property
    def active(self) -> bool:
        """Whether the alarm stands."""
        return self._active is not None

    @property
    def idle(self) -> bool:
        """Whether no alarm stands and none is on its way: evidence inside all sizes moves the mean, nothing else."""
        return self._active is None and not self._counter_ns and not self._fast_ns

    @property
    def mean(self) -> float:
        """Weighted mean of the evidence, for the slow path."""
        return self._mean

    @property
    def last_ns(self) -> int | None:
        """Vehicle time of the sample before, where it was evidence."""
        return self._last_ns

    def pause(self) -> None:
        """Note that time passes without evidence."""
        self._last_ns = None

    def rest(self, mean: float, last_ns: int | None) -> None:
        """Go on where a stretch of evidence that caused nothing left mean and time (``alarm_stretch``)."""
        self._mean, self._last_ns = mean, last_ns

    def stand(self, times_ns: Sequence[int], evidence: Sequence[float]) -> tuple[int, Standing]:
        """Return how many samples in a row cause nothing while the alarm stands, and what it remembers after them.

        Nothing is changed: :meth:`go_on_from` does it. Vehicle times and signed sizes are those of samples that are
        evidence and no restart; the rules and their rounding are those of :meth:`update`, which has to be given the
        sample behind the count.
        """
        rule, active = self.rule, self._active
        assert active is not None  # noqa: S101 - asked only of an alarm that stands
        trend, mean, peak, counter, last = Trend(), self._mean, active.peak, self._counter_ns, self._last_ns
        trend.state = before = self._trend.state
        averaged, ahead_s, clear = rule.slow < math.inf, rule.critical_ahead_s, rule.clear
        limit_ns = (rule.latch_s if active.latched else rule.clear_s) * 1e9
        worsens = rule.critical if active.severity != "critical" else math.inf
        moves = max(_UPDATE_SHARE * abs(active.reported), active.threshold / 2)
        kept_ns, keep, count = -1, 0.0, 0
        for now, size in zip(times_ns, evidence, strict=True):
            elapsed = 0 if last is None else max(0, now - last)
            average = mean
            if elapsed and averaged:
                if elapsed != kept_ns:
                    kept_ns, keep = elapsed, math.exp(-elapsed / (rule.slow_s * 1e9))
                average = keep * mean + (1.0 - keep) * max(-2.0 * rule.slow, min(size, 2.0 * rule.slow))
            if active.creeping and not abs(size) < rule.threshold:
                break
            shown = average if active.creeping else size
            trend.update(shown, elapsed)
            if abs(shown) >= worsens or (ahead_s > 0 and trend.size_in(ahead_s) >= worsens):
                break
            if abs(size) < clear and not (active.creeping and abs(average) >= 0.5 * rule.slow):
                counted = counter + elapsed
                if counted >= limit_ns:
                    break
            else:
                counted = 0 if active.latched else max(0, counter - elapsed)
                if abs(shown - active.reported) > moves and not 0 <= now - active.reported_ns < _UPDATE_EVERY_NS:
                    break
            if abs(shown) > abs(peak):
                peak = shown
            mean, counter, last, before = average, counted, now, trend.state
            count += 1
        return count, Standing(mean, before, peak, counter, last)

    def go_on_from(self, standing: Standing) -> None:
        """Go on where :meth:`stand` came to."""
        assert self._active is not None  # noqa: S101 - as in stand
        self._mean, self._counter_ns, self._last_ns = standing.mean, standing.counter_ns, standing.last_ns
        self._trend.state = standing.trend
        self._active = replace(self._active, peak=standing.peak)

    def adopt(self, event: AlarmEvent) -> None:
        """Go on from an event of this channel that another run of the monitor, or another monitor, made."""
        if event.state == "cleared":
            self._active = None
            return
        self._counter_ns = self._fast_ns = 0
        self._trend = Trend()
        estimate = event.estimate or 0.0
        self._mean = estimate if event.creeping else 0.0
        self._active = _Active(
            id=event.id,
            since_ns=event.since_ns,
            # JSON has no infinity, so a size may come back as nothing.
            threshold=self.rule.threshold if event.threshold is None else event.threshold,
            peak=event.peak if event.peak is not None else estimate,
            severity=event.severity,
            reported=estimate,
            reported_ns=event.vehicle_time_ms * 1_000_000,
            creeping=event.creeping,
            latched=event.recurring,
        )

    def update(
        self, sample: Sample, evidence: float, command: float | None, relative: float | None = None
    ) -> AlarmEvent | None:
        """Take one sample's evidence; return the event it causes, if any.

        Parameters
        ----------
        sample : Sample
            Gives the times.
        evidence : float
            Signed size of the fault, in the rule's unit.
        command : float | None
            What the fault takes its share of, where that makes sense.
        relative : float | None
            That share, where it is known in another way and ``command`` is None.
        """
        rule, now = self.rule, sample.vehicle_time_ns
        self._relative = relative
        # The clock of a vehicle that rebooted jumps back.
        elapsed = 0 if self._last_ns is None else max(0, now - self._last_ns)
        self._last_ns = now
        if sample.restart:
            # An observer that starts anew climbs back to a fault: no growth of the fault. What keeps an alarm standing
            # is not forgotten meanwhile, or the alarm would come back as another one.
            if self._active is None or not self._active.creeping:
                self._mean = 0.0
            self._trend = Trend()
        elif elapsed and rule.slow < math.inf:
            limited = max(-2.0 * rule.slow, min(evidence, 2.0 * rule.slow))
            keep = math.exp(-elapsed / (rule.slow_s * 1e9))
            self._mean = keep * self._mean + (1.0 - keep) * limited
        if self._active is not None:
            return self._while_active(self._active, sample, evidence, command, elapsed)
        size = abs(evidence)
        self._counter_ns = _counted(self._counter_ns, elapsed, size >= rule.threshold)
        self._fast_ns = _counted(self._fast_ns, elapsed, size >= rule.fast)
        if size >= rule.fast and self._fast_ns >= rule.fast_s * 1e9:
            return self._raise(sample, evidence, command, rule.fast, creeping=False)
        if size >= rule.threshold and self._counter_ns >= rule.raise_s * 1e9:
            return self._raise(sample, evidence, command, rule.threshold, creeping=False)
        if abs(self._mean) >= rule.slow:
            return self._raise(sample, self._mean, command, rule.slow, creeping=True)
        return None

    def _raise(
        self, sample: Sample, evidence: float, command: float | None, threshold: float, *, creeping: bool
    ) -> AlarmEvent:
        now = sample.vehicle_time_ns
        self._counter_ns = self._fast_ns = 0
        self._trend = Trend()
        self._raised_ns.append(now)
        often = len(self._raised_ns) == _COMES_AND_GOES and 0 <= now - self._raised_ns[0] <= self.rule.latch_s * 1e9
        self._active = _Active(
            id=alarm_id(self._vehicle, self.rule.observer, self.rule.channel, sample.time_ns),
            since_ns=sample.time_ns + sample.later_ns,
            threshold=threshold,
            peak=evidence,
            severity="critical" if abs(evidence) >= self.rule.critical else "warning",
            reported=evidence,
            reported_ns=now,
            creeping=creeping,
            latched=often,
        )
        return self._event(sample, "raised", evidence, command)

    def _while_active(
        self, active: _Active, sample: Sample, evidence: float, command: float | None, elapsed: int
    ) -> AlarmEvent | None:
        rule, now = self.rule, sample.vehicle_time_ns
        # What only the slow path sees is still best described by its mean.
        creeping = active.creeping and abs(evidence) < rule.threshold
        shown = self._mean if creeping else evidence
        self._trend.update(shown, elapsed)
        size = max(abs(shown), self._trend.size_in(rule.critical_ahead_s) if rule.critical_ahead_s > 0 else 0.0)
        worse: Severity = "critical" if size >= rule.critical else active.severity
        peak = max(active.peak, shown, key=abs)
        if peak is not active.peak or worse != active.severity or creeping != active.creeping:
            self._active = replace(active, peak=peak, severity=worse, creeping=creeping)
        if abs(evidence) < rule.clear and not (creeping and abs(self._mean) >= 0.5 * rule.slow):
            self._counter_ns += elapsed
            if self._counter_ns >= (rule.latch_s if active.latched else rule.clear_s) * 1e9:
                event = self._event(sample, "cleared", shown, command)
                self._active = None
                self._counter_ns = 0
                self._mean = 0.0
                return event
            return None
        self._counter_ns = 0 if active.latched else max(0, self._counter_ns - elapsed)
        moved = abs(shown - active.reported) > max(_UPDATE_SHARE * abs(active.reported), active.threshold / 2)
        due = not 0 <= now - active.reported_ns < _UPDATE_EVERY_NS
        if worse != active.severity or (moved and due):
            self._active = replace(self._active or active, reported=shown, reported_ns=now)
            return self._event(sample, "updated", shown, command)
        return None

    def _event(self, sample: Sample, state: State, evidence: float, command: float | None) -> AlarmEvent:
        active = self._active
        assert active is not None  # noqa: S101 - an event is only made while the alarm stands
        rule = self.rule
        relative = self._relative if command is None else relative_loss(evidence, command)
        message = alarm_message(rule.observer, rule.channel, rule.kind, rule.unit, state, evidence, relative)
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
            threshold=active.threshold,
            time_ns=sample.time_ns + sample.later_ns,
            vehicle_time_ms=(sample.vehicle_time_ns + sample.later_ns) // 1_000_000,
            since_ns=active.since_ns,
            peak=active.peak,
            message=f"{message} (it comes and goes)" if active.latched and state != "cleared" else message,
            seq=UNNUMBERED,
            creeping=active.creeping,
            recurring=active.latched,
        )


def _counted(counter_ns: int, elapsed: int, beyond: bool) -> int:
    return counter_ns + elapsed if beyond else max(0, counter_ns - elapsed)
