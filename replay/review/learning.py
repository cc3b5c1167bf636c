"""Watches a log with a profile learned from the begin of the same flight, by the pipeline of all other logs."""

import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import replace
from math import inf
from pathlib import Path

import numpy as np

from adapters.batch import Batch
from adapters.errors import FauioError
from adapters.logs.recordings import Recording
from monitor.event import AlarmEvent
from monitor.fitting.flights import part_of
from monitor.profile import read_profile
from monitor.trace import AlarmSpan, Trace, alarm_spans
from monitor.vehicles.kinds import KINDS, fit_reading
from monitor.views.panels import RunView, in_display_units
from replay.fit import fit_profile
from replay.player import Replay, interests, play_batches
from replay.review.facts.log_facts import Floats, LearnedAlarm, LearnedWatch, LogFacts, LogSignal, inside

_KINDS = tuple(kind.name for kind in KINDS if kind.type_words)
_LEARNED_S = 40.0
"""Flight to learn from, seconds: motors are identified from 25 s of samples on, and an observer settles within 10.
Measured on flights whose fault begins after 50 s: learning from 40 % of the flight included the fault and missed it
in three of three, learning from 40 s in none of fifteen."""
_LEAST_HZ = 9.0
"""Lowest rate of the attitude: logs of both autopilots have 10 Hz and more. Measured on telemetry radios: at 4 Hz a
gyro was named in two of seven healthy flights; at 15 Hz in none of three."""
_LEAST_FLIGHT_S = 50.0
"""Shortest flight that is learned from, seconds. Chosen: ten more to watch, twice as long as an alarm has to last."""

_VELOCITIES = ("motion_", "gps_velocity_")
_FASTEST_M_S = 70.0
"""Largest possible error of a velocity: twice the 35 m/s to which ArduPilot limits a copter (LOIT_SPEED), for one that
flies one way while its GPS reports the other. Measured on a flight of aerobatics with a correct GPS: 101 and 127."""


def learned(path: Path, facts: LogFacts) -> LogFacts:
    """Return facts with the alarms of the learned profile over the whole log, or the reason why there are none."""
    start, end = max(facts.flight, key=lambda span: span[1] - span[0], default=(0.0, 0.0))
    if facts.vehicle not in _KINDS:
        kind = facts.vehicle or "one that the log does not name"
        return _unlearned(facts, f"of kinds of vehicle {', '.join(_KINDS)} are learned from a flight, not {kind}")
    if end - start < _LEAST_FLIGHT_S:
        return _unlearned(
            facts, f"{end - start:.0f} s of flight are too few to learn from; it takes {_LEAST_FLIGHT_S:g} s"
        )
    if (often := facts.signal("attitude").rate_hz) < _LEAST_HZ:
        return _unlearned(
            facts, f"the attitude comes {often:.2g} times a second; it takes {_LEAST_HZ:g} to learn from one flight"
        )
    until_s = start + _LEARNED_S
    wanted, types = fit_reading(None)

    def begin() -> Iterable[Batch]:
        return part_of(Recording(path, wanted, None, types).batches(), 0.0, until_s, str(path))

    with tempfile.TemporaryDirectory(prefix="fauio-review-") as folder:
        try:
            names = [path.name]
            fit_profile(facts.vehicle, [begin], Path(folder), "review", log_names=names, force=True, capability=False)
            profile = read_profile(Path(folder))
            replay = play_batches(profile, Recording(path, interests(profile)).batches(), keep_traces=True, force=True)
        except FauioError as error:
            why = " ".join(str(error).replace(str(path), path.name).split())
            return _unlearned(facts, f"nothing could be learned from the first {_LEARNED_S:g} s of flight: {why}")
    if not any(watch.watched_s for watch in replay.watches.values()):
        return _unlearned(facts, "what was learned watched nothing of the flight")
    alarms = tuple(_alarms(replay, facts, until_s))
    drawn = {
        f"estimate_{alarm.channel}": estimate
        for alarm in alarms
        if (estimate := _estimate(replay.traces, alarm, facts))
    }
    watch = LearnedWatch(until_s, alarms)
    return replace(facts, signals={**facts.signals, **drawn}, watch=watch)


def _unlearned(facts: LogFacts, why: str) -> LogFacts:
    return replace(facts, lacks={**facts.lacks, "watch": why})


def _alarms(replay: Replay, facts: LogFacts, until_s: float) -> Iterator[LearnedAlarm]:
    traces = {trace.layout.observer: trace for trace in replay.traces}
    for span in alarm_spans(replay.events):
        start_s = (span.start_ns - facts.start_ns) / 1e9
        end_s = facts.duration_s if span.end_ns is None else (span.end_ns - facts.start_ns) / 1e9
        onset_s = inf
        if (trace := traces.get(span.observer)) is not None:
            seen = (trace.unix_ns[trace.armed] - facts.start_ns) / 1e9
            onset_s = _onset_s(trace, seen, span.channel, start_s)
            # an alarm stays active without evidence (a plane too slow for its surfaces), but does not count as lasting
            # then
            end_s = float(np.max(seen[inside(seen, [(start_s, end_s)])], initial=start_s))
        typical = _typical(span, facts.start_ns + round(1e9 * end_s))
        peak = max((abs(event.peak) for event in span.history if event.peak is not None), default=0.0)
        threshold = span.history[0].threshold
        if start_s <= until_s or not threshold or typical.estimate is None:
            continue
        yield LearnedAlarm(
            start_s=start_s,
            end_s=end_s,
            observer=span.observer,
            channel=span.channel,
            share=peak / threshold,
            text=typical.message,
            size=abs(typical.estimate or 0.0),
            # an alarm of a motor gives a share of its command if that is possible; gyros count as inputs, too
            possible=abs(typical.estimate) < _FASTEST_M_S
            if span.channel.startswith(_VELOCITIES)
            else typical.relative is not None or not span.channel.startswith("motor"),
            onset_s=onset_s,
        )


_BEFORE_S = 10.0
"""Time before an alarm that may be a part of its cause, seconds: of known faults the slowest shows after 3 s."""


def _onset_s(trace: Trace, seen_s: Floats, channel: str, start_s: float) -> float:
    """Return when an alarm's estimate left its usual range for the last time before the alarm; infinite if unknown.

    An alarm is raised later, once noise alone does not explain the estimate.
    """
    before = seen_s < start_s - _BEFORE_S
    if channel not in trace.layout.faults or not before.any():
        return inf
    sizes = np.abs(trace.isolated[trace.armed, trace.layout.faults.index(channel)])
    usual_s = seen_s[(sizes <= sizes[before].max()) & (seen_s < start_s)][-1]
    return float(np.min(seen_s[seen_s > usual_s], initial=inf))


def _typical(span: AlarmSpan, end_ns: int) -> AlarmEvent:
    """Return an alarm's event with the middle one of its estimates over time: one counts until the next."""
    said = [event for event in span.history if event.state in ("raised", "updated")] or list(span.history)
    lasted = np.diff([*(event.time_ns for event in said), max(end_ns, said[-1].time_ns + 1)])
    order = sorted(range(len(said)), key=lambda k: abs(said[k].estimate or 0.0))
    until = np.cumsum(lasted[order])
    return said[order[int(np.searchsorted(until, until[-1] / 2))]]


def _estimate(traces: Iterable[Trace], alarm: LearnedAlarm, facts: LogFacts) -> LogSignal | None:
    for trace in in_display_units(RunView(tuple(traces), (), {})).traces:
        if trace.layout.observer == alarm.observer and alarm.channel in trace.layout.faults:
            times = (trace.unix_ns - facts.start_ns) / 1e9
            index = trace.layout.faults.index(alarm.channel)
            values = np.where(trace.armed[:, None], trace.isolated[:, [index]], np.nan)
            unit = trace.layout.fault_units[index]
            return LogSignal(times, values, (alarm.channel,), unit, f"learned observer {alarm.observer}")
    return None
