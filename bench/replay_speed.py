"""How fast recorded flights replay: in large batches, in batches of 20 ms, and the command from start to end.

    python bench/replay_speed.py [--profile PROFILE] [--repeat N] [--seconds S] [--json] [LOG ...]

Each log, decompressed, is repeated with later clocks until it is S seconds long, and read from disk anew each time.
Rates are times real time, from processor time on one core: the best of N runs in large batches, one run in batches as a
daemon collects them (the pipeline alone, without reading), one run of the command with all that it imports. That all
three find the same events is checked.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from long_log import LongLog

from adapters.batch import Batch, arrival_times, cut
from adapters.logs.recordings import read_batches
from monitor.event import AlarmEvent
from monitor.pipeline import Pipeline
from monitor.profile import Profile, read_profile
from replay.player import interests, play_batches

BATCH_NS = 20_000_000
ROOT = Path(__file__).parent.parent
PROFILE = ROOT / "replay" / "data" / "quad"
LOGS = (ROOT / "replay" / "data" / "copter_motor1.tlog.xz", ROOT / "tests" / "data" / "copter_healthy_square.tlog.xz")


def in_small_batches(profile: Profile, path: Path) -> tuple[float, tuple[AlarmEvent, ...]]:
    """Return the processor time of a pipeline that is given 20 ms of telemetry at a time, and its events."""
    pipeline = Pipeline(profile)
    events: list[AlarmEvent] = []
    spent_s = 0.0
    for large in read_batches(path, interests(profile)):
        batches = list(small_batches(large))
        started = time.process_time()
        for batch in batches:
            events += [output for output in pipeline.run(batch) if isinstance(output, AlarmEvent)]
        spent_s += time.process_time() - started
    return spent_s, tuple(events)


def small_batches(batch: Batch) -> Iterator[Batch]:
    """Yield the messages of a batch 20 ms at a time, by their times of arrival."""
    edges = np.flatnonzero(np.diff(arrival_times(batch) // BATCH_NS)) + 1
    for start, stop in pairwise([0, *edges.tolist(), batch.count]):
        yield cut(batch, start, stop)


def command_seconds(profile: Path, path: Path, folder: Path) -> tuple[float, list[Any]]:
    """Return the processor time of ``fauio replay`` from start to end, and the events it wrote."""
    alarms = folder / "alarms.jsonl"
    command = [sys.executable, "-m", "fauio", "replay", str(profile), str(path), "--alarms", str(alarms)]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(command, check=True, capture_output=True)  # noqa: S603 - our own command
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return spent, [json.loads(line) for line in alarms.read_text().splitlines()]


def measure(profile_path: Path, log: Path, repeat: int, least_s: float) -> dict[str, Any]:
    """Return times real time of the three ways.

    Raises
    ------
    AssertionError
        They find different events.
    """
    profile, long_log = read_profile(profile_path), LongLog(log)
    copies = math.ceil(least_s / long_log.period_s)
    flight_s = copies * long_log.period_s
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "flight.tlog"
        long_log.write(path, copies)
        size = path.stat().st_size
        large_s = math.inf
        for _ in range(repeat):
            started = time.process_time()
            found = play_batches(profile, read_batches(path, interests(profile)))
            large_s = min(large_s, time.process_time() - started)
        small_s, expected = in_small_batches(profile, path)
        command_s, written = command_seconds(profile_path, path, Path(folder))
    assert found.events == expected
    assert written == [json.loads(json.dumps(event.to_json())) for event in expected]
    return {
        "log": log.name,
        "copies": copies,
        "seconds": round(flight_s, 1),
        "megabytes": round(size / 1e6, 1),
        "messages": copies * long_log.messages,
        "samples": found.samples,
        "events": len(found.events),
        "large_batches": round(flight_s / large_s, 1),
        "small_batches": round(flight_s / small_s, 1),
        "command": round(flight_s / command_s, 1),
    }


def text(rows: list[dict[str, Any]]) -> str:
    lines = [
        "| log | flight, s | messages | samples | events | large batches, x real time | of 20 ms | command |",
        "|---|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {row['log']} x {row['copies']} | {row['seconds']:.0f} | {row['messages']:,} | {row['samples']:,} | "
        f"{row['events']} | {row['large_batches']:.0f} | {row['small_batches']:.0f} | {row['command']:.0f} |"
        for row in rows
    ]
    return "\n".join([*lines, ""])


def main() -> None:
    parser = argparse.ArgumentParser(description="Measure replays.")
    parser.add_argument("logs", nargs="*", type=Path, default=LOGS, metavar="LOG", help="telemetry logs (.tlog)")
    parser.add_argument("--profile", type=Path, default=PROFILE, help="profile folder")
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=300.0, help="least length of what is replayed (300)")
    parser.add_argument("--json", action="store_true", help="print JSON instead of Markdown")
    arguments = parser.parse_args()
    rows = [measure(arguments.profile, log, arguments.repeat, arguments.seconds) for log in arguments.logs]
    sys.stdout.write(json.dumps(rows, indent=1) + "\n" if arguments.json else text(rows))


if __name__ == "__main__":
    main()
