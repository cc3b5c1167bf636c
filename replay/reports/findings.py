"""Findings of a run for each channel: its alarms with size and certainty, and its largest evidence without alarms."""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adapters.toml_tables import is_number
from monitor.alarms.alarm import AlarmRule, alarm_message
from monitor.display import size_text
from monitor.estimation.effectiveness import EffectivenessRule
from monitor.event import AlarmEvent
from monitor.profile import Profile
from monitor.trace import AlarmSpan, Trace, alarm_spans

FIT_FILE = "fit.json"
_PARTS = 8
"""The final size of a fault is the median of the last one of so many parts. Chosen: an eighth is long enough for noise,
and short beside the fault's growth."""
_TRACE = 0.1
"""Share of the largest estimate from which one counts for the size. Chosen: smoothed estimates fall to it in 2.3 of
their time constants."""
_GROWTH = 1.2
"""Smallest ratio of the final size to the median for a fault that grew. Chosen: two standard deviations of estimates
are some per cent of the size that raises an alarm, a tenth at most."""
_SAME_SIZE = 1e-3
"""Largest relative difference of two equal thresholds: they are written with four digits."""
_NOTHING = 1e-3
"""Share of the threshold below which a size is shown as zero: sizes have three digits, and it is less than one of the
last digit."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One alarm of a run, with the estimates during it."""

    alarm: AlarmSpan
    largest: AlarmEvent  # its event with the largest estimate
    # median estimate while the alarm was active, or final size of a fault that grew, and its standard deviation; None
    # if unknown
    size: float | None
    deviation: float | None
    grew: bool  # whether the size is the final size of a fault that grew
    # the observer's other channel with the largest isolated estimate meanwhile, in shares of its own threshold
    rival: tuple[str, float] | None
    relative: float | None  # the size relative to the command, if that makes sense
    message: str  # sentence about the fault and its size
    # the rule of the alarm, if it judges the certainty of a lost effect instead of a threshold
    effect: EffectivenessRule | None


@dataclass(frozen=True, slots=True)
class Calibration:
    """The basis of a threshold."""

    # size that healthy evidence exceeds at the granted rate of false alarms, with its confidence limits; None if an
    # earlier calibration makes healthy evidence zero
    level: float | None
    low: float | None
    high: float | None
    hours: float | None  # hours of healthy evidence behind it


@dataclass(frozen=True, slots=True)
class WatchedChannel:
    """One channel with an alarm, over a run."""

    rule: AlarmRule
    calibration: Calibration | None  # None if the threshold was never calibrated, or has changed since
    watched_s: float  # time during which alarms could be raised
    peak: float | None  # largest evidence by magnitude during that time; None if there is none, or it is not recorded
    alarms: int  # number of alarms that it raised
    effect: EffectivenessRule | None  # as in :class:`Finding`
    usual_command: float | None  # for a motor: its loss is given as a share of this command

    def size_text(self, size: float) -> str:
        """Return a size of the channel for people; it is zero if it is negligible beside the threshold."""
        if abs(size) < _NOTHING * self.rule.threshold:
            size = 0.0
        return size_text(size, self.rule.unit, self.usual_command)


def effects(profile: Profile) -> dict[tuple[str, str], EffectivenessRule]:
    """Return the channels, by observer and name, whose alarms judge the lost effect of an actuator.

    Their alarms show the lost effect instead of the estimated fault, so that its standard deviation does not apply.
    """
    return {
        (observer.name, name): rule for observer in profile.observers for name, rule in observer.effectiveness.items()
    }


def findings(profile: Profile, events: Iterable[AlarmEvent], traces: Sequence[Trace]) -> list[Finding]:
    """Return each alarm of a run, in the order of their begins."""
    thresholds = {
        (rule.observer, rule.channel): rule.threshold for observer in profile.observers for rule in observer.alarms
    }
    by_effect, by_name = effects(profile), {trace.layout.observer: trace for trace in traces}
    return [
        _finding(span, by_name.get(span.observer), thresholds, by_effect.get((span.observer, span.channel)))
        for span in alarm_spans(events)
    ]


def watched_channels(
    profile: Profile, folder: Path, traces: Sequence[Trace], watched_s: Mapping[str, float], results: Sequence[Finding]
) -> list[WatchedChannel]:
    """Return every channel of the profile that has an alarm.

    The basis of the thresholds is read from the profile's folder; ``watched_s`` is the time that each observer watched.
    """
    rests_on, by_effect = _calibrations(folder), effects(profile)
    by_name = {trace.layout.observer: trace for trace in traces}
    return [
        WatchedChannel(
            rule=rule,
            calibration=_calibration(rests_on.get((rule.observer, rule.channel)), rule.threshold),
            watched_s=watched_s.get(rule.observer, 0.0),
            peak=_peak(by_name.get(rule.observer), rule.channel),
            alarms=sum(
                (result.alarm.observer, result.alarm.channel) == (rule.observer, rule.channel) for result in results
            ),
            effect=by_effect.get((rule.observer, rule.channel)),
            usual_command=observer.usual_commands.get(rule.channel),
        )
        for observer in profile.observers
        for rule in observer.alarms
    ]


def _finding(
    alarm: AlarmSpan,
    trace: Trace | None,
    thresholds: Mapping[tuple[str, str], float],
    effect: EffectivenessRule | None,
) -> Finding:
    active = [event for event in alarm.history if event.state != "cleared"] or [alarm.history[0]]
    largest = max(active, key=lambda event: abs(event.estimate or 0.0))
    if trace is None or alarm.channel not in trace.layout.faults:
        return Finding(alarm, largest, None, None, False, None, None, largest.message, effect)
    end_ns = math.inf if alarm.end_vehicle_ns is None else alarm.end_vehicle_ns
    inside = (trace.vehicle_ns >= alarm.start_vehicle_ns) & (trace.vehicle_ns < end_ns) & trace.armed
    index = trace.layout.faults.index(alarm.channel)
    size, grew = _size(trace.isolated[inside, index])
    deviation = _median(trace.sd[inside, index]) if effect is None else None
    relative, message = None, largest.message
    if size is not None:
        # When an alarm is raised, its size rests on a few samples; later events know it better.
        near = min(active[1:] or active, key=lambda event: abs((event.estimate or 0.0) - size))
        shares = [event.relative for event in active if event.relative is not None]
        if effect is not None:
            # the estimate follows the command, the lost effect does not
            grew = False
            relative = float(np.median(shares)) if shares else None
        elif near.relative is not None and near.estimate:
            relative = near.relative * size / near.estimate
        message = alarm_message(alarm.observer, alarm.channel, near.kind, near.unit, near.state, size, relative)
        message += next((f"; the cause is in {event.part}" for event in reversed(alarm.history) if event.part), "")
    rival = _rival(trace, inside, alarm.channel, thresholds)
    return Finding(alarm, largest, size, deviation, grew, rival, relative, message, effect)


def _size(values: NDArray[np.float64]) -> tuple[float | None, bool]:
    """Return the median of estimates, or their final size if they grew; and whether they grew.

    Where another channel or none was held responsible they fall to zero, and say nothing of the size.
    """
    values = values[np.isfinite(values)]
    values = values[np.abs(values) > _TRACE * np.abs(values).max(initial=0.0)]
    if not len(values):
        return None, False
    middle = float(np.median(values))
    last = float(np.median(values[-max(1, len(values) // _PARTS) :]))
    grew = abs(last) > _GROWTH * abs(middle)
    return (last if grew else middle), grew


def _rival(
    trace: Trace, inside: NDArray[np.bool_], channel: str, thresholds: Mapping[tuple[str, str], float]
) -> tuple[str, float] | None:
    shares = [
        (name, float(np.nanmax(np.abs(trace.isolated[inside, place]), initial=0.0)) / threshold)
        for place, name in enumerate(trace.layout.faults)
        if name != channel and (threshold := thresholds.get((trace.layout.observer, name)))
    ]
    return max(shares, key=lambda share: share[1], default=None)


def _median(values: NDArray[np.float64]) -> float | None:
    values = values[np.isfinite(values)]
    return float(np.median(values)) if len(values) else None


def _peak(trace: Trace | None, channel: str) -> float | None:
    if trace is None or channel not in trace.layout.faults:
        return None
    values = trace.isolated[trace.armed, trace.layout.faults.index(channel)]
    values = values[np.isfinite(values)]
    return float(values[np.argmax(np.abs(values))]) if len(values) else None


def _calibrations(folder: Path) -> dict[tuple[str, str], dict[str, Any]]:
    """Return the calibration of the thresholds from the profile's fit report; empty if there is no such file."""
    try:
        observers = json.loads((folder / FIT_FILE).read_text())["observers"]
        return {
            (observer, channel): dict(said)
            for observer, table in observers.items()
            for channel, said in table.get("alarms", {}).items()
        }
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}


def _calibration(said: Mapping[str, Any] | None, threshold: float) -> Calibration | None:
    if said is None or not math.isclose(_number(said.get("threshold")) or math.nan, threshold, rel_tol=_SAME_SIZE):
        return None
    level, low, high, hours = (_number(said.get(key)) for key in ("level", "level_low", "level_high", "healthy_hours"))
    return Calibration(level, low, high, hours)


def _number(value: Any) -> float | None:
    return float(value) if is_number(value) else None
