"""How fast recorded flights replay: blocks, message by message, and the command from start to end.

    python bench/replay_speed.py [--profile PROFILE] [--repeat N] [--seconds S] [--json] [LOG ...]

Each log, decompressed, is repeated with later clocks until it is S seconds long, and read from disk anew each time.
Rates are times real time, from processor time on one core: the best of N runs in blocks, one run message by message,
one run of the command with all that it imports. That all three find the same events is checked.
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
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from long_log import LongLog

from adapters.logs.recordings import read_batches, read_recording
from monitor.event import AlarmEvent
from monitor.pipeline import Pipeline
from monitor.profile import Profile, read_profile
from replay.player import interests, play_batches

ROOT = Path(__file__).parent.parent
PROFILE = ROOT / "replay" / "data" / "quad"
LOGS = (ROOT / "replay" / "data" / "copter_motor1.tlog.xz", ROOT / "tests" / "data" / "copter_healthy_square.tlog.xz")


def by_message(profile: Profile, path: Path) -> tuple[AlarmEvent, ...]:
    """Return the events of a pipeline that is fed as a live one is."""
    pipeline = Pipeline(profile)
    outputs = (one for message in read_recording(path, interests(profile)) for one in pipeline.feed(message))
    return tuple(one for one in outputs if isinstance(one, AlarmEvent))


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
        blocks_s = math.inf
        for _ in range(repeat):
            started = time.process_time()
            found = play_batches(profile, read_batches(path, interests(profile)))
            blocks_s = min(blocks_s, time.process_time() - started)
        started = time.process_time()
        expected = by_message(profile, path)
        message_s = time.process_time() - started
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
        "blocks": round(flight_s / blocks_s, 1),
        "message_by_message": round(flight_s / message_s, 1),
        "command": round(flight_s / command_s, 1),
        "ratio": round(message_s / blocks_s, 2),
    }


def text(rows: list[dict[str, Any]]) -> str:
    lines = [
        "| log | flight, s | messages | samples | events | blocks, x real time | one by one | ratio | command |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {row['log']} x {row['copies']} | {row['seconds']:.0f} | {row['messages']:,} | {row['samples']:,} | "
        f"{row['events']} | {row['blocks']:.0f} | {row['message_by_message']:.0f} | {row['ratio']:.1f} | "
        f"{row['command']:.0f} |"
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
