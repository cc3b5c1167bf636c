"""What a run says about each channel: its alarms with size and certainty, and how quiet it was without."""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adapters.toml_tables import is_number
from monitor.estimation.effectiveness import EffectivenessRule
from monitor.event import AlarmEvent, Kind, Severity
from monitor.profile import PROFILE_FILE, Profile
from monitor.trace import Trace

FIT_FILE = "fit.json"
_SAME_SIZE = 1e-3
"""Relative: thresholds are written with four digits."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One alarm from its raising to its end."""

    # as of :class:`monitor.event.AlarmEvent`; the severity is the worst it had
    observer: str
    channel: str
    kind: Kind
    unit: str
    severity: Severity
    sentence: str  # what it said when it was largest
    # when it was raised: Unix time, vehicle's clock
    start_ns: int
    start_vehicle_ms: int
    # when it cleared, None where it stood at the end
    end_ns: int | None
    end_vehicle_ms: int | None
    # largest estimate, and what it had to exceed
    peak: float | None
    threshold: float
    relative: float | None  # estimate over command when it was largest
    # median estimate while it stood, and one standard deviation of the estimate then; None where not known
    typical: float | None
    deviation: float | None
    # the observer's channel that was held responsible for most beside it meanwhile, in shares of its own threshold
    rival: tuple[str, float] | None
    # when it is believed, where that is not for its threshold but for the certainty of a lost effect
    effect: EffectivenessRule | None


@dataclass(frozen=True, slots=True)
class Calibration:
    """What a threshold rests on."""

    # size that healthy evidence exceeds at the granted rate of false alarms, with its confidence limits; None where
    # healthy evidence is zero by what was calibrated before it
    level: float | None
    low: float | None
    high: float | None
    hours: float | None  # hours of healthy evidence it comes from


@dataclass(frozen=True, slots=True)
class WatchedChannel:
    """One channel with an alarm, over a run."""

    # as of :class:`monitor.alarms.alarm.AlarmRule`
    observer: str
    channel: str
    kind: Kind
    unit: str
    threshold: float
    sees: str  # what size of fault it sees how fast, as the profile says; empty where it does not
    calibration: Calibration | None  # none where the threshold was never calibrated, or changed since
    watched_s: float  # how long alarms could be raised
    peak: float | None  # largest evidence meanwhile by size; None where there is none, or it is not recorded
    alarms: int  # how many alarms it raised
    effect: EffectivenessRule | None  # as of :class:`Finding`

    @property
    def share(self) -> float | None:
        """Peak over threshold, None where that says nothing."""
        known = self.peak is not None and self.threshold and self.effect is None
        return abs(self.peak or 0.0) / self.threshold if known else None


def effects(profile: Profile) -> dict[tuple[str, str], EffectivenessRule]:
    """Return the channels, by observer and name, that answer for the effect of an actuator.

    What is shown of them is not the estimate of their fault, whose standard deviation therefore is not theirs.
    """
    return {
        (observer.name, name): rule for observer in profile.observers for name, rule in observer.effectiveness.items()
    }


def findings(profile: Profile, events: Iterable[AlarmEvent], traces: Sequence[Trace]) -> list[Finding]:
    """Return each alarm of a run, in the order of their beginnings."""
    thresholds = {(rule.observer, rule.channel): rule.threshold for one in profile.observers for rule in one.alarms}
    by_effect = effects(profile)
    histories: dict[str, list[AlarmEvent]] = {}
    for event in events:
        histories.setdefault(event.id, []).append(event)
    by_name = {trace.layout.observer: trace for trace in traces}
    found = [
        _finding(
            history,
            by_name.get(history[0].observer),
            thresholds,
            by_effect.get((history[0].observer, history[0].channel)),
        )
        for history in histories.values()
    ]
    return sorted(found, key=lambda finding: finding.start_ns)


def watched_channels(
    profile: Profile, folder: Path, traces: Sequence[Trace], watched_s: Mapping[str, float], found: Sequence[Finding]
) -> list[WatchedChannel]:
    """Return every channel of the profile that has an alarm.

    What its thresholds rest on is read from the profile's folder; ``watched_s`` says how long each observer watched.
    """
    said, rests_on, by_effect = _said(profile), _calibrations(folder), effects(profile)
    by_name = {trace.layout.observer: trace for trace in traces}
    return [
        WatchedChannel(
            observer=rule.observer,
            channel=rule.channel,
            kind=rule.kind,
            unit=rule.unit,
            threshold=rule.threshold,
            sees=said.get((rule.observer, rule.channel), ""),
            calibration=_calibration(rests_on.get((rule.observer, rule.channel)), rule.threshold),
            watched_s=watched_s.get(rule.observer, 0.0),
            peak=_peak(by_name.get(rule.observer), rule.channel),
            alarms=sum((one.observer, one.channel) == (rule.observer, rule.channel) for one in found),
            effect=by_effect.get((rule.observer, rule.channel)),
        )
        for observer in profile.observers
        for rule in observer.alarms
    ]


def _finding(
    history: Sequence[AlarmEvent],
    trace: Trace | None,
    thresholds: Mapping[tuple[str, str], float],
    effect: EffectivenessRule | None,
) -> Finding:
    first, last = history[0], history[-1]
    standing = [event for event in history if event.state != "cleared"] or [first]
    largest = max(standing, key=lambda event: abs(event.estimate or 0.0))
    cleared = last.state == "cleared"
    peaks = [event.peak for event in history if event.peak is not None]
    typical = deviation = rival = None
    if trace is not None and first.channel in trace.layout.faults:
        end_ms = last.vehicle_time_ms if cleared else math.inf
        inside = (trace.vehicle_ns >= first.vehicle_time_ms * 1e6) & (trace.vehicle_ns < end_ms * 1e6) & trace.armed
        place = trace.layout.faults.index(first.channel)
        typical = _median(trace.isolated[inside, place])
        deviation = _median(trace.sd[inside, place]) if effect is None else None
        rival = _rival(trace, inside, first.channel, thresholds)
    return Finding(
        observer=first.observer,
        channel=first.channel,
        kind=first.kind,
        unit=first.unit,
        severity="critical" if any(event.severity == "critical" for event in history) else "warning",
        sentence=largest.message,
        start_ns=first.time_ns,
        start_vehicle_ms=first.vehicle_time_ms,
        end_ns=last.time_ns if cleared else None,
        end_vehicle_ms=last.vehicle_time_ms if cleared else None,
        peak=max(peaks, key=abs, default=None),
        threshold=first.threshold,
        relative=largest.relative,
        typical=typical,
        deviation=deviation,
        rival=rival,
        effect=effect,
    )


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


def _said(profile: Profile) -> dict[tuple[str, str], str]:
    """Return what the profile says in words each alarm sees."""
    root = tomllib.loads(profile.files[PROFILE_FILE].decode()) if PROFILE_FILE in profile.files else {}
    return {
        (observer, channel): str(rule.get("sees", ""))
        for observer, table in root.get("observers", {}).items()
        for channel, rule in table.get("alarms", {}).items()
    }


def _calibrations(folder: Path) -> dict[tuple[str, str], dict[str, Any]]:
    """Return what the fit of the profile says of its thresholds; nothing where there is no such file."""
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
