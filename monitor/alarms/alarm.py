"""From a channel's evidence to alarm events: five paths to raise it, hysteresis, debounce by time, severity, latching.

Paths, each with its own size and time, whichever comes first:

- sudden: a change of at least ``least``, or that grows to it within ``critical_ahead_s``, which is certain by a
  log-likelihood ratio of ``nats`` at once, while no other alarm of the observer is active
  (:mod:`monitor.estimation.changes`);
- fast: evidence beyond ``fast`` for ``fast_s``, for large faults;
- plain: evidence beyond ``threshold`` for ``raise_s``;
- slow: the exponentially weighted mean over ``slow_s`` beyond ``slow``, for small and creeping faults; evidence enters
  it with twice ``slow`` at most, so that it forgets a large fault as fast as a small one;
- lasting: the mean of all evidence since it began, of ``lasting_s`` at least and up to that of a flight, beyond
  ``lasting``, for what is smaller than peaks but does not end (:mod:`monitor.fitting.lasting`); evidence enters it with
  ``threshold`` at most.

The alarm clears after the evidence was inside ``clear`` for ``clear_s``, and where only a mean has seen it the mean
inside half of its size; where only the sudden path has seen it that time begins two seconds later, of what grows
``critical_ahead_s`` after them.
It is critical from the size ``critical`` on, and already where its growth leads there within ``critical_ahead_s``.
One that is raised for the third time within ``latch_s`` comes and goes: it clears only after ``latch_s`` of quiet. The
debounce is a clamped up/down counter of time, so evidence that drops out for a sample delays an alarm instead of losing
it. Samples that are no evidence (not in flight, bridged across lost measurements) change nothing. An event carries the
time at which its sample was known, so no event comes before its cause.

The rule is compiled (:mod:`monitor.core.alarms`) and processes rows one after the other; here are its sizes and times,
and the events that it causes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace

from adapters.sample import Samples
from monitor.core.alarms import CLEARED, RAISED, UPDATED, AlarmState
from monitor.display import battery_text, percent_text, size_text
from monitor.estimation.input_curve import relative_loss
from monitor.event import UNNUMBERED, AlarmEvent, Kind, State, alarm_id

DEFLECTION = "fraction of full deflection"
"""Unit of surfaces, steering and throttle."""

SPEED, CURRENT, THRUST = (f"fraction of {what} at hover" for what in ("speed", "current", "thrust"))
"""Units of what motors turn and draw, and propellers push."""
RESISTANCE = "fraction of usual resistance"
"""Unit of how far a battery's voltage gives way to its current."""
LOG_TIMES = "natural logarithm of times"
"""Unit of what is so many times as large as expected."""
CLIPS = "samples/s"
"""Unit of how often a sensor is at its end."""

LASTING_S = 10.0
"""Evidence that a mean of what lasts needs, seconds. Chosen: five times the slow path's, and the shortest flights known
to be fitted (13 s, docs/leaderboard.md) hold one."""
_LARGEST_LOG = 50.0
"""Beyond it nothing is measured; the exponential of more is no number that people read."""
_CHAIN = {
    SPEED: ("turns its motor", "slower", "faster", "commanded"),
    THRUST: ("pushes", "less", "more", "expected at its speed"),
    CURRENT: ("draws", "less current", "more current", "expected at its speed"),
    RESISTANCE: ("has", "less resistance", "more resistance", "usual"),
}
_ACTS = {"steering": ("turns", ""), "throttle": ("pushes", "")}
_HAS_EFFECT = ("has", " effect")
_AXES = {"north": ("north", "south"), "east": ("east", "west"), "down": ("below", "above")}


def alarm_message(
    observer: str, channel: str, kind: Kind, unit: str, state: State, size: float, relative: float | None
) -> str:
    """Return the sentence about a fault of a signed size in ``unit``, or of a share of the command where it has one."""
    if state == "cleared":
        return f"{channel} is back to normal"
    if kind == "residual":
        return f"{observer}: no known fault explains what is measured ({size_text(size, 'times healthy')})"
    if kind == "actuator" and unit == DEFLECTION:
        if relative is None:
            return f"{channel} is {size_text(abs(size), unit)} off its command"
        verb, noun = _ACTS.get(channel, _HAS_EFFECT)
        return f"{channel} {verb} {_percent(relative)}{noun} than commanded"
    if kind == "actuator" and relative is not None and unit in _CHAIN:
        verb, less, more, expected = _CHAIN[unit]
        return f"{channel} {verb} {percent_text(abs(relative))} % {less if relative < 0 else more} than {expected}"
    if kind == "actuator" and relative is not None:
        return f"{channel} delivers {_percent(relative)} than commanded"
    if unit == LOG_TIMES:
        return f"{channel} is {math.exp(min(size, _LARGEST_LOG)):.2g} times the level expected in this flight"
    if unit == CLIPS:
        return f"accelerometers are at the end of their range {size_text(size, unit)}: larger values are lost"
    if channel.startswith("disturbance_"):
        return f"{channel.removeprefix('disturbance_')} is disturbed by {size_text(size, unit, signed=True)}: no fault"
    sentence = _sensor(channel, unit, size)
    if sentence is not None:
        return sentence
    amount = size_text(size, unit, signed=True)
    return f"{channel} reads {amount} off" if kind == "sensor" else f"{channel} is off by {amount}"


def _percent(relative: float) -> str:
    return f"{percent_text(abs(relative))} % {'less' if relative < 0 else 'more'}"


def _sensor(channel: str, unit: str, size: float) -> str | None:
    """Return the sentence for a sensor whose name the field knows, None for any other."""
    name, _, axis = channel.rpartition("_")
    amount = size_text(abs(size), unit)
    if name == "gps":
        if axis not in _AXES:
            return None
        word = f"{_AXES[axis][size < 0]}{'' if axis == 'down' else ' of'}"
        return f"GPS is {amount} {word} where the inertial sensors say"
    if name == "motion" and axis in _AXES:
        return (
            f"GPS velocity and accelerations went {amount} apart, {_AXES[axis][size < 0]}: GPS, accelerometer, gyro or "
            "attitude is wrong; which one cannot be told"
        )
    if name == "gps_velocity":
        words = {"down": ("down", "up")}.get(axis, _AXES.get(axis))
        return None if words is None else f"GPS velocity is {amount} too much {words[size < 0]}"
    if channel == "baro":
        return f"barometer reads {amount} too {'high' if size > 0 else 'low'}"
    if channel == "compass":
        # the estimate counts turns on; nothing is further off than half of one
        off = math.remainder(size, math.tau)
        return f"compass is {size_text(abs(off), unit)} too far {'clockwise' if off > 0 else 'anticlockwise'}"
    if channel == "airspeed":
        return f"airspeed reads {amount} too {'fast' if size > 0 else 'slow'}"
    if name in ("gyro", "accel", "attitude"):
        part = {"gyro": "gyro", "accel": "accelerometer", "attitude": "attitude"}[name]
        return f"{part} {axis} reads {amount} too {'much' if size > 0 else 'little'}"
    return None


LEAST: Mapping[str, float] = {"slow_s": 0.01}
"""A mean over one sample of a 100 Hz observer is none; a time constant of zero would divide by zero."""
_LARGEST = 1e300
"""Twice as much is still a finite number, as the rule needs it."""
LATELY_NS = 10_000_000_000
"""An alarm that was raised no longer before another one may be its consequence. Chosen: what tells of a second sender
is counted over as long."""
_AFFECTED = "; affected: "
_STATES: Mapping[int, State] = {RAISED: "raised", UPDATED: "updated", CLEARED: "cleared"}


@dataclass(frozen=True, slots=True)
class AlarmRule:
    """What makes one channel's alarm."""

    observer: str  # what it watches
    channel: str
    kind: Kind  # sort of trouble
    unit: str  # unit of the sizes
    threshold: float  # size of the evidence that raises the alarm, that clears it, and that makes it critical
    clear: float
    critical: float
    # how long the evidence has to be beyond ``threshold`` to raise it, and inside ``clear`` to clear it, seconds
    raise_s: float
    clear_s: float
    fast: float = math.inf  # size that raises it after a shorter time; infinite size: no such path
    fast_s: float = 0.05
    """Five samples at 100 Hz: more than a glitch of two or three lost or damaged ones."""
    slow: float = math.inf  # size of the mean that raises it, and the mean's time constant; infinite size: no such path
    slow_s: float = 2.0
    """Longer than a gust or a manoeuvre moves an estimate, shorter than a pilot would wait (docs/thresholds.md)."""
    lasting: float = math.inf  # size of the mean of all evidence that raises it; infinite: no such path
    lasting_s: float = LASTING_S  # how much evidence such a mean needs, seconds
    latch_s: float = 0.0  # quiet that an alarm which comes and goes needs before it clears; 0: never latched
    # how far ahead its growth is looked at, for severity and where it grows from the start, seconds; 0: not at all
    critical_ahead_s: float = 5.0
    """Time that a pilot needs to land or to let go: chosen."""
    # Log-likelihood ratio of a sudden change that raises it at once, and the smallest size it has to have; infinite
    # nats: no such path
    nats: float = math.inf
    least: float = 0.0
    smallest: float = 0.0  # a user's smallest size worth an alarm: no path asks for less
    # size that evidence reaches in healthy flight, as rarely as false alarms are granted: where the residuals of a run
    # are larger than those of the flights that were fitted, what is asked of it grows with this size
    # (:mod:`monitor.estimation.bank`); 0: not at all
    healthy: float = 0.0
    # false alarms that are expected in 100 hours, and how many more the fitted flights exclude, at 95 %; None where
    # that was not measured
    false_per_100h: float | None = None
    excluded_per_100h: float | None = None
    sees: str = ""  # what size of fault it sees how fast, for people; empty where that was not measured


TUNABLE = tuple(key.name for key in fields(AlarmRule) if key.type == "float")
"""Keys of a rule that may change while the monitor runs."""
MEASURED = ("false_per_100h", "excluded_per_100h")
"""Keys of a rule that the fit measured of it as it is."""


def retuned(rule: AlarmRule, values: Mapping[str, object]) -> AlarmRule:
    """Return a copy of the rule with valid tunable values applied; other values are ignored.

    What was measured of the rule as it was does not hold of another.
    """
    valid = {
        key: float(value)
        for key in TUNABLE
        if isinstance(value := values.get(key), int | float)
        and not isinstance(value, bool)
        and (LEAST.get(key, 0.0) <= value <= _LARGEST or value == math.inf)
    }
    changed = replace(rule, **valid)  # type: ignore[arg-type]
    return rule if changed == rule else replace(changed, false_per_100h=None, excluded_per_100h=None)


def with_affected(message: str, channels: Sequence[str]) -> str:
    """Return an alarm's sentence with the channels that show something because of the alarm's cause."""
    own = message.partition(_AFFECTED)[0]
    return f"{own}{_AFFECTED}{', '.join(channels)}" if channels else own


class Alarm:
    """One channel's alarm: its rule, its state and the events that it causes.

    :meth:`set_rule` changes the rule; ``state`` is what it keeps from row to row, moved on by
    :func:`monitor.core.alarms.walk`.
    """

    def __init__(self, rule: AlarmRule, vehicle: str) -> None:
        self.state = AlarmState()
        self.set_rule(rule)
        self._vehicle = vehicle
        self._id = ""
        self.since_ns = 0
        self._last: AlarmEvent | None = None
        self._affected: list[str] = []

    def set_rule(self, rule: AlarmRule) -> None:
        """Apply other sizes and times from the next row on."""
        self.rule = rule
        self.state.set_rule(rule)

    def adopt(self, event: AlarmEvent) -> None:
        """Go on from an event of this channel that another run of the monitor, or another monitor, made."""
        if event.state == "cleared":
            self.state.deactivate()
            return
        self._id, self.since_ns, self._last = event.id, event.since_ns, event
        estimate = event.estimate or 0.0
        self.state.resume(
            estimate=estimate,
            peak=event.peak if event.peak is not None else estimate,
            # JSON has no infinity, so a size may come back as nothing.
            size=self.rule.threshold if event.threshold is None else event.threshold,
            reported_ns=event.vehicle_time_ms * 1_000_000,
            critical=event.severity == "critical",
            creeping=event.creeping,
            recurring=event.recurring,
        )

    def event(
        self,
        code: int,
        samples: Samples,
        row: int,
        command: float | None = None,
        relative: float | None = None,
        sd: float | None = None,
    ) -> AlarmEvent:
        """Return the event that the latest row, one of the observer's samples, caused.

        ``code`` (RAISED, UPDATED or CLEARED) is what the rule returned for the row. ``command`` is what the fault takes
        its share of, where that makes sense; ``relative`` that share, where it is known in another way; ``sd`` the
        standard deviation of the size.
        """
        rule, now = self.rule, self.state
        vehicle_ns, time_ns = int(samples.vehicle_time_ns[row]), int(samples.time_ns[row])
        late_ns = max(0, int(samples.known_ns[row]) - vehicle_ns)
        if code == RAISED:
            self._affected.clear()
            self._id = alarm_id(self._vehicle, rule.observer, rule.channel, time_ns)
            self.since_ns = time_ns + late_ns
        if command is not None:
            # current and resistance may be any number of times the usual one
            unbounded = rule.unit in (CURRENT, RESISTANCE) and command
            relative = now.shown / command if unbounded else relative_loss(now.shown, command)
        state = _STATES[code]
        message = alarm_message(rule.observer, rule.channel, rule.kind, rule.unit, state, now.shown, relative)
        if rule.unit == RESISTANCE and code != CLEARED:
            message += f": {battery_text(*samples.u[row, 1:])}"
        if now.recurring and code != CLEARED:
            message = f"{message} (it comes and goes)"
        if code != CLEARED:
            message = with_affected(message, self._affected)
        return self._event(state, time_ns + late_ns, vehicle_ns + late_ns, message, relative, sd)

    def affect(self, channel: str, time_ns: int, vehicle_ns: int) -> AlarmEvent | None:
        """Say that this alarm explains what another channel shows; return the event, None where that is known."""
        last = self._last
        if not self.state.active or last is None or channel in self._affected:
            return None
        self._affected.append(channel)
        message = with_affected(last.message, self._affected)
        vehicle_ms = vehicle_ns // 1_000_000
        self._last = replace(last, state="updated", message=message, time_ns=time_ns, vehicle_time_ms=vehicle_ms)
        return self._last

    def close(self, time_ns: int, vehicle_ns: int, why: str) -> AlarmEvent:
        """End an active alarm whatever its evidence says, and forget that; return the event."""
        event = self._event("cleared", time_ns, vehicle_ns, why, None, None)
        self.state.deactivate()
        return event

    def withdraw(self, time_ns: int, vehicle_ns: int, why: str) -> AlarmEvent | None:
        """End an alarm that another one, raised soon after it, explains; return the event, None where that is none."""
        if not self.state.active or not 0 <= time_ns - self.since_ns < LATELY_NS:
            return None
        return self.close(time_ns, vehicle_ns, why)

    def _event(
        self, state: State, time_ns: int, vehicle_ns: int, message: str, relative: float | None, sd: float | None
    ) -> AlarmEvent:
        rule, now = self.rule, self.state
        self._last = AlarmEvent(
            id=self._id,
            vehicle=self._vehicle,
            observer=rule.observer,
            channel=rule.channel,
            kind=rule.kind,
            state=state,
            severity="critical" if now.critical else "warning",
            estimate=now.shown,
            relative=relative,
            unit=rule.unit,
            threshold=now.size,
            time_ns=time_ns,
            vehicle_time_ms=vehicle_ns // 1_000_000,
            since_ns=self.since_ns,
            peak=now.peak,
            message=message,
            seq=UNNUMBERED,
            creeping=now.creeping,
            recurring=now.recurring,
            false_per_100h=rule.false_per_100h,
            sd=sd,
        )
        return self._last
