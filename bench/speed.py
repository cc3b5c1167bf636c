"""All the speed ratios that are promised, in one command: each with its target, and whether it is met.

    python bench/speed.py [--quick] [--json] [--profile PROFILE] [LOG ...]

Runs observer, decode, replay_speed, peers and peers_io one after the other, each in a process of its own. The logs
are those that are replayed. Exits with 1 where a target is missed or libraries that should agree do not. With
--quick everything is measured once instead of several times, and the observer on shorter recordings.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

BENCH = Path(__file__).parent


@dataclass(frozen=True, slots=True)
class Row:
    """One promise: the figure, and the least or most that it may be."""

    what: str
    figure: float
    target: float
    unit: str = "x"
    at_most: bool = False

    @property
    def met(self) -> bool:
        """Whether the promise is kept."""
        return self.figure <= self.target if self.at_most else self.figure >= self.target


def run(name: str, *arguments: str) -> Any:
    """Return what a benchmark says as JSON."""
    sys.stderr.write(f"{name} ...\n")
    command = [sys.executable, str(BENCH / f"{name}.py"), "--json", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603 - our own scripts
    if done.returncode:
        raise SystemExit(f"bench/{name}.py failed:\n{done.stderr[-2000:]}")
    return json.loads(done.stdout)


def observer_rows(found: dict[str, Any]) -> list[Row]:
    """Return the promises about the observer."""
    rows = []
    for plant, ways in found["ratios"].items():
        us = {way: row["us"] for way, row in ways.items()}
        rows += [
            Row(f"observer, {plant}: sample by sample", us["batches of one"], 5.0, "us", at_most=True),
            Row(f"observer, {plant}: one batch over the textbook's loop", us["textbook loop"] / us["one batch"], 20.0),
        ]
        if "C, -O2" in us:
            ratio = us["one batch"] / us["C, -O2"]
            rows.append(Row(f"observer, {plant}: time of one batch over C's", ratio, 3.0, at_most=True))
    return rows


def io_rows(found: dict[str, Any]) -> list[Row]:
    """Return the promises about logs."""

    def ratio(what: str, ours: str, theirs: str) -> float:
        return float(found[what][ours]["messages_per_s"] / found[what][theirs]["messages_per_s"])

    log, out, into = "telemetry log in", "MCAP out", "MCAP in"
    batches = "ours, batches, decoded"
    decoded = "mcap, non-seeking, decoded"
    return [
        Row(".tlog to columns over pymavlink's recv_msg", ratio(log, "ours, batches", "pymavlink recv_msg"), 20.0),
        Row("MCAP written over mcap's writer", ratio(out, "ours", "mcap"), 1.0),
        Row("MCAP written over foxglove-sdk's writer", ratio(out, "ours", "foxglove-sdk"), 1.0),
        Row("MCAP read and decoded in batches over mcap's reader, decoded", ratio(into, batches, decoded), 1.0),
    ]


def replay_rows(found: Sequence[dict[str, Any]]) -> list[Row]:
    """Return the promises about replays."""
    return [
        *(Row(f"replay of {row['log']}: times real time", row["large_batches"], 500.0) for row in found),
        *(Row(f"fauio replay of {row['log']}: times real time", row["command"], 160.0) for row in found),
    ]


def text(rows: Sequence[Row]) -> str:
    lines = ["| what | figure | target | met |", "|---|---|---|---|"]
    for row in rows:
        bound = "at most" if row.at_most else "at least"
        lines.append(
            f"| {row.what} | {row.figure:.3g} {row.unit} | {bound} {row.target:g} {row.unit} | "
            f"{'yes' if row.met else 'NO'} |"
        )
    return "\n".join([*lines, ""])


def main() -> int:
    parser = argparse.ArgumentParser(description="Measure all that is promised about speed.")
    parser.add_argument("logs", nargs="*", metavar="LOG", help="telemetry logs to replay (.tlog)")
    parser.add_argument("--profile", help="their profile")
    parser.add_argument("--quick", action="store_true", help="measure once")
    parser.add_argument("--json", action="store_true", help="print JSON instead of Markdown")
    arguments = parser.parse_args()
    os.environ["PYTHONPATH"] = os.pathsep.join([str(BENCH.parent), os.environ.get("PYTHONPATH", "")])
    repeat = ["--repeat", "1" if arguments.quick else "5"]
    length = ["--seconds", "180" if arguments.quick else "300"]
    profile = ["--profile", arguments.profile] if arguments.profile else []
    observer = run("observer", *(["--quick"] if arguments.quick else []))
    decode = run("decode", *repeat)
    replay = run("replay_speed", *repeat, *length, *profile, *arguments.logs)
    peers = run("peers")
    peers_io = run("peers_io", *repeat)
    rows = [*observer_rows(observer), *io_rows(peers_io), *replay_rows(replay)]
    if arguments.json:
        details = {"observer": observer, "decode": decode, "replay": replay, "peers": peers, "peers_io": peers_io}
        targets = [asdict(row) | {"met": row.met} for row in rows]
        sys.stdout.write(json.dumps({"targets": targets, **details}, indent=1) + "\n")
    else:
        sys.stdout.write(text(rows))
    return int(any(not row.met for row in rows))


if __name__ == "__main__":
    sys.exit(main())
