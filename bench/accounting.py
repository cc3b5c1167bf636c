"""Accounting of alarms against injected faults: delay, name, error, clearing, false alarms. Knows no detector."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from math import inf

import numpy as np
from flights import Announcement, Fault, Flight
from numpy.typing import NDArray

from monitor.event import AlarmEvent

AFTERMATH_S = 5.0
"""An alarm raised this soon after a fault's end belongs to the fault: its end is a jump as well."""

ONSET_MS = 20
"""The onset is known so well: an alarm that is sooner by less belongs to the fault."""

SETTLING_S = 1.0
FIRST_S = 10.0


@dataclass(frozen=True, slots=True)
class Spell:
    """An alarm from raised to cleared; None: it stood to the end."""

    channel: str
    raised_ms: int
    cleared_ms: int | None


@dataclass(frozen=True, slots=True)
class Verdict:
    """What a detector made of a fault.

    Parameters
    ----------
    delay_s : float | None
        From onset to the first alarm that names it (to the first alarm where any will do); None: missed.
    first_s : float | None
        From onset to the first alarm whatever it names.
    named : tuple[str, ...]
        Channels raised during the fault and its aftermath, in order.
    others : tuple[str, ...]
        Those among them that do not name it.
    isolated : bool | None
        Whether the right channels were named and no other; None where that cannot be said.
    cleared_s : float | None
        From the fault's end until no alarm of its time stood, negative where they were over before, infinite where
        one never cleared; None without alarm.
    """

    delay_s: float | None
    first_s: float | None
    named: tuple[str, ...]
    others: tuple[str, ...]
    isolated: bool | None
    cleared_s: float | None


@dataclass(frozen=True, slots=True)
class Reading:
    """Mean estimate and mean truth over a time, and the root mean square error."""

    estimate: float
    truth: float
    rmse: float


@dataclass(frozen=True, slots=True)
class Found:
    """What one detector made of one flight.

    Parameters
    ----------
    verdicts : tuple[Verdict, ...]
        One for each fault.
    first, whole : tuple[Reading | None, ...]
        How well each fault was estimated, in the first seconds after its alarm and over all its time.
    false : tuple[Spell, ...]
        False alarms.
    rarer : tuple[Found, ...]
        The same with so many times its sizes, by rising factor.
    """

    verdicts: tuple[Verdict, ...]
    first: tuple[Reading | None, ...]
    whole: tuple[Reading | None, ...]
    false: tuple[Spell, ...]
    rarer: tuple[Found, ...] = ()


@dataclass(frozen=True, slots=True)
class Result:
    """What all detectors made of one flight.

    Parameters
    ----------
    flight : Flight
        The flight.
    fitted_on : tuple[str, ...]
        Flights their fit has seen.
    channels : frozenset[str]
        Alarm channels of the profile.
    watched_s : float
        Evidence outside faults, seconds.
    found : dict[str, Found]
        By detector, the autopilot among them.
    limits_s : tuple[float | None, ...]
        The information limit of each fault's delay, where a model says it.
    """

    flight: Flight
    fitted_on: tuple[str, ...]
    channels: frozenset[str]
    watched_s: float
    found: dict[str, Found]
    limits_s: tuple[float | None, ...]


def spells(events: Iterable[AlarmEvent]) -> list[Spell]:
    """Return the alarms of a run; silence of telemetry and what is said to be no fault are left out."""
    found: dict[str, Spell] = {}
    for event in events:
        if event.kind == "stale" or event.channel.startswith("disturbance"):
            continue
        if event.state == "raised":
            found[event.id] = Spell(event.channel, event.vehicle_time_ms, None)
        elif event.state == "cleared" and event.id in found:
            raised = found[event.id]
            found[event.id] = Spell(raised.channel, raised.raised_ms, event.vehicle_time_ms)
    return sorted(found.values(), key=lambda spell: spell.raised_ms)


def announced(said: Sequence[Announcement]) -> list[Spell]:
    """Return what the autopilot said as alarms that are over at once."""
    return [Spell(one.text, one.time_ms, one.time_ms) for one in said]


def verdict(fault: Fault, flight: Flight, found: Sequence[Spell], *, names: bool = True) -> Verdict:
    """Return what alarms say about a fault of a flight.

    Parameters
    ----------
    fault, flight : Fault, Flight
        The fault and its flight, whose other faults excuse other alarms.
    found : Sequence[Spell]
        Alarms in order of time.
    names : bool
        Whether the detector names channels at all; if not, any alarm will do.
    """
    end = fault.off_ms + AFTERMATH_S * 1000
    during = [spell for spell in found if fault.on_ms - ONSET_MS <= spell.raised_ms <= end]
    while_on = [spell for spell in during if spell.raised_ms <= fault.off_ms]
    known = names and bool(fault.channels)
    right = [spell for spell in while_on if not known or spell.channel in fault.channels]
    together = [
        other for other in flight.faults if other.on_ms <= end and other.off_ms + AFTERMATH_S * 1e3 >= fault.on_ms
    ]
    excused = frozenset[str]().union(*(other.channels for other in together))
    others = [spell.channel for spell in during if known and spell.channel not in excused]
    ends = [inf if spell.cleared_ms is None else spell.cleared_ms for spell in during]
    return Verdict(
        delay_s=(right[0].raised_ms - fault.on_ms) / 1000 if right else None,
        first_s=(while_on[0].raised_ms - fault.on_ms) / 1000 if while_on else None,
        named=tuple(dict.fromkeys(spell.channel for spell in during)),
        others=tuple(dict.fromkeys(others)),
        isolated=bool(right) and not others if known else None,
        cleared_s=(max(ends) - fault.off_ms) / 1000 if during else None,
    )


def false_alarms(flight: Flight, found: Iterable[Spell]) -> list[Spell]:
    """Return the alarms raised outside all faults of a flight and their aftermath."""
    return [spell for spell in found if not _in_a_fault(flight, np.array([spell.raised_ms]))[0]]


def before_any_fault(flight: Flight, found: Iterable[Spell]) -> list[Spell]:
    """Return the alarms raised before the first fault: of an autopilot, whose text says not when trouble is over."""
    onset = min((fault.on_ms for fault in flight.faults), default=None)
    return [spell for spell in found if onset is None or spell.raised_ms < onset]


def watched_s(flight: Flight, time_ms: NDArray[np.int64], armed: NDArray[np.bool_], rate_hz: float) -> float:
    """Return how long samples (N,) counted as evidence outside the flight's faults, seconds."""
    return float(np.sum(armed & ~_in_a_fault(flight, time_ms))) / rate_hz


def reading(
    fault: Fault,
    time_ms: NDArray[np.int64],
    estimate: NDArray[np.float64],
    counts: NDArray[np.bool_],
    alarm: Spell | None = None,
) -> Reading | None:
    """Compare estimates (N,) with a fault's truth; None where there is none, or no sample that counts.

    Over the whole fault from ``SETTLING_S`` after its onset; with an alarm, over ``FIRST_S`` from that long after it,
    as long as it stands.
    """
    start, end = fault.on_ms, fault.off_ms
    if alarm is not None:
        stands = end if alarm.cleared_ms is None else alarm.cleared_ms
        start, end = alarm.raised_ms, min(end, stands, alarm.raised_ms + round(FIRST_S * 1000))
    during = counts & (time_ms > start + SETTLING_S * 1000) & (time_ms < end) & np.isfinite(estimate)
    if fault.truth is None or not during.any():
        return None
    truth = fault.truth.after((time_ms[during] - fault.on_ms) / 1000.0)
    error = estimate[during] - truth
    return Reading(float(estimate[during].mean()), float(truth.mean()), float(np.sqrt(np.mean(error**2))))


def at_equal_rate(results: Sequence[Result], reference: str) -> list[Result]:
    """Return results of detectors with sizes so large that they have no more false alarms than the reference.

    Of all flights of a group that their fit has not seen; of a detector that never gets there those of its largest.
    """
    chosen: dict[tuple[str, str], int] = {}
    for group in {result.flight.group for result in results}:
        unseen = [r for r in results if r.flight.group == group and r.flight.name not in r.fitted_on]
        granted = sum(len(result.found[reference].false) for result in unseen)
        for name in {name for result in unseen for name in result.found}:
            counts = [
                sum(len((result.found[name], *result.found[name].rarer)[at].false) for result in unseen)
                for at in range(1 + min(len(result.found[name].rarer) for result in unseen))
            ]
            chosen[group, name] = next((at for at, count in enumerate(counts) if count <= granted), len(counts) - 1)
    return [
        replace(
            result,
            found={
                name: (found, *found.rarer)[chosen.get((result.flight.group, name), 0)]
                for name, found in result.found.items()
            },
        )
        for result in results
    ]


def _in_a_fault(flight: Flight, time_ms: NDArray[np.int64]) -> NDArray[np.bool_]:
    inside = np.zeros(len(time_ms), dtype=np.bool_)
    for fault in flight.faults:
        inside |= (time_ms >= fault.on_ms - ONSET_MS) & (time_ms <= fault.off_ms + AFTERMATH_S * 1000)
    return inside
