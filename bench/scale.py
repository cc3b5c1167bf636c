"""What a replay costs by the length of the log and the number of observers: processor time and memory.

    python bench/scale.py                print the page's tables
    python bench/scale.py --write        draw docs/images/replay-cost.png too
    python bench/scale.py --json         print JSON
    python bench/scale.py --quick        logs up to an hour, 8 observers
    python bench/scale.py --long         a log of 10 GB too (all of it is written to a temporary folder)

A recorded flight is repeated, all its clocks moved on, into logs of up to a day and a half (2 GB);
each is replayed by a process of its own, whose processor time and largest resident memory are taken. Observers are
copies of the profile's motor bank under other names.
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
from dataclasses import replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from long_log import LongLog

from adapters.logs.recordings import read_batches
from monitor.profile import Profile, read_profile
from monitor.views.palette import BLUE, GREY
from monitor.views.plot_style import save_small
from replay.player import interests, play_batches

ROOT = Path(__file__).parent.parent
PROFILE = ROOT / "replay" / "data" / "quad"
LOG = ROOT / "tests" / "data" / "copter_healthy_square.tlog.xz"
MEGABYTES = (0.2, 1, 10, 100, 2000)
QUICK_MEGABYTES, LONG_MEGABYTES = (0.2, 1, 10), (*MEGABYTES, 10_000)
OBSERVERS = (1, 2, 4, 8, 16, 32, 64)
LIMIT_MB = 500


def with_observers(profile: Profile, count: int) -> Profile:
    """Return a profile with ``count`` copies of its first observer; 0 leaves it as it is."""
    first = profile.observers[0]
    copies = tuple(replace(first, name=f"{first.name}_{number}") for number in range(1, count))
    return replace(profile, observers=(first, *copies), excuses=()) if count else profile


def one(profile_path: Path, log: Path, observers: int) -> dict[str, Any]:
    """Return what one replay costs the process that it is called in."""
    profile = with_observers(read_profile(profile_path), observers)
    started = time.process_time()
    found = play_batches(profile, read_batches(log, interests(profile)))
    return {
        "cpu_s": time.process_time() - started,
        "resident_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "messages": found.messages,
        "samples": found.samples,
        "events": len(found.events),
    }


def apart(profile: Path, log: Path, observers: int = 0) -> dict[str, Any]:
    """Return :func:`one` of a process of its own."""
    command = [sys.executable, __file__, "--one", str(log), "--profile", str(profile), "--observers", str(observers)]
    return dict(json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout))  # noqa: S603 - this file


def by_length(profile: Path, flight: LongLog, megabytes: tuple[float, ...], folder: Path) -> list[dict[str, Any]]:
    """Return cost by the size of the log; the smallest ones are the beginning of the flight."""
    rows = []
    piece = next(flight.copies(1))
    path = folder / "long.tlog"
    for size in megabytes:
        copies = math.ceil(size * 1e6 / len(piece))
        if copies == 1:
            part = min(1.0, size * 1e6 / len(piece))
            path.write_bytes(piece[: int(part * len(piece))])
            flight_s = part * flight.duration_s
        else:
            flight.write(path, copies)
            flight_s = copies * flight.period_s
        cost = apart(profile, path)
        rows.append({"megabytes": path.stat().st_size / 1e6, "flight_s": flight_s, **cost})
        sys.stderr.write(f"{rows[-1]}\n")
    path.unlink()
    return rows


def by_observers(profile: Path, flight: LongLog, counts: tuple[int, ...], folder: Path) -> list[dict[str, Any]]:
    """Return cost by the number of observers."""
    path = folder / "flight.tlog"
    flight.write(path, 2)
    flight_s = 2 * flight.period_s
    return [{"observers": count, "flight_s": flight_s, **apart(profile, path, count)} for count in counts]


def draw(found: dict[str, Any], path: Path) -> None:
    """Draw cost against scale."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(13.0, 4.2), layout="constrained")
    lengths, observers = found["length"], found["observers"]
    hours = [row["flight_s"] / 3600 for row in lengths]
    left.loglog(hours, [row["cpu_s"] for row in lengths], color=BLUE, marker="o", label="measured")
    left.loglog(hours, [row["flight_s"] / 500 for row in lengths], color=GREY, ls="--", label="500 times real time")
    left.set(xlabel="length of the flight (h)", ylabel="processor time of the replay (s)")
    middle.loglog(
        [row["megabytes"] for row in lengths],
        [row["resident_mb"] for row in lengths],
        color=BLUE,
        marker="s",
        label="measured",
    )
    middle.axhline(LIMIT_MB, color=GREY, ls="--", label=f"limit: {LIMIT_MB} MB")
    middle.set(xlabel="size of the log (MB)", ylabel="largest resident memory (MB)", ylim=(50, 1000))
    middle.set_yticks([50, 100, 200, 500, 1000], ["50", "100", "200", "500", "1000"])
    middle.minorticks_off()
    counts = [row["observers"] for row in observers]
    cost = [row["cpu_s"] / row["flight_s"] * 1e3 for row in observers]
    right.loglog(counts, cost, color=BLUE, marker="o", label="measured")
    right.set(xlabel="banks of 7 observers at 100 Hz", ylabel="processor time per second of flight (ms)")
    right.set_xticks(counts, [str(count) for count in counts])
    right.set_yticks([2, 5, 10, 20, 50], ["2", "5", "10", "20", "50"])
    right.minorticks_off()
    for axis in (left, middle, right):
        axis.grid(alpha=0.3)
        axis.spines[["top", "right"]].set_visible(False)
        axis.legend(frameon=False)
    figure.suptitle("What a replay costs (one core; a multirotor's profile, telemetry logs)")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.set_dpi(110)
    save_small(figure, path)
    plt.close(figure)


def text(found: dict[str, Any]) -> str:
    lines = [
        "| log, MB | flight | messages | samples | processor time, s | times real time | resident memory, MB |",
        "|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {row['megabytes']:.3g} | {row['flight_s'] / 3600:.3g} h | {row['messages']:,} | {row['samples']:,} | "
        f"{row['cpu_s']:.3g} | {row['flight_s'] / row['cpu_s']:.0f} | {row['resident_mb']:.0f} |"
        for row in found["length"]
    ]
    lines += [
        "",
        "| banks of the vehicle | samples | processor time per second of flight, ms | times real time | memory, MB |",
        "|---|---|---|---|---|",
    ]
    lines += [
        f"| {row['observers']} | {row['samples']:,} | {row['cpu_s'] / row['flight_s'] * 1e3:.2f} | "
        f"{row['flight_s'] / row['cpu_s']:.0f} | {row['resident_mb']:.0f} |"
        for row in found["observers"]
    ]
    return "\n".join([*lines, ""])


def main() -> int:
    parser = argparse.ArgumentParser(description="Measure what replays cost by scale.")
    parser.add_argument("log", nargs="?", type=Path, default=LOG, help="telemetry log of a healthy flight")
    parser.add_argument("--profile", type=Path, default=PROFILE, help="profile folder")
    parser.add_argument("--json", action="store_true", help="print JSON instead of Markdown")
    parser.add_argument("--write", action="store_true", help="draw docs/images/replay-cost.png")
    parser.add_argument("--quick", action="store_true", help="logs up to an hour, 8 observers")
    parser.add_argument("--long", action="store_true", help="a log of 10 GB too")
    parser.add_argument("--one", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--observers", type=int, default=0, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.one:
        sys.stdout.write(json.dumps(one(arguments.profile, arguments.one, arguments.observers)))
        return 0
    megabytes = QUICK_MEGABYTES if arguments.quick else LONG_MEGABYTES if arguments.long else MEGABYTES
    flight = LongLog(arguments.log)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        counts = OBSERVERS[:4] if arguments.quick else OBSERVERS
        found = {
            "observers": by_observers(arguments.profile, flight, counts, folder),
            "length": by_length(arguments.profile, flight, megabytes, folder),
        }
    if arguments.write:
        draw(found, ROOT / "docs/images/replay-cost.png")
    sys.stdout.write(json.dumps(found, indent=1) + "\n" if arguments.json else text(found))
    return int(max(row["resident_mb"] for row in found["length"]) >= LIMIT_MB)


if __name__ == "__main__":
    sys.exit(main())
