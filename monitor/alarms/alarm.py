"""Turn the evidence of one channel into alarm events.

Five paths raise an alarm; hysteresis and a debounce by time clear it. Each path has its own size and time; the first
that is satisfied raises the alarm:

- sudden: a change of at least ``least`` whose log-likelihood ratio reaches ``nats``, or a growing change that will be
  that large within ``critical_ahead_s``. It raises at once, unless another alarm of the observer is active
  (:mod:`monitor.estimation.changes`);
- fast: evidence above ``fast`` for ``fast_s``, for large faults;
- plain: evidence above ``threshold`` for ``raise_s``;
- slow: the exponentially weighted mean over ``slow_s`` above ``slow``, for small and slowly growing faults. Evidence
  enters this mean with at most twice ``slow``, so that the mean forgets a large fault as fast as a small one;
- lasting: the mean of all evidence since it began (of ``lasting_s`` to a whole flight) above ``lasting``, for small
  faults that do not end (:mod:`monitor.fitting.lasting`). Evidence enters this mean with at most ``threshold``.

A sensor that is frozen raises its alarm at once, and keeps it active (:class:`monitor.core.repeats.Frozen`).

The alarm clears after the evidence has been below ``clear`` for ``clear_s``. If only a mean has seen the fault, that
mean has to be below half of its size. If only the sudden path has seen the fault, the time begins two seconds later,
and for a growing change another ``critical_ahead_s`` later. The alarm is critical from the size ``critical`` on, or as
soon as its growth leads there within ``critical_ahead_s``. An alarm that is raised for the third time within
``latch_s`` comes and goes: it clears after ``clear_s`` more than the longest time without evidence that it returned
from, and after ``latch_s`` at most.

The debounce is a counter of time that counts up and down between limits: a sample without evidence delays an alarm and
does not cancel it. Samples that are no evidence (not in flight, bridged across lost measurements) change nothing. An
event carries the time at which its sample was known, so no event comes before its cause. The rule is compiled
(:mod:`monitor.core.alarms`) and processes rows one after the other. This module has its sizes and times, and the events
that it causes.
"""

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
"""Units of motor speed, of current, and of a propeller's thrust."""
RESISTANCE = "fraction of usual resistance"
"""Unit of a battery's internal resistance."""
LOG_TIMES = "natural logarithm of times"
"""Unit of a quantity that is given relative to its expected value."""
CLIPS = "samples/s"
"""Unit of how often a sensor reaches the end of its range."""

LASTING_S = 10.0
"""Shortest evidence for the mean of a lasting fault, seconds. Chosen: five times the slow path's, and the shortest
flights known to be fitted (13 s, docs/leaderboard.md) are longer."""
_LARGEST_LOG = 50.0
"""Limit of a logarithmic size: no measurement is larger, and nobody reads the exponential of more."""
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
    """Return the sentence about a fault of a signed size in ``unit``, or of a share of the command."""
    if state == "cleared":
        if channel.startswith("motion_"):
            return f"{channel}: GPS and accelerations agree again; a GPS that was led away may still be off"
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
    """Return the sentence for a sensor with a known name, otherwise None."""
    name, _, axis = channel.rpartition("_")
    amount = size_text(abs(size), unit)
    if name == "gps":
        if axis not in _AXES:
            return None
        word = f"{_AXES[axis][size < 0]}{'' if axis == 'down' else ' of'}"
        return f"GPS is {amount} {word} where the inertial sensors say"
    if name == "motion" and axis in _AXES:
        return (
            f"GPS velocity and accelerations differ by {amount} {_AXES[axis][size < 0]}: GPS, accelerometer, gyro or "
            "attitude is wrong; which one cannot be told"
        )
    if name == "gps_velocity":
        words = {"down": ("down", "up")}.get(axis, _AXES.get(axis))
        return None if words is None else f"GPS velocity is {amount} too much {words[size < 0]}"
    if channel == "baro":
        return f"barometer reads {amount} too {'high' if size > 0 else 'low'}"
    if channel == "compass":
        # The estimate of a heading may count whole turns; a compass is off by half a turn at most.
        off = math.remainder(size, math.tau)
        return f"compass is {size_text(abs(off), unit)} too far {'clockwise' if off > 0 else 'anticlockwise'}"
    if channel == "airspeed":
        return f"airspeed reads {amount} too {'fast' if size > 0 else 'slow'}"
    if name in ("gyro", "accel", "attitude"):
        part = {"gyro": "gyro", "accel": "accelerometer", "attitude": "attitude"}[name]
        return f"{part} {axis} reads {amount} too {'much' if size > 0 else 'little'}"
    return None


LEAST: Mapping[str, float] = {"slow_s": 0.01}
"""Shortest time constant of a mean: one sample of a 100 Hz observer. A time constant of zero would divide by zero."""
_LARGEST = 1e300
"""Largest size: twice as much is still a finite number, which the rule needs."""
LATELY_NS = 10_000_000_000
"""An alarm that was raised at most this long before another one may be its consequence. Chosen: evidence of a second
sender is counted over the same time."""
AFFECTED = "; affected: "
"""What precedes the channels that an alarm lists as affected by its cause, in its sentence."""
_DOUBTED = "; or a second sender makes it look so"
_STATES: Mapping[int, State] = {RAISED: "raised", UPDATED: "updated", CLEARED: "cleared"}


@dataclass(frozen=True, slots=True)
class AlarmRule:
    """The rule of one channel's alarm."""

    observer: str  # the channel
    channel: str
    kind: Kind  # kind of alarm
    unit: str  # unit of the sizes
    threshold: float  # size of the evidence that raises the alarm, that clears it, and that makes it critical
    clear: float
    critical: float
    # how long the evidence has to be above ``threshold`` to raise it, and below ``clear`` to clear it, seconds
    raise_s: float
    clear_s: float
    fast: float = math.inf  # size that raises it after a shorter time; infinite: no such path
    fast_s: float = 0.05
    """Five samples at 100 Hz: more than a glitch of two or three lost or damaged ones."""
    slow: float = math.inf  # size of the mean that raises it, and the mean's time constant; infinite: no such path
    slow_s: float = 2.0
    """Longer than a gust or a manoeuvre moves an estimate, shorter than a pilot would wait (docs/thresholds.md)."""
    lasting: float = math.inf  # size of the mean of all evidence that raises it; infinite: no such path
    lasting_s: float = LASTING_S  # shortest evidence for such a mean, seconds
    # longest time without evidence that an alarm which comes and goes needs before it clears; 0: never latched
    latch_s: float = 0.0
    # how far its growth is extrapolated, for the severity and for a fault that grows from its start, seconds; 0: not at
    # all
    critical_ahead_s: float = 5.0
    """Time that a pilot needs to land or to take over: chosen."""
    # log-likelihood ratio of a sudden change that raises it at once, and the smallest size of such a change; infinite
    # nats: no such path
    nats: float = math.inf
    least: float = 0.0
    smallest: float = 0.0  # the user's smallest size worth an alarm: no path raises below it
    # size that healthy evidence exceeds only at the granted rate of false alarms. If the residuals of a run are larger
    # than those of the fitted flights, the sizes that raise the alarm grow by this size
    # (:mod:`monitor.estimation.bank`); 0: they do not grow
    healthy: float = 0.0
    # expected false alarms in 100 hours, and the rate above which the fitted flights exclude more, at 95 %; None: not
    # measured
    false_per_100h: float | None = None
    excluded_per_100h: float | None = None
    sees: str = ""  # size of fault that it detects and how fast, for people; empty: not measured


TUNABLE = tuple(key.name for key in fields(AlarmRule) if key.type is float)
"""Keys of a rule that may change while the monitor runs."""
MEASURED = ("false_per_100h", "excluded_per_100h")
"""Keys of a rule that hold what the fit measured of exactly this rule."""


def retuned(rule: AlarmRule, values: Mapping[str, object]) -> AlarmRule:
    """Return a copy of the rule with the valid tunable values applied; other values are ignored.

    The figures that the fit measured are dropped, since they do not hold for the changed rule.
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
    """Return an alarm's sentence with the channels that are affected by the alarm's cause."""
    own = message.partition(AFFECTED)[0]
    return f"{own}{AFFECTED}{', '.join(channels)}" if channels else own


class Alarm:
    """One channel's alarm: its rule, its state and its events.

    :meth:`set_rule` changes the rule. ``state`` is what the alarm remembers from row to row;
    :func:`monitor.core.alarms.walk` updates it.
    """

    def __init__(self, rule: AlarmRule, vehicle: str) -> None:
        self.state = AlarmState()
        self.set_rule(rule)
        self._vehicle = vehicle
        self._id = ""
        self.since_ns = 0
        self._last: AlarmEvent | None = None
        self._affected: list[str] = []
        self._doubted = False  # whether a second sender's telemetry may look like its fault

    def set_rule(self, rule: AlarmRule) -> None:
        """Apply other sizes and times from the next row on."""
        self.rule = rule
        self.state.set_rule(rule)

    def adopt(self, event: AlarmEvent) -> None:
        """Continue from an event of this channel that an earlier run, or another monitor, has published."""
        if event.state == "cleared":
            self.state.deactivate()
            return
        self._id, self.since_ns, self._last = event.id, event.since_ns, event
        estimate = event.estimate or 0.0
        self.state.resume(
            estimate=estimate,
            peak=event.peak if event.peak is not None else estimate,
            # JSON has no infinity, so a size may be None.
            size=self.rule.threshold if event.threshold is None else event.threshold,
            sd=math.nan if event.sd is None else event.sd,
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
        instead: str | None = None,
        *,
        let_go: bool = False,
    ) -> AlarmEvent:
        """Return the event of the latest row.

        ``code`` (RAISED, UPDATED or CLEARED) is what the rule returned for the row. ``command`` is the command of which
        the fault takes a share, if that makes sense; ``relative`` is that share if it is known in another way; ``sd``
        is the standard deviation of the size; ``instead`` the channel that may be responsible in place of this one.
        A fault that was ``let_go`` has not been seen to end.
        """
        rule, now = self.rule, self.state
        vehicle_ns, time_ns = int(samples.vehicle_time_ns[row]), int(samples.time_ns[row])
        late_ns = max(0, int(samples.known_ns[row]) - vehicle_ns)
        if code == RAISED:
            self._affected.clear()
            self._id = alarm_id(self._vehicle, rule.observer, rule.channel, time_ns)
            self.since_ns = time_ns + late_ns
        if command is not None:
            # current and resistance may be many times the expected value
            unbounded = rule.unit in (CURRENT, RESISTANCE) and command
            relative = now.shown / command if unbounded else relative_loss(now.shown, command)
        state = _STATES[code]
        message = alarm_message(rule.observer, rule.channel, rule.kind, rule.unit, state, now.shown, relative)
        if rule.unit == RESISTANCE and code != CLEARED:
            message += f": {battery_text(*samples.u[row, 1:])}"
        if let_go and code == CLEARED:
            message = f"{rule.channel}: whether the fault is gone is not known; a constant one shows only as it changes"
        if instead is not None:
            message += f"; it may be {instead} instead, the two are not told apart yet"
        seen = abs(now.shown) >= rule.clear
        if now.frozen:
            message = f"{message if seen else rule.channel}: frozen, it repeats one reading exactly"
        if now.recurring and code != CLEARED:
            unseen = f"{rule.channel}: nothing is seen of it now"
            message = f"{message if seen or now.frozen else unseen} (it comes and goes)"
        if code != CLEARED:
            message = with_affected(message + _DOUBTED * self._doubted, self._affected)
        return self._event(state, time_ns + late_ns, vehicle_ns + late_ns, message, relative, sd, instead)

    def affect(self, channel: str, time_ns: int, vehicle_ns: int) -> AlarmEvent | None:
        """List another channel as affected by this alarm's cause; return the event, or None if it is listed already."""
        last = self._last
        if not self.state.active or last is None or channel in self._affected:
            return None
        self._affected.append(channel)
        return self._say(last, with_affected(last.message, self._affected), time_ns, vehicle_ns)

    def doubt(self, doubted: bool, time_ns: int, vehicle_ns: int) -> AlarmEvent | None:
        """Follow whether a second sender's telemetry may look like the fault; return the event that says so."""
        begins, self._doubted, last = doubted and not self._doubted, doubted, self._last
        if not begins or not self.state.active or last is None:
            return None
        own = with_affected(last.message, []) + _DOUBTED
        return self._say(last, with_affected(own, self._affected), time_ns, vehicle_ns)

    def _say(self, last: AlarmEvent, message: str, time_ns: int, vehicle_ns: int) -> AlarmEvent:
        """Return the event of an active alarm that changes the message of its last one alone."""
        vehicle_ms = vehicle_ns // 1_000_000
        self._last = replace(last, state="updated", message=message, time_ns=time_ns, vehicle_time_ms=vehicle_ms)
        return self._last

    def is_old(self, now_ns: int) -> bool:
        """Return whether it was raised too long ago to be explained by an alarm that is raised from now on."""
        return now_ns - self.since_ns > LATELY_NS

    def close(self, time_ns: int, vehicle_ns: int, why: str) -> AlarmEvent:
        """End an active alarm regardless of its evidence, and forget that evidence; return the event."""
        event = self._event("cleared", time_ns, vehicle_ns, why, None, None)
        self.state.deactivate()
        return event

    def withdraw(self, time_ns: int, vehicle_ns: int, why: str, since_ns: int | None = None) -> AlarmEvent | None:
        """End an alarm that an alarm raised soon after it explains, or since a time; return the event, if any."""
        lately_ns = LATELY_NS if since_ns is None else time_ns - since_ns
        if not self.state.active or not 0 <= time_ns - self.since_ns <= lately_ns:
            return None
        return self.close(time_ns, vehicle_ns, why)

    def _event(
        self,
        state: State,
        time_ns: int,
        vehicle_ns: int,
        message: str,
        relative: float | None,
        sd: float | None,
        instead: str | None = None,
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
            instead=instead,
        )
        return self._last
