"""The page of ``bench/detection.py``: what is missed first, then tables by kind of fault, by flight, false alarms."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import inf, isfinite
from statistics import median

from accounting import AFTERMATH_S, FIRST_S, SETTLING_S, Found, Reading, Result, Verdict, at_equal_rate
from detectors import FACTORS, FAUIO, GLR_ROWS, WINDOW_S
from flights import Fault
from limit import tilt_limit

from monitor.fitting.thresholds import FALSE_ALARMS_PER_HOUR

CLEARS_WITHIN_S = 5.0


def page(results: Sequence[Result], detectors: Sequence[str], notes: Sequence[str]) -> str:
    """Return the page.

    Parameters
    ----------
    results : Sequence[Result]
        All flights by the profile of their group, and healthy ones again by a profile that has not seen them.
    detectors : Sequence[str]
        Names of the detectors, in the order of the columns.
    notes : Sequence[str]
        What could not be done.
    """
    as_fitted, results = results, at_equal_rate(results, FAUIO)
    tried = [result for result in results if not _left_out(result)]
    lines = [
        INTRODUCTION,
        *[f"- {line}" for line in (*_shortcomings(results, detectors), *notes)],
        "",
        "## By kind of fault",
        "",
        BY_KIND,
        "",
        *_by_kind(tried, detectors),
        "",
        "![Delay against size](images/detection.png)",
        "",
        "## Fault by fault",
        "",
        BY_FLIGHT,
        "",
        *_by_flight(tried, detectors),
        "",
        "## Estimates and clearing",
        "",
        ESTIMATES,
        "",
        *_estimates(tried, [name for name in detectors if any(_has_readings(r.found[name]) for r in tried)]),
        "",
        "## False alarms",
        "",
        FALSE,
        "",
        *_false(as_fitted, detectors),
        "",
    ]
    return "\n".join(lines)


def _left_out(result: Result) -> bool:
    return result.flight.healthy and result.flight.name not in result.fitted_on


def _faults(results: Iterable[Result]) -> list[tuple[Result, int, Fault]]:
    return [(result, k, fault) for result in results for k, fault in enumerate(result.flight.faults)]


def _shortcomings(results: Sequence[Result], detectors: Sequence[str]) -> list[str]:
    """Return what fauio misses, names wrongly, is beaten at, or invents."""
    said = []
    sooner: dict[str, list[str]] = {}
    for result, k, fault in _faults(results):
        who, ours = f"{result.flight.name} ({fault.kind} {fault.text})", result.found[FAUIO].verdicts[k]
        if ours.delay_s is None:
            watched = "" if fault.channels & result.channels or not fault.channels else ": no observer watches for it"
            said.append(f"missed: {who}{watched}{', but alarms of ' + ', '.join(ours.named) if ours.named else ''}")
        elif ours.others:
            said.append(f"not alone: {who}, also {', '.join(ours.others)}")
        if ours.cleared_s is not None and ours.cleared_s > CLEARS_WITHIN_S:
            when = f"{ours.cleared_s:.1f} s after the end" if isfinite(ours.cleared_s) else "never"
            said.append(f"cleared late: {who}, {when}")
        for name in detectors:
            other = result.found[name].verdicts[k].delay_s
            if name != FAUIO and other is not None and other < (inf if ours.delay_s is None else ours.delay_s):
                sooner.setdefault(name, []).append(f"{result.flight.name} {_lead(other, ours.delay_s)}")
    said += [f"{name} is sooner: {'; '.join(flights)}" for name, flights in sooner.items()]
    for result in results:
        said += [
            f"false alarm: {spell.channel} in {result.flight.name} at {spell.raised_ms / 1000:.1f} s"
            f"{' (left out of the fit)' if _left_out(result) else ''}"
            for spell in result.found[FAUIO].false
        ]
    return said or ["nothing on these flights"]


def _lead(other_s: float, ours_s: float | None) -> str:
    return f"in {other_s:.2f} s, fauio not at all" if ours_s is None else f"by {ours_s - other_s:.2f} s"


def _by_kind(results: Sequence[Result], detectors: Sequence[str]) -> list[str]:
    kinds = sorted({(result.flight.group, fault.kind) for result, _, fault in _faults(results)})
    lines = [_row("vehicle", "kind of fault", *detectors), _rule(2 + len(detectors))]
    for group, kind in kinds:
        cells = []
        for name in detectors:
            verdicts = [
                result.found[name].verdicts[k]
                for result, k, fault in _faults(results)
                if (result.flight.group, fault.kind) == (group, kind)
            ]
            cells.append(_summary(verdicts))
        lines.append(_row(group, kind, *cells))
    return lines


def _summary(verdicts: Sequence[Verdict]) -> str:
    delays = [one.delay_s for one in verdicts if one.delay_s is not None]
    named = [one.isolated for one in verdicts if one.isolated is not None]
    parts = [f"{len(delays)} of {len(verdicts)}"]
    if delays:
        worst = f", worst {max(delays):.2f} s" if len(delays) > 1 else ""
        parts.append(f"{median(delays):.2f} s{worst}")
    if named:
        parts.append(f"named {sum(named)} of {len(named)}")
    return "; ".join(parts)


def _by_flight(results: Sequence[Result], detectors: Sequence[str]) -> list[str]:
    lines = [_row("flight", "fault", "should be named", "limit", *detectors), _rule(4 + len(detectors))]
    for result, k, fault in _faults(results):
        cells = [_cell(result.found[name].verdicts[k]) for name in detectors]
        expected = " or ".join(sorted(fault.channels)) or "not known"
        limit = "" if (at := result.limits_s[k]) is None else f"{at:.2f} s"
        if fault.truth and fault.truth.channel in ("gyro_x", "gyro_y"):
            tilted = tilt_limit(fault.truth.size)
            limit += "; tilt " + (f"{tilted:.1f} s" if tilted else "over 5 s")
        lines.append(_row(result.flight.name, f"{fault.kind} {fault.text}", expected, limit, *cells))
    return lines


def _cell(found: Verdict) -> str:
    if found.delay_s is None:
        wrong = ", ".join(found.named)
        return f"MISSED, but after {found.first_s:.2f} s {wrong}" if found.first_s is not None else "MISSED"
    only = "" if not found.others else f", also {', '.join(found.others)}"
    named = f" {found.named[0]}" if found.isolated is None and found.named[0] != "energy" else ""
    return f"{found.delay_s:.2f} s{named}{only}"


def _has_readings(found: Found) -> bool:
    return any(one is not None for one in found.whole)


def _estimates(results: Sequence[Result], detectors: Sequence[str]) -> list[str]:
    heads = [f"{name}, {when}" for name in detectors for when in (f"first {FIRST_S:g} s", "whole fault")]
    lines = [_row("flight", "fault", *heads, "fauio cleared after"), _rule(3 + len(heads))]
    for result, k, fault in _faults(results):
        readings = [when[k] for name in detectors for when in (result.found[name].first, result.found[name].whole)]
        cells = [_reading(one, fault) for one in readings]
        cleared = _clearing(result.found[FAUIO].verdicts[k].cleared_s)
        lines.append(_row(result.flight.name, fault.kind, *cells, cleared))
    return lines


def _reading(found: Reading | None, fault: Fault) -> str:
    if found is None or fault.truth is None:
        return ""
    unit = fault.truth.unit
    return f"{_size(found.estimate, unit)} of {_size(found.truth, unit)}; {_size(found.rmse, unit)}"


def _size(value: float, unit: str) -> str:
    return f"{100 * value:.1f} %" if unit == "share" else f"{value:.3g} {unit}"


def _clearing(cleared_s: float | None) -> str:
    if cleared_s is None:
        return ""
    if cleared_s < 0.0:
        return f"{-cleared_s:.1f} s before the end"
    return f"{cleared_s:.1f} s" if isfinite(cleared_s) else "never"


def _false(results: Sequence[Result], detectors: Sequence[str]) -> list[str]:
    lines = [_row("flight", "fitted on", "watched", *detectors), _rule(3 + len(detectors))]
    for result in results:
        seen = "it, too" if result.flight.name in result.fitted_on else "others"
        role = seen if not _left_out(result) else f"others (left out): {', '.join(result.fitted_on)}"
        cells = [_channels(result.found[name]) for name in detectors]
        lines.append(_row(result.flight.name, role, f"{result.watched_s / 60:.1f} min", *cells))
    for title, which in (
        ("**not in the fit**", [result for result in results if result.flight.name not in result.fitted_on]),
        ("**in the fit**", [result for result in results if result.flight.name in result.fitted_on]),
    ):
        hours = sum(result.watched_s for result in which) / 3600.0
        counts = [sum(len(result.found[name].false) for result in which) for name in detectors]
        cells = [f"**{count}, {count / hours:.1f} per hour**" if hours else "" for count in counts]
        lines.append(_row(title, "", f"**{60 * hours:.1f} min**", *cells))
    return lines


def _channels(found: Found) -> str:
    names = ", ".join(dict.fromkeys(spell.channel for spell in found.false))
    return f"{len(found.false)}: {names}" if found.false else "0"


def _row(*cells: str) -> str:
    return f"| {' | '.join(cells)} |"


def _rule(columns: int) -> str:
    return "|" + "---|" * columns


INTRODUCTION = f"""# Detection on recorded flights

This page shows which faults fauio detects on recorded flights, how fast, and how other detectors do at the same rate
of false alarms. The flights come from autopilots in their simulators, with injected faults whose onset is known to 20
ms.

    python bench/detection.py FLIGHTS... --write

makes this page. Profiles are fitted on the healthy flights of the same folder, vehicle, frame and noise level, never
on a flight with a fault or a disturbance. Each profile has one to four flights, so the rates of false alarms rest on
minutes.

The other detectors use the same models, samples and gate. They are calibrated on the same healthy flights for the
same number of false alarms ({FALSE_ALARMS_PER_HOUR:g} per hour and observer, extreme-value fit), with the same
debounce unless stated otherwise:

- **autopilot**: its own announcements (severity warning or worse) during the fault;
- **Kalman filter**: states augmented by random-walk faults, one filter for as many faults as can be estimated
  together, each channel judged by itself;
- **Kalman bank**: such a filter for each hypothesis of the profile, chosen as the profile chooses;
- **GLR bank**: the one-step prediction residual of the model without faults, whitened by its healthy covariance and
  compared with each fault's response to a step over windows of 1 to {GLR_ROWS} samples; no debounce;
- **CUSUM bank**: the same residual along the mean direction of each fault; no debounce;
- **residual energy**: mean square of that residual over {WINDOW_S:g} s, as control invariants do; it cannot name a
  channel.

If the Kalman bank does as well as fauio, the hypotheses decide and not the gains. The other detectors have no
smallest size worth an alarm; the profile has one.

**The same rate of false alarms.** If a detector raised more false alarms than fauio on flights that its fit had not
seen, its sizes are doubled until it does not, up to {FACTORS[-1]:g} times. It may use those flights for that; fauio
may not. The last table has the false alarms before that step. An alarm's time is when its sample is known: a sample
on the line between two GPS fixes waits for the second fix.

**Left out.** Faults that the profile watches only for jumps are no states of the Kalman filters, since a sensor bias
that may walk explains everything. The filters' fault rates are those of the models; a filter tuned by hand could do
better.

## What is wrong

Faults that fauio misses, names together with another channel or sees later than another detector; alarms that clear
later than {CLEARS_WITHIN_S:g} s after the end; false alarms; and what could not be measured.
"""

BY_KIND = """Faults seen, median and worst delay from the injection, and how often only the right channel was named.
If the kind of a fault is not known, any alarm counts."""

BY_FLIGHT = f"""Delay until the right channel's alarm; "also" are wrong channels up to {AFTERMATH_S:g} s after the
fault's end. "limit" is the time after which the fault, with size and onset known, has as many nats as
{FALSE_ALARMS_PER_HOUR:g} false alarms an hour need by the fitted model of calm flight. No detector on these samples
is sooner, and none knows size and onset. Of a gyro it counts the jump in the first sample, which a push on the vehicle
makes as well, and which the controller has removed 30 ms later. Where the attitude on board follows the gyro, only the
tilt tells the two apart: "tilt" is the same limit by the GPS's velocity (5 fixes a second, 0.05 m/s of noise) in hover,
without what the magnetic field may add. An actuator at rest shows nothing: delays of steering and surfaces count
from the injection, not from the first turn."""

ESTIMATES = f"""Mean estimate of mean truth, and root mean square error. "First" is from {SETTLING_S:g} s after the
alarm that names the fault to {FIRST_S:g} s after it, while it is active; "whole fault" is from {SETTLING_S:g} s after
the onset to the end, with or without an alarm. A loss is a share of the command. "Cleared" is the time from the
fault's end to the end of its last alarm. (An autopilot that changes over to a healthy sensor ends a fault early.)"""

FALSE = f"""Alarms outside faults, as fitted. Alarms up to {AFTERMATH_S:g} s after a fault do not count, since the end
of a fault is a jump too; a step of wind is no fault. Of the autopilot only announcements before the first fault
count. Flights "in the fit" made the thresholds, so zeros there mean little. Rows "left out" have profiles of the
other healthy flights only, which are worse than the shipped profile."""
