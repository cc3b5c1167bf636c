"""What is detected on a folder of recorded flights, how fast and how well, beside what else could have been used.

    python bench/detection.py FLIGHTS...            print the page
    python bench/detection.py FLIGHTS... --write    write docs/detection.md and docs/images/detection.png

FLIGHTS are folders with recordings and their truth (:mod:`flights`). Per folder, vehicle, frame and noise level a
profile is fitted on the healthy flights, never on one with a fault or a disturbance; where there are two healthy
flights or more, each is also left out once and only watched. Beside it: the autopilot's own announcements, Kalman
filters, GLR and CUSUM banks and windowed residual energy with the same models, calibrated on the same flights
(:mod:`detectors`).
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
import tempfile
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from accounting import (
    ONSET_MS,
    Found,
    Reading,
    Result,
    announced,
    before_any_fault,
    false_alarms,
    reading,
    spells,
    verdict,
    watched_s,
)
from detection_page import page
from detectors import DETECTORS, ENERGY, FAUIO, Run, Suite, make_suite, run_suite
from flights import Fault, Flight, read_flights
from limit import information_limit
from numpy.typing import NDArray

from adapters.logs.recordings import packed
from monitor.trace import Trace
from monitor.vehicles.kinds import KINDS, fit_messages
from replay.fit import fit_profile
from replay.player import interests

ROOT = Path(__file__).parent.parent
AUTOPILOT = "autopilot"
SMALLEST_COMMAND = 0.02


@dataclass(frozen=True, slots=True)
class Fit:
    """A fit to make, and the flights that it is tried on."""

    group: str
    healthy: tuple[Flight, ...]
    tried_on: tuple[Flight, ...]
    folder: Path


def fits_of(flights: Sequence[Flight], folder: Path) -> tuple[list[Fit], list[str]]:
    """Return the fits that a folder of flights needs, those that leave one healthy flight out among them, and notes."""
    fits: list[Fit] = []
    notes: list[str] = []
    for group in sorted({flight.group for flight in flights}):
        members = tuple(flight for flight in flights if flight.group == group)
        healthy = tuple(flight for flight in members if flight.healthy)
        if members[0].kind not in [kind.name for kind in KINDS]:
            notes.append(f"{group}: `fauio fit` knows no {members[0].kind} ({len(members)} flights left out)")
            continue
        if not healthy:
            notes.append(f"{group}: no healthy flight to fit on ({len(members)} flights left out)")
            continue
        fits.append(Fit(group, healthy, members, folder / f"{len(fits)}"))
        if len(healthy) > 1:
            for out in healthy:
                rest = tuple(flight for flight in healthy if flight is not out)
                fits.append(Fit(group, rest, (out,), folder / f"{len(fits)}"))
    return fits, notes


def make(task: Fit) -> Suite | str:
    """Fit and calibrate; return why not where the flights do not allow it."""
    logs = [lambda flight=flight: packed(flight.messages(fit_messages())) for flight in task.healthy]
    try:
        fit_profile(task.healthy[0].kind, logs, task.folder, "vehicle")
        return make_suite(task.folder, [flight.messages for flight in task.healthy])
    except ValueError as error:
        return str(error)


def try_on(suite: Suite, flight: Flight, fitted_on: tuple[str, ...]) -> Result:
    """Run all detectors on a flight."""
    runs = run_suite(suite, flight.messages(interests(suite.profile)))
    traces = {trace.layout.observer: trace for trace in runs[FAUIO].traces}
    limits = tuple(limit(suite, traces, fault) for fault in flight.faults)
    longest = max(runs[FAUIO].traces, key=lambda trace: int(trace.armed.sum()) / trace.layout.rate_hz)
    found = {name: judged(flight, runs[name], names=name != ENERGY) for name in DETECTORS}
    said = announced(flight.said)
    found[AUTOPILOT] = Found(
        tuple(verdict(fault, flight, said, names=False) for fault in flight.faults),
        (None,) * len(flight.faults),
        (None,) * len(flight.faults),
        tuple(before_any_fault(flight, said)),
    )
    watched = watched_s(flight, longest.vehicle_ns // 1_000_000, longest.armed, longest.layout.rate_hz)
    channels = frozenset(rule.channel for observer in suite.profile.observers for rule in observer.alarms)
    return Result(flight, fitted_on, channels, watched, found, limits)


def limit(suite: Suite, traces: Mapping[str, Trace], fault: Fault) -> float | None:
    """Return the information limit of a fault's delay by the observer that could see it first."""
    found = []
    for observer in suite.profile.observers:
        trace = traces.get(observer.name)
        before = None if trace is None else (trace.vehicle_ns <= fault.on_ms * 1_000_000) & trace.armed
        if trace is not None and before is not None and before.any():
            hover = np.median(trace.u[before][-round(trace.layout.rate_hz) :], axis=0)
            found.append(information_limit(observer, fault, hover))
    return min((one for one in found if one is not None), default=None)


def judged(flight: Flight, run: Run, *, names: bool) -> Found:
    """Return what a detector's run is worth."""
    raised = spells(run.events)
    return Found(
        tuple(verdict(fault, flight, raised, names=names) for fault in flight.faults),
        tuple(estimated(fault, run, first=True) for fault in flight.faults),
        tuple(estimated(fault, run, first=False) for fault in flight.faults),
        tuple(false_alarms(flight, raised)),
        tuple(judged(flight, Run(events, run.traces), names=names) for events in run.rarer),
    )


def estimated(fault: Fault, run: Run, *, first: bool) -> Reading | None:
    """Return how well a run estimated a fault: by the observer that named it first, if several have its channel.

    ``first`` asks for the time just after the alarm that names it.
    """
    if fault.truth is None:
        return None
    channel = fault.truth.channel
    traces = {trace.layout.observer: trace for trace in run.traces if channel in trace.layout.faults}
    events = [event for event in run.events if event.channel == channel and event.observer in traces]
    since_ms = fault.on_ms - ONSET_MS
    named = [event for event in events if event.vehicle_time_ms >= since_ms and event.state == "raised"]
    if not traces or (first and not named):
        return None
    trace = traces[named[0].observer] if named else next(iter(traces.values()))
    alarms = [spell for spell in spells(events) if named and spell.raised_ms == named[0].vehicle_time_ms]
    estimate = trace.isolated[:, trace.layout.faults.index(channel)]
    if fault.truth.unit == "share":
        estimate = _share_lost(trace, channel, run)
    return reading(fault, trace.vehicle_ns // 1_000_000, estimate, trace.armed, alarms[0] if first else None)


def _share_lost(trace: Trace, channel: str, run: Run) -> NDArray[np.float64]:
    """Return the share of its command that an actuator is said to have lost (N,), nan where there is no command."""
    at = trace.layout.faults.index(channel)
    if "deflection" not in trace.layout.fault_units[at]:
        command = trace.u[:, trace.layout.inputs.index(channel)]
        return -trace.isolated[:, at] / np.where(np.abs(command) < SMALLEST_COMMAND, np.nan, command)
    # A surface at trim shows no loss: what counts is what the alarm last said.
    lost = np.zeros(len(trace.u))
    for event in run.events:
        if event.channel == channel and event.observer == trace.layout.observer:
            share = 0.0 if event.state == "cleared" else -(event.relative or 0.0)
            lost[trace.vehicle_ns >= event.vehicle_time_ms * 1_000_000] = share
    return lost


def measure(flights: Sequence[Flight], jobs: int) -> tuple[list[Result], list[str]]:
    """Return the results on all flights, those of left-out ones behind, and what could not be done."""
    results: list[tuple[bool, Result]] = []
    context = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory() as folder, ProcessPoolExecutor(jobs, mp_context=context) as pool:
        fits, notes = fits_of(flights, Path(folder))
        made = [(task, pool.submit(make, task)) for task in fits]
        tried: list[Future[Result]] = []
        for task, future in made:
            suite, names = future.result(), tuple(flight.name for flight in task.healthy)
            if isinstance(suite, str):
                notes.append(f"{task.group}, on {', '.join(names)}: not fitted: {suite}")
                continue
            print(f"fitted on {', '.join(names)} ({task.group})", file=sys.stderr)
            notes += [f"{task.group}: {note}" for note in suite.notes]
            tried += [pool.submit(try_on, suite, flight, names) for flight in task.tried_on]
        for outcome in tried:
            result = outcome.result()
            left_out = result.flight.healthy and result.flight.name not in result.fitted_on
            results.append((left_out, result))
    return [result for _, result in sorted(results, key=lambda one: one[0])], list(dict.fromkeys(notes))


def main() -> None:
    parser = argparse.ArgumentParser(description="Measure what is detected on a folder of recorded flights.")
    parser.add_argument("flights", type=Path, nargs="+", metavar="FLIGHTS", help="recordings with their JSON files")
    parser.add_argument("--write", action="store_true", help="write docs/detection.md and docs/images/detection.png")
    parser.add_argument("--png", type=Path, help="draw the picture into this file")
    parser.add_argument("--jobs", type=int, default=2, help="processes (2)")
    args = parser.parse_args()
    flights = [
        replace(flight, group=f"{flight.group} ({folder.name})" if len(args.flights) > 1 else flight.group)
        for folder in args.flights
        for flight in read_flights(folder)
    ]
    results, notes = measure(flights, args.jobs)
    if not results:
        sys.exit("\n".join([*map(str, args.flights), "nothing could be measured", *notes]))
    picture = ROOT / "docs/images/detection.png" if args.write else args.png
    if picture is not None:
        from detection_plot import draw

        draw(results, (AUTOPILOT, *DETECTORS), picture)
    text = page(results, (AUTOPILOT, *DETECTORS), notes)
    if args.write:
        (ROOT / "docs/detection.md").write_text(text, encoding="utf-8")
    else:
        sys.stdout.write(text)


if __name__ == "__main__":
    main()
