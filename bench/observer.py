"""How fast the observer is: textbook loop, sample by sample, in batches, and C; and what size costs.

    python bench/observer.py             print the page
    python bench/observer.py --json      print the same as JSON
    python bench/observer.py --write     write docs/observer-cost.md and its figure
    python bench/observer.py --long      up to 1e8 samples instead of 1e7
    python bench/observer.py --quick     up to 1e5 samples

Times are processor time, the best of several runs on one core. The textbook's loop is the observer's equations as
NumPy expressions, one sample after the other.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray
from observer_cases import Case, Estimates, arm_case, in_c, joined, linear_case, random_case, textbook

from monitor.estimation.affine import AffineObserver
from monitor.views.palette import BLUE, GREEN, VERMILION

ROOT = Path(__file__).parent.parent
STEPS, SAMPLES, REPEATS = 5_000, 100_000, 7
STATES = (4, 8, 12, 16, 24, 32, 40)
CHANNELS = (1, 2, 4, 8, 16, 32)
OBSERVERS = (1, 2, 4, 8, 16, 32, 64)
CHUNK = 100_000

TEXTBOOK, LIVE, BATCH, IN_C = "textbook loop", "batches of one", "one batch", "C, -O2"
COLOURS = {LIVE: BLUE, BATCH: GREEN}
MARKERS = {LIVE: "o", BATCH: "^"}

Run = Callable[[NDArray[np.float64], NDArray[np.float64]], Estimates | None]


def microseconds(run: Run, case: Case, count: int, repeats: int = REPEATS) -> float:
    """Return the processor time for each sample, the best of several runs over ``count`` of them."""
    u, y = case.u[:count], case.y[:count]
    run(u, y)
    best = np.inf
    for _ in range(repeats):
        started = time.process_time()
        run(u, y)
        best = min(best, time.process_time() - started)
    return float(best / len(u) * 1e6)


def live(case: Case) -> Run:
    """Return a run over the samples one by one."""
    observer = AffineObserver([case.gains])

    def run(u: NDArray[np.float64], y: NDArray[np.float64]) -> None:
        for k in range(len(u)):
            observer.run(u[k : k + 1], y[k : k + 1])

    return run


def batch(case: Case) -> Run:
    """Return a run over all samples at once."""
    observer = AffineObserver([case.gains])
    return lambda u, y: joined(observer.run(u, y, restart=np.arange(len(u)) == 0))


def differences(case: Case, run: Run) -> float:
    """Return the largest difference from the live observer, relative to the largest estimate of its kind."""
    u, y = case.u[:SAMPLES], case.y[:SAMPLES]
    found, expected = run(u, y), batch(case)(u, y)
    assert found is not None
    assert expected is not None
    return max(
        float(np.abs(ours - theirs).max() / np.abs(theirs).max()) for ours, theirs in zip(found, expected, strict=True)
    )


def ratios(case: Case, folder: Path) -> dict[str, Any]:
    """Return microseconds a sample of each way, and how far its estimates are from the live ones."""
    ways: dict[str, tuple[Run, int]] = {
        TEXTBOOK: (textbook(case), STEPS),
        LIVE: (live(case), STEPS),
        BATCH: (batch(case), SAMPLES),
    }
    compiled_c = in_c(case, folder)
    if compiled_c is not None:
        ways[IN_C] = compiled_c, SAMPLES
    return {
        name: {
            "us": microseconds(run, case, count),
            "difference": 0.0 if name == LIVE else differences(case, run),
        }
        for name, (run, count) in ways.items()
    }


def by_size(cases: Sequence[tuple[int, Case]]) -> list[dict[str, Any]]:
    """Return microseconds a sample of small and large batches, by size."""
    return [
        {
            "size": size,
            LIVE: microseconds(live(case), case, STEPS, 3),
            BATCH: microseconds(batch(case), case, SAMPLES, 3),
        }
        for size, case in cases
    ]


def by_length(case: Case, lengths: Sequence[int]) -> list[dict[str, Any]]:
    """Return seconds for recordings of several lengths, taken in chunks, and the most memory that was added (MB)."""
    rows = []
    run = batch(case)
    run(case.u[:100], case.y[:100])
    before = resident_mb()
    for length in lengths:
        added = 0.0
        started = time.process_time()
        for first in range(0, length, CHUNK):
            count = min(CHUNK, length - first)
            chunk = run(case.u[:count], case.y[:count])
            added = max(added, resident_mb() - before)
        rows.append({"size": length, BATCH: time.process_time() - started, "added_mb": added})
        del chunk
    return rows


def resident_mb() -> float:
    """Return the memory that this process holds at present (Linux; elsewhere zero)."""
    status = Path("/proc/self/statm")
    return int(status.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20 if status.exists() else 0.0


def by_observers() -> list[dict[str, Any]]:
    """Return microseconds of a sample of several observers of one vehicle, stacked and one by one."""
    rows = []
    for count in OBSERVERS:
        case = random_case(STEPS, 4, 4, 2)
        stack, alone = AffineObserver([case.gains] * count), [AffineObserver([case.gains]) for _ in range(count)]

        def stacked(u: NDArray[np.float64], y: NDArray[np.float64], stack: AffineObserver = stack) -> None:
            for k in range(len(u)):
                stack.run(u[k : k + 1], y[k : k + 1])

        def separate(u: NDArray[np.float64], y: NDArray[np.float64], alone: list[AffineObserver] = alone) -> None:
            for k in range(len(u)):
                for observer in alone:
                    observer.run(u[k : k + 1], y[k : k + 1])

        few = max(200, STEPS // count)
        rows.append(
            {
                "size": count,
                "stacked": microseconds(stacked, case, few, 3),
                "one by one": microseconds(separate, case, few, 3),
            }
        )
    return rows


def measure(lengths: Sequence[int]) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder:
        compared = {case.name: ratios(case, Path(folder)) for case in (arm_case(SAMPLES), linear_case(SAMPLES))}
    return {
        "ratios": compared,
        "states": by_size([(n, random_case(SAMPLES, n, 4, 4)) for n in STATES]),
        "channels": by_size([(k, random_case(SAMPLES, 12, k, k)) for k in CHANNELS]),
        "length": by_length(linear_case(CHUNK), lengths),
        "observers": by_observers(),
    }


def draw(found: dict[str, Any], path: Path) -> None:
    """Draw cost against scale."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt
    from matplotlib.ticker import LogLocator

    figure, axes = plt.subplots(2, 2, figsize=(11.0, 7.5), layout="constrained")
    panels = (
        ("states", "states n (4 outputs, 4 faults)", "time per sample (µs)", (LIVE, BATCH)),
        ("channels", "outputs, and as many faults (12 states)", "time per sample (µs)", (LIVE, BATCH)),
        ("length", "samples (12 states, 10 faults, streamed)", "processor time (s)", (BATCH,)),
        ("observers", "observers of one vehicle (4 states each)", "time per sample of all (µs)", ()),
    )
    for axis, (key, across, up, names) in zip(axes.flat, panels, strict=True):
        rows = found[key]
        sizes = [row["size"] for row in rows]
        for name in names:
            axis.loglog(
                sizes, [row[name] for row in rows], color=COLOURS[name], marker=MARKERS[name], label=name, lw=1.6
            )
        if key == "observers":
            for name, label, colour, marker in (
                ("stacked", "stacked, as the monitor does", BLUE, "o"),
                ("one by one", "one by one", VERMILION, "D"),
            ):
                axis.loglog(sizes, [row[name] for row in rows], color=colour, marker=marker, label=label, lw=1.6)
        if key != "length":
            axis.set_xticks(sizes, [f"{size:g}" for size in sizes])
            axis.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axis.yaxis.set_major_formatter("{x:g}")
            axis.minorticks_off()
        axis.set(xlabel=across, ylabel=up)
        axis.grid(alpha=0.3)
        axis.spines[["top", "right"]].set_visible(False)
        axis.legend(frameon=False, loc="upper left", bbox_to_anchor=(0.0, 0.7) if LIVE in names else None)
    figure.suptitle("What the observer costs (one core)")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def page(found: dict[str, Any]) -> str:
    """Return the measurements as Markdown."""
    lines = [INTRODUCTION]
    for name, ways in found["ratios"].items():
        base, in_c_us = ways[TEXTBOOK]["us"], ways.get(IN_C, {}).get("us")
        lines += [f"### {name}", "", HEADER]
        for way, row in ways.items():
            to_c = f"{row['us'] / in_c_us:.2f}" if in_c_us else "no C compiler"
            difference = "" if way == LIVE else f"{row['difference']:.1e}"
            lines.append(f"| {way} | {row['us']:.2f} | {base / row['us']:.1f} | {to_c} | {difference} |")
        lines.append("")
    lines += ["## Cost against scale", "", "![Cost against scale](images/observer-cost.png)", ""]
    for key, title in (("states", "states"), ("channels", "outputs and faults")):
        lines += [f"| {title} | batches of one, us | one batch, us |", "|---|---|---|"]
        lines += [f"| {row['size']} | {row[LIVE]:.2f} | {row[BATCH]:.2f} |" for row in found[key]] + [""]
    lines += ["| samples | s | memory added, MB |", "|---|---|---|"]
    lines += [f"| {row['size']:.0e} | {row[BATCH]:.3g} | {row['added_mb']:.0f} |" for row in found["length"]]
    lines += ["", "| observers of one vehicle | stacked, us | one by one, us |", "|---|---|---|"]
    lines += [f"| {row['size']} | {row['stacked']:.1f} | {row['one by one']:.1f} |" for row in found["observers"]]
    return "\n".join([*lines, ""])


HEADER = """| way | us a sample | times the textbook's speed | times C's time | largest difference |
|---|---|---|---|---|"""

INTRODUCTION = """# What the observer costs

    python bench/observer.py --long --write

makes this page: processor time on one core, the best of several runs. "Largest difference" is that of any estimate
from ours over 100 000 samples, relative to the largest of its kind. C is the same recursion in `bench/recursion.c`, the
textbook's loop the observer's equations as NumPy expressions.

## Side by side
"""


def main() -> None:
    parser = argparse.ArgumentParser(description="Measure the observer.")
    parser.add_argument("--json", action="store_true", help="print JSON instead of Markdown")
    parser.add_argument("--write", action="store_true", help="write docs/observer-cost.md and its figure")
    parser.add_argument("--long", action="store_true", help="up to 1e8 samples")
    parser.add_argument("--quick", action="store_true", help="up to 1e5 samples")
    arguments = parser.parse_args()
    found = measure([10**k for k in range(3, 9 if arguments.long else 6 if arguments.quick else 8)])
    if arguments.write:
        draw(found, ROOT / "docs/images/observer-cost.png")
        (ROOT / "docs/observer-cost.md").write_text(page(found), encoding="utf-8")
    sys.stdout.write(json.dumps(found, indent=1) + "\n" if arguments.json else page(found))


if __name__ == "__main__":
    main()
