"""What bad links cost: recorded flights distorted, and what is still seen, how fast, and what is not true.

    python bench/gaps.py PROFILES FLIGHTS [--recordings ENDING] [--seeds N] [--only NAME ...] [--links NAME ...]

FLIGHTS is a folder of recordings with their truth (:mod:`flights`); ENDING chooses between several of one flight.
PROFILES has a profile for each group of them, in a folder named after the group (``copter-quad``,
``copter-quad-noisy-sensors``); what is missing is fitted on the healthy flights of the group and kept there. A delay
goes from the fault's onset to the arrival of the message that raises the alarm, as they come on the undistorted link.
"""

from __future__ import annotations

import argparse
import sys
import zlib
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from math import inf
from pathlib import Path

import numpy as np
from accounting import ONSET_MS, false_alarms, spells, verdict
from distortions import DISTORTIONS, distorted
from flights import Fault, Flight, read_flights

from adapters.batch import Batch, cut, joined
from adapters.logs.recordings import packed
from monitor.event import AlarmEvent
from monitor.pipeline import Pipeline
from monitor.profile import Profile, read_profile
from monitor.vehicles.kinds import fit_messages
from replay.fit import fit_profile
from replay.player import interests

_STEP_S = 0.02
"""Arrivals that are taken together where an alarm's own is looked for: as many as the daemon takes."""
_LOOKED_S = 20.0
"""Seconds after an onset in which it is looked for so closely, and then by the second."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """One fault, or a flight without, on one distorted link."""

    distortion: str
    flight: str
    fault: str
    delay_s: float | None
    others: tuple[str, ...]
    cleared_s: float | None
    false: tuple[str, ...]
    watched_s: float


def profile_of(flight: Flight, flights: Sequence[Flight], folder: Path) -> Profile:
    """Return the profile of a flight's group, fitted where there is none."""
    path = folder / flight.group.replace(" ", "-")
    if not (path / "profile.toml").is_file():
        healthy = [one for one in flights if one.group == flight.group and one.healthy]
        logs = [partial(lambda one: packed(one.messages(fit_messages())), one) for one in healthy]
        fit_profile(healthy[0].kind, logs, path, "vehicle")
    return read_profile(path)


def arrivals(batch: Batch) -> np.ndarray:
    """Return the time of arrival of each message, nanoseconds."""
    found = np.zeros(batch.count, np.int64)
    for columns in batch.columns:
        found[columns.position] = columns.received_ns
    for position, message in batch.others.items():
        found[position] = message.received_ns
    return found


def arrival_of(batch: Batch, time_ms: int) -> int:
    """Return when the first measurement stamped at or after a time arrives."""
    columns = next(one for one in batch.columns if one.name == "ATTITUDE")
    later = np.flatnonzero(columns.fields["time_boot_ms"] >= time_ms)
    return int(columns.received_ns[later[0] if len(later) else -1])


def run(profile: Profile, batch: Batch, onsets_ns: Sequence[int]) -> tuple[list[tuple[int, AlarmEvent]], float]:
    """Return the events with when their message came, exact near onsets, and the share of ticks that was watched."""
    pipeline, events = Pipeline(profile), []
    at_ns, ends = arrivals(batch), set[int]()
    for onset in onsets_ns:
        close = np.arange(onset, onset + round(1e9 * _LOOKED_S), round(1e9 * _STEP_S))
        for steps in (close, np.arange(onset, at_ns[-1], 1_000_000_000)):
            ends.update(np.searchsorted(at_ns, steps).tolist())
    ends.update((0, batch.count))
    samples, armed = 0, 0
    places = sorted(ends)
    for start, stop in pairwise(places):
        for output in pipeline.run(cut(batch, start, stop)):
            if isinstance(output, AlarmEvent):
                events.append((int(at_ns[stop - 1]), output))
            else:
                samples, armed = samples + len(output), armed + int(np.count_nonzero(output.armed))
    skipped = sum(one.skipped for one in pipeline.statistics().values())
    return events, armed / max(samples + skipped, 1)


def outcomes(flight: Flight, profile: Profile, seeds: int, links: Sequence[str]) -> list[Outcome]:
    """Return what was made of a flight on each of these links."""
    from adapters.logs.recordings import read_batches

    whole = joined(list(read_batches(flight.log, interests(profile))))
    if flight.touchdown_ms is not None:
        end_ns = arrival_of(whole, flight.touchdown_ms)
        whole = cut(whole, 0, int(np.searchsorted(arrivals(whole), end_ns)))
    onsets = [arrival_of(whole, fault.on_ms) for fault in flight.faults]
    found = []
    for name in links:
        distortion = DISTORTIONS[name]
        for seed in range(seeds if name != "none" else 1):
            lossy = distorted(whole, distortion, zlib.crc32(flight.name.encode()) + seed)
            events, share = run(profile, lossy, onsets)
            alarms = [event for _, event in events if event.observer not in ("link", "monitor")]
            raised = spells(alarms)
            false = tuple(f"{spell.channel} {spell.raised_ms / 1e3:.1f}" for spell in false_alarms(flight, raised))
            for fault, onset in zip(flight.faults, onsets, strict=True):
                said = verdict(fault, flight, raised)
                delay = None if said.delay_s is None else _delay(fault, events, onset)
                found.append(Outcome(name, flight.name, fault.kind, delay, said.others, said.cleared_s, false, share))
                false = ()
            if not flight.faults:
                found.append(Outcome(name, flight.name, "", None, (), None, false, share))
    return found


def _delay(fault: Fault, events: Sequence[tuple[int, AlarmEvent]], onset_ns: int) -> float:
    # the onset is known as exactly as the verdict takes it
    since_ms = fault.on_ms - ONSET_MS
    return next(
        (at - onset_ns) / 1e9
        for at, event in events
        if event.state == "raised" and event.channel in fault.channels and event.vehicle_time_ms >= since_ms
    )


def table(found: Sequence[Outcome]) -> list[str]:
    """Return the table: for each link and kind of fault the middle and the worst delay, and what was not right."""
    kinds = sorted({one.fault for one in found if one.fault})
    head = ["link", *kinds, "others named", "false", "standing", "watched"]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for name in dict.fromkeys(one.distortion for one in found):
        here = [one for one in found if one.distortion == name]
        cells = []
        for kind in kinds:
            delays = [one.delay_s for one in here if one.fault == kind]
            seen = sorted(delay for delay in delays if delay is not None)
            missed = f", {len(delays) - len(seen)} missed" if len(seen) < len(delays) else ""
            cells.append((f"{seen[len(seen) // 2]:.2f} ({seen[-1]:.2f})" if seen else "-") + missed)
        others = [f"{one.flight}: {', '.join(one.others)}" for one in here if one.others]
        false = [alarm.split()[0] for one in here for alarm in one.false]
        standing = sum(one.cleared_s == inf for one in here)
        watched = np.mean([one.watched_s for one in here])
        cells += [str(len(others)), " ".join(false) or "0", str(standing), f"{100 * watched:.0f} %"]
        lines.append("| " + " | ".join([name, *cells]) + " |")
    return lines


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("profiles", type=Path, metavar="PROFILES")
    parser.add_argument("flights", type=Path, metavar="FLIGHTS")
    parser.add_argument("--recordings", metavar="ENDING", help="what follows the names of the flights that are read")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--only", nargs="*", default=[""], metavar="NAME", help="flights whose name holds one of these")
    parser.add_argument("--links", nargs="*", default=[*DISTORTIONS], choices=DISTORTIONS, metavar="NAME", help="(all)")
    parser.add_argument("--jobs", type=int, default=2, help="processes (2)")
    arguments = parser.parse_args()
    flights = read_flights(arguments.flights, *([[arguments.recordings]] if arguments.recordings else []))
    chosen = [one for one in flights if any(word in one.name for word in arguments.only)]
    profiles = [profile_of(one, flights, arguments.profiles) for one in chosen]
    with ProcessPoolExecutor(arguments.jobs) as pool:
        count = len(chosen)
        results = pool.map(outcomes, chosen, profiles, [arguments.seeds] * count, [arguments.links] * count)
        found = [one for result in results for one in result]
    sys.stdout.write("\n".join(table(found)) + "\n")
    for one in found:
        if one.false or one.others or (one.fault and one.delay_s is None):
            print(one, file=sys.stderr)


if __name__ == "__main__":
    main()
