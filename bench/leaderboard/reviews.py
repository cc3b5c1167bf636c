"""Verdicts of ``fauio review`` on folders of logs, beside what is known of them.

    python bench/leaderboard/reviews.py FOLDER... [--quick] [--json]

Folders of flights with their truth beside them (NAME.json, see ``bench/flights.py``): is the first finding of the
right channel, and how long after the fault does it begin? ``crates/converter/tests/fixtures`` of PX4's
flight-review-rs, whose logs were judged by hand. ``test`` of PX4's pyulog, and any other logs: their verdicts are
printed for a person to read. A log without a flight is not judged. Nothing of these sets is in this repository.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import alfa
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from flights import Flight, read_flights

from adapters.batch import messages
from adapters.errors import TelemetryError
from adapters.logs.recordings import read_batches
from replay.review.review import LogReview, review_log
from replay.runs.log_list import find_logs

BY_HAND = {"battery_brownout": "", "gps_interference": "", "motor_failure": "", "ekf_failure": "descent_not_followed"}
"""First findings of flight-review-rs's incidents by their data (docs/review.md); empty: nothing is wrong."""
ONBOARD = (".bin.xz", ".ulg.xz", ".bin", ".ulg", ".tlog.xz", ".100hz.tlog.xz", ".tlog")
"""Endings of a flight's recordings; the first that there is counts."""
EARLY_S = 0.5
"""Chosen: a finding that begins so long before its fault is false; clocks of logs differ by less."""
WORDS = {"baro": "barometer", "accel": "accelerometer"}


@dataclass(frozen=True, slots=True)
class Verdict:
    """What became of a log: right, missed, wrong, false (nothing is wrong with it), unknown or not judged."""

    log: str
    outcome: str
    text: str
    delay_s: float | None = None
    healthy: bool = False


def verdicts(folder: Path, *, learn: bool) -> Iterator[Verdict]:
    """Yield the verdicts on the flights of a folder with their truth, or on its logs if it has none."""
    flights = read_flights(folder, ONBOARD)
    for flight in flights:
        yield judged(flight, review_log(flight.log, learn=learn))
    if flights:
        return
    for log in (one.path for one in find_logs([folder])):
        try:
            yield known(log.name, review_log(log, learn=learn))
        except TelemetryError as error:
            yield Verdict(log.name, "not judged", str(error))


def known(log: str, review: LogReview) -> Verdict:
    """Return the verdict on a log that was judged by hand, or not at all."""
    first = review.first.rule.name if review.first is not None else ""
    expected = BY_HAND.get(log.partition(".")[0])
    outcome = "unknown" if expected is None else "right" if first == expected else "wrong" if expected else "false"
    return Verdict(log, outcome if review.facts.flight else "not judged", review.sentence, healthy=expected == "")


def judged(flight: Flight, review: LogReview) -> Verdict:
    """Return the verdict on a flight of known truth."""
    first, name = review.first, flight.log.name
    if not review.facts.flight:
        return Verdict(name, "not judged", review.sentence)
    if not flight.faults:
        return Verdict(name, "right" if first is None else "false", review.sentence, healthy=True)
    if first is None:
        return Verdict(name, "missed", review.sentence)
    fault = flight.faults[0]
    delay_s = first.judgement.start_s - onset_s(flight, fault.on_ms, review.facts.start_ns)
    text = first.judgement.text.lower()
    right = delay_s > -EARLY_S and any(_words(channel) in text for channel in fault.channels)
    return Verdict(name, "right" if right else "wrong", review.sentence, round(delay_s, 2) if right else None)


def _words(channel: str) -> str:
    name, _, axis = channel.partition("_")
    return "gps" if name == "gps" else f"{WORDS.get(name, name)} {axis}".strip()


def onset_s(flight: Flight, on_ms: int, start_ns: int) -> float:
    """Return a time of the vehicle's clock as seconds since the log's begin, by the stamps of its outputs."""
    apart: list[int] = []
    for batch in read_batches(flight.log, frozenset({"SERVO_OUTPUT_RAW"})):
        apart += [one.received_ns - one.fields["time_usec"] * 1_000 for one in messages(batch)]
        if len(apart) > 100:
            break
    return float((on_ms * 1_000_000 + np.median(apart) - start_ns) / 1e9)


def summary(found: Sequence[Verdict]) -> dict[str, float | int | None]:
    """Return how many logs became what, and the 95 % bound of the share of false verdicts (3 of n if there is none)."""
    counts = {name: sum(one.outcome == name for one in found) for name in OUTCOMES}
    delays = [one.delay_s for one in found if one.delay_s is not None]
    healthy = sum(one.healthy and one.outcome != "not judged" for one in found)
    return {
        **counts,
        "median_delay_s": float(np.median(delays)) if delays else None,
        "longest_delay_s": max(delays, default=None),
        "share_false_bound": min(1.0, float(alfa.poisson_bound(counts["false"])) / healthy) if healthy else None,
    }


OUTCOMES = ("right", "missed", "wrong", "false", "unknown", "not judged")


def main(words: Sequence[str] | None = None) -> int:
    """Run the comparison."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--quick", action="store_true", help="as of fauio review")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args(words)
    for folder in args.folders:
        found = []
        for one in verdicts(folder, learn=not args.quick):
            found.append(one)
            late = "" if one.delay_s is None else f" [{one.delay_s:+.2f} s]"
            if not args.json:
                print(f"{one.outcome:<10} {one.log}: {one.text}{late}", flush=True)
        if not found:
            sys.stderr.write(f"{folder}: holds no log\n")
            return 2
        print(json.dumps({"folder": str(folder), **summary(found)}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
