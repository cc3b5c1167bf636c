"""What is seen of the same flights in a vehicle's own log, over a fast link and over radios, and what each rate costs.

    python bench/rates.py FLIGHTS... [--write] [--jobs 2]

FLIGHTS are folders with several recordings of each flight and its truth (:mod:`flights`): a log of the autopilot, links
at other rates. Per vehicle and kind of recording a profile is fitted on the healthy flights; each of them is also left
out once and watched with a profile of the others. Where there is a flight that only hovers, a second profile is fitted
on it alone. ``--write`` writes docs/rates.md, without it the page is printed.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from statistics import median

from accounting import AFTERMATH_S, Spell, Verdict, false_alarms, spells, verdict, watched_s
from flights import Flight, flight

from adapters.logs.recordings import read_batches
from monitor.profile import read_profile
from monitor.vehicles.kinds import fit_messages
from replay.fit import fit_profile
from replay.player import interests, play_batches

ROOT = Path(__file__).parent.parent
KINDS = {
    ".100hz.tlog": "link, 100 Hz",
    "_tutorial.tlog": "link, 100 Hz",
    ".tlog": "link, motors 10 Hz",
    ".bin": "log, motors 10 Hz",
    ".ulg": "log, motors 10 Hz",
    ".radio.tlog": "radio, motors 2 Hz",
    "_radio.tlog": "radio, motors 1 Hz",
    "_radio1200.tlog": "radio, motors 0.3 Hz",
}
"""Recordings of a flight by what follows its name, and what they are."""
FAST_LOG = "log, motors 250 Hz"
"""A log of PX4 with SDLOG_PROFILE 2065."""
HOVER = "_hover"
MOTORS = "actuator"


@dataclass(frozen=True, slots=True)
class Fit:
    """A profile to fit, and the flights to watch with it."""

    group: str
    healthy: tuple[Flight, ...]
    watched: tuple[Flight, ...]


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a profile made of a flight: alarms outside faults, a verdict for each fault, seconds of evidence."""

    fit: Fit
    flight: Flight
    verdicts: tuple[Verdict, ...]
    false: tuple[Spell, ...]
    watched_s: float


@dataclass(frozen=True, slots=True)
class Fitted:
    """How a fit went: lines for people or why not, processor seconds, and its outcomes."""

    fit: Fit
    text: tuple[str, ...]
    refused: str
    cpu_s: float
    outcomes: tuple[Outcome, ...]


def recordings(folder: Path) -> Iterator[Flight]:
    """Yield each recording of a folder as a flight of the group of its vehicle and kind."""
    for path in sorted(folder.glob("*.json")):
        entry = json.loads(path.read_text(encoding="utf-8"))
        for suffix, kind in KINDS.items():
            log = folder / f"{path.stem}{suffix}.xz"
            if isinstance(entry, dict) and "vehicle" in entry and log.is_file():
                fast = entry.get("sdlog_profile") == 2065
                vehicle = f"{entry.get('autopilot', '')} {entry.get('model', '')}".split(" (")[0].strip()
                yield replace(flight(entry, path.stem, log), group=f"{vehicle}, {FAST_LOG if fast else kind}")


def fits_of(flights: Sequence[Flight]) -> Iterator[Fit]:
    """Yield a fit per group, fits that leave a healthy flight out, and those of hovering alone."""
    for group in dict.fromkeys(one.group for one in flights):
        members = tuple(one for one in flights if one.group == group)
        healthy = tuple(one for one in members if one.healthy)
        flown = tuple(one for one in healthy if not one.name.endswith(HOVER)) or healthy
        if healthy:
            yield Fit(group, flown, members)
        for out in flown if len(flown) > 1 else ():
            yield Fit(group, tuple(one for one in flown if one is not out), (out,))
        for hover in healthy:
            if hover.name.endswith(HOVER) and len(members) > 1:
                yield Fit(f"{group}, hover alone", (hover,), members)


def make(fit: Fit, folder: str) -> Fitted:
    """Fit, and watch the flights with the profile."""
    begin = time.process_time()
    logs = [partial(read_batches, one.log, fit_messages()) for one in fit.healthy]
    try:
        report = fit_profile(fit.healthy[0].kind, logs, Path(folder), "it")
    except ValueError as error:
        return Fitted(fit, (), str(error), time.process_time() - begin, ())
    cpu_s = time.process_time() - begin
    return Fitted(fit, tuple(report.text()), "", cpu_s, tuple(watch(fit, one, Path(folder)) for one in fit.watched))


def watch(fit: Fit, one: Flight, folder: Path) -> Outcome:
    """Watch a flight up to its touchdown."""
    profile = read_profile(folder)
    run = play_batches(profile, read_batches(one.log, interests(profile)), keep_traces=True)
    end_ms = one.touchdown_ms or 2**62
    raised = [spell for spell in spells(run.events) if spell.raised_ms <= end_ms]
    longest = max(run.traces, key=lambda trace: int(trace.armed.sum()) / trace.layout.rate_hz)
    times_ms = longest.vehicle_ns // 1_000_000
    seconds = watched_s(one, times_ms, longest.armed & (times_ms <= end_ms), longest.layout.rate_hz)
    verdicts = tuple(verdict(fault, one, raised) for fault in one.faults)
    return Outcome(fit, one, verdicts, tuple(false_alarms(one, raised)), seconds)


def page(results: Sequence[Fitted]) -> str:
    """Return the page, misses first."""
    whole = [result for result in results if len(result.fit.watched) > 1]
    lines = [
        INTRODUCTION,
        *misses(results),
        "",
        "## By vehicle and recording",
        "",
        BY_GROUP,
        "",
        *by_group(results),
        "",
    ]
    lines += ["## Fault by fault", "", BY_FAULT, "", *by_fault(whole), "", "## What the fits say", ""]
    for result in whole:
        lines += [f"**{result.fit.group}**", "", "```text", *(result.text or (result.refused,)), "```", ""]
    return "\n".join(lines)


def misses(results: Sequence[Fitted]) -> list[str]:
    """Return what was refused, missed, named wrongly or raised without a fault."""
    lines = []
    for result in results:
        if result.refused:
            lines.append(f"- {result.fit.group}: not fitted: {result.refused}")
        for outcome in result.outcomes:
            for fault, found in zip(outcome.flight.faults, outcome.verdicts, strict=True):
                what = f"{result.fit.group}: {outcome.flight.name}"
                if found.delay_s is None:
                    instead = f", but {', '.join(found.named)}" if found.named else ""
                    lines.append(f"- missed: {what} ({fault.kind} {fault.text}){instead}")
                elif found.others:
                    lines.append(f"- not alone: {what}, also {', '.join(found.others)}")
            for spell in outcome.false:
                left_out = " (left out of the fit)" if _left_out(outcome) else ""
                lines.append(
                    f"- false alarm: {result.fit.group}: {spell.channel} in {outcome.flight.name} at "
                    f"{spell.raised_ms / 1000:.1f} s{left_out}"
                )
    return list(dict.fromkeys(lines)) or ["nothing on these flights"]


def by_group(results: Sequence[Fitted]) -> list[str]:
    """Return a row for each vehicle and kind of recording."""
    lines = [_row("vehicle, recording", "fit", "motor faults", "other faults", "false alarms"), _row(*["---"] * 5)]
    for result in results:
        if len(result.fit.watched) == 1:
            continue
        left_out = [
            outcome
            for other in results
            if other.fit.group == result.fit.group and len(other.fit.watched) == 1
            for outcome in other.outcomes
        ]
        cells = [_faults(result.outcomes, motors=True), _faults(result.outcomes, motors=False)]
        unseen = [one for one in result.outcomes if one.flight not in result.fit.healthy]
        alarms = f"{_rate(unseen)} not in the fit" + (f"; {_rate(left_out)} left out" if left_out else "")
        flights = f"{len(result.fit.healthy)} flight{'s' * (len(result.fit.healthy) > 1)}"
        fit = "refused" if result.refused else f"{flights}, {result.cpu_s:.0f} s"
        lines.append(_row(result.fit.group, fit, *cells, "" if result.refused else alarms))
    return lines


def by_fault(results: Sequence[Fitted]) -> list[str]:
    """Return a row for each fault of each recording."""
    lines = [_row("recording", "flight", "fault", "right name after", "also named"), _row(*["---"] * 5)]
    for result in results:
        for outcome in result.outcomes:
            for fault, found in zip(outcome.flight.faults, outcome.verdicts, strict=True):
                after = "MISSED" if found.delay_s is None else f"{found.delay_s:.2f} s"
                named = ", ".join(found.others if found.delay_s is not None else found.named)
                lines.append(_row(result.fit.group, outcome.flight.name, f"{fault.kind} {fault.text}", after, named))
    return lines


def _faults(outcomes: Sequence[Outcome], *, motors: bool) -> str:
    """Return how many faults were named, and how soon."""
    found = [
        one
        for outcome in outcomes
        for fault, one in zip(outcome.flight.faults, outcome.verdicts, strict=True)
        if fault.kind.startswith(MOTORS) == motors
    ]
    delays = [one.delay_s for one in found if one.delay_s is not None]
    if not found:
        return ""
    worst = f"; {median(delays):.2f} s, worst {max(delays):.2f} s" if delays else ""
    return f"{len(delays)} of {len(found)}{worst}; alone {sum(bool(one.isolated) for one in found)}"


def _rate(outcomes: Sequence[Outcome]) -> str:
    minutes = sum(outcome.watched_s for outcome in outcomes) / 60.0
    return f"{sum(len(outcome.false) for outcome in outcomes)} in {minutes:.0f} min"


def _left_out(outcome: Outcome) -> bool:
    return outcome.flight.healthy and outcome.flight not in outcome.fit.healthy


def _row(*cells: str) -> str:
    return f"| {' | '.join(cells)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description="Measure what is seen at the rates of real logs and links.")
    parser.add_argument(
        "flights", type=Path, nargs="+", metavar="FLIGHTS", help="folders of recordings and their truth"
    )
    parser.add_argument("--write", action="store_true", help="write docs/rates.md")
    parser.add_argument("--jobs", type=int, default=2, help="processes (2)")
    args = parser.parse_args()
    flights = [one for folder in args.flights for one in recordings(folder)]
    fits = list(fits_of(flights))
    context = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory() as folder, ProcessPoolExecutor(args.jobs, mp_context=context) as pool:
        made = [pool.submit(make, fit, f"{folder}/{number}") for number, fit in enumerate(fits)]
        results = []
        for future in made:
            results.append(future.result())
            print(f"{len(results)}/{len(fits)} {results[-1].fit.group} {results[-1].refused}", file=sys.stderr)
    text = page(results)
    if args.write:
        (ROOT / "docs/rates.md").write_text(text, encoding="utf-8")
    else:
        sys.stdout.write(text)


INTRODUCTION = """# Detection at the rates of real logs and links

This page shows what fauio detects at low rates: the same flights of two autopilots' simulators as default logs hold
them, as a link brings them to a companion computer, and as telemetry radios do.

    python bench/rates.py FLIGHTS... --write

makes this page. Profiles are fitted on the healthy flights of a vehicle and a kind of recording. In a second round each
healthy flight is left out and watched with a profile of the others. One flight that only hovers is fitted by itself.
Flights count up to touchdown.

## What is wrong

Faults that were missed or named wrongly, fits that were refused, and all false alarms
([why](limits.md#what-was-missed-or-seen-late)):
"""

BY_GROUP = """Faults named, with the median and worst delay from the onset; faults of which no other channel was named
("alone"); processor time of the fit; false alarms and the minutes watched."""

BY_FAULT = f"""Delay until the right name, and other names raised until {AFTERMATH_S:g} s after the fault's end."""


if __name__ == "__main__":
    main()
