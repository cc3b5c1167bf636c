"""Feeds every parser of outside bytes with what a coverage-guided fuzzer (atheris) thinks up.

    python bench/fuzz.py --list
    python bench/fuzz.py TARGET --minutes 10 [--seed N]
    python bench/fuzz.py --all --minutes 10 --jobs 2

    python bench/fuzz.py TARGET --growth        the last step alone, on inputs found before

Each target runs in a process of its own. What counts as a finding: an exception that is not the target's documented
one, an input that takes longer than a second of processor time (more for models and whole flights), memory that grows.
The minutes are those of a processor: what else the machine does costs no coverage. Growth is looked for afterwards, in
a process without the fuzzer, which keeps results of its own of many comparisons: the inputs it found, half of them
changed at random, again and again for a tenth of the time.
Inputs that were findings, and the slowest one, stay in the folder of the target (`--out`, default fuzz-out). Needs
atheris: `pip install -e .[fuzz]`.
"""

from __future__ import annotations

import argparse
import gc
import hashlib
import json
import os
import random
import resource
import shutil
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent
# Of the clock on the wall: a machine with other work takes many times as long.
HANG_S = 300
# Both after a fifth of the time, when caches are full.
GROWN_BYTES = 16 << 20
GROWN_BLOCKS = 20_000
GROWTH_SHARE = 0.1
MOST_FINDINGS = 40
# Beyond what is mapped at the start: an allocation that a few bytes ask for fails instead of being reserved unseen.
# What the fuzzer keeps of its own came to 2 GB within ten minutes of targets that make many classes.
ADDRESS_SPACE = 8 << 30
HEADINGS = ("target", "minutes of a processor (on the clock)", "executions", "slowest input", "growth", "findings")


class Watch:
    """Runs one target on input after input, and keeps what is to be reported."""

    def __init__(self, run: Any, seconds: float, folder: Path, slow_s: float) -> None:
        self._run = run
        self._folder = folder
        self._seconds = seconds
        self._slow_s = slow_s
        self._start = time.monotonic()
        self._used = time.process_time()
        self._told = 0.0
        self._executions = 0
        self._slowest = (0.0, b"")
        self._findings: dict[str, str] = {}

    def __call__(self, data: bytes) -> None:
        """Run the target on one input."""
        self._executions += 1
        before = time.process_time()
        try:
            self._run(data)
        except Exception as error:
            self._note(_where(error), data)
        used = time.process_time() - before
        if used > self._slowest[0]:
            self._slowest = used, data
            if used > self._slow_s:
                self._note(f"slow: {used:.1f} s of processor time", data)
        now = time.process_time() - self._used
        if now - self._told < 1.0:
            return
        self._told = now
        if now > self._seconds:
            self.finish()

    def finish(self) -> None:
        """Write the report and end the process: the fuzzer itself never returns."""
        (self._folder / "slowest").write_bytes(self._slowest[1])
        report = {
            "minutes": (time.monotonic() - self._start) / 60,
            "processor_minutes": (time.process_time() - self._used) / 60,
            "executions": self._executions,
            "slowest_ms": self._slowest[0] * 1e3,
            "slowest_bytes": len(self._slowest[1]),
            "findings": self._findings,
        }
        (self._folder / "report.json").write_text(json.dumps(report, indent=1))
        sys.stderr.flush()
        os._exit(1 if self._findings else 0)

    def _note(self, what: str, data: bytes) -> None:
        kind = what.partition(":")[0] if what.startswith("slow") else what
        if kind in self._findings:
            return
        name = f"finding-{hashlib.sha256(data).hexdigest()[:12]}"
        (self._folder / name).write_bytes(data)
        self._findings[kind] = name
        (self._folder / f"{name}.txt").write_text(f"{what}\n{traceback.format_exc()}")
        print(f"finding: {what} ({self._folder / name})", file=sys.stderr, flush=True)
        if len(self._findings) >= MOST_FINDINGS:
            self.finish()


def _where(error: Exception) -> str:
    """Return what was raised and where: the same place is the same finding."""
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if "/bench/" not in frame.filename]
    at = f"{Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else "the target's own check"
    return f"{type(error).__name__} at {at}"


def _memory() -> tuple[int, int]:
    """Return resident memory in bytes and the number of Python's memory blocks."""
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize(), sys.getallocatedblocks()


def work(name: str, seconds: float, seed: int, folder: Path) -> None:
    """Fuzz one target in this process; does not return."""
    import atheris

    with atheris.instrument_imports(include=["adapters", "gains", "monitor", "replay"]):
        from fuzz_targets import TARGETS

    target = TARGETS[name]
    corpus, scratch = folder / "corpus", folder / "scratch"
    shutil.rmtree(scratch, ignore_errors=True)
    for one in (corpus, scratch):
        one.mkdir(parents=True, exist_ok=True)
    for data in target.seeds():
        (corpus / hashlib.sha256(data).hexdigest()[:16]).write_bytes(data[: target.largest])
    watch = Watch(target.make(scratch), seconds, folder, target.slow_s)
    mapped = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (mapped + ADDRESS_SPACE, resource.RLIM_INFINITY))
    options = [f"-max_len={target.largest}", f"-seed={seed}", f"-timeout={HANG_S}", "-rss_limit_mb=0", "-verbosity=0"]
    atheris.Setup(["fuzz", *options, f"-artifact_prefix={folder}/", str(corpus)], watch)
    atheris.Fuzz()


def growth(name: str, seconds: float, seed: int, folder: Path) -> dict[str, Any]:
    """Feed what the fuzzer found, and what is like it, without the fuzzer; return by how much memory grew."""
    from fuzz_targets import TARGETS

    target, draw = TARGETS[name], random.Random(seed)  # noqa: S311 - inputs, not secrets
    found = [path.read_bytes() for path in sorted((folder / "corpus").iterdir())] or [b""]
    scratch = Path(tempfile.mkdtemp(dir=folder))
    run, start, executions = target.make(scratch), time.process_time(), 0
    warm: tuple[int, int] | None = None
    while (used := time.process_time() - start) < seconds:
        if warm is None and used > seconds / 5:
            warm = _memory()
        data = bytearray(draw.choice(found))
        for _ in range(draw.choice((0, 0, 0, 1, 2, 8)) if data else 0):
            data[draw.randrange(len(data))] = draw.randrange(256)
        run(bytes(data))
        executions += 1
    end = _memory()
    grown = [after - before for after, before in zip(end, warm or end, strict=True)]
    return {"grown_bytes": grown[0], "grown_blocks": grown[1], "again": executions}


def run(name: str, minutes: float, seed: int, out: Path, *, fuzz: bool = True) -> dict[str, Any]:
    """Fuzz one target in a process of its own, then look for growth in another; return the report."""
    folder = out / name
    folder.mkdir(parents=True, exist_ok=True)
    report = folder / "report.json"
    found: dict[str, Any] = json.loads(report.read_text()) if not fuzz and report.is_file() else {}
    if fuzz:
        report.unlink(missing_ok=True)
        problem = _worker(name, minutes, seed, out, "--worker")
        if not report.is_file():
            return {"findings": {problem: "log.txt"}}
        found = json.loads(report.read_text())
    grown = folder / "growth.json"
    grown.unlink(missing_ok=True)
    problem = _worker(name, minutes * GROWTH_SHARE, seed, out, "--growth-worker")
    if not grown.is_file():
        return found | {"findings": found.get("findings", {}) | {problem: "log.txt"}}
    found |= json.loads(grown.read_text())
    if found["grown_bytes"] > GROWN_BYTES or found["grown_blocks"] > GROWN_BLOCKS:
        found["findings"][f"growth: {found['grown_bytes'] / 1e6:.0f} MB, {found['grown_blocks']} blocks"] = "corpus"
    return found


def _worker(name: str, minutes: float, seed: int, out: Path, kind: str) -> str:
    """Run this file as a worker; return how it ended."""
    command = [sys.executable, str(Path(__file__)), name, "--minutes", str(minutes), "--seed", str(seed)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    path = out / name / ("log.txt" if kind == "--worker" else "growth.txt")
    with path.open("w") as log:
        code = subprocess.run(  # noqa: S603 - our own command
            [*command, "--out", str(out), kind], stdout=log, stderr=log, env=environment, check=False
        ).returncode
    tail = path.read_text(errors="replace").strip().splitlines()[-1:]
    return f"ended with status {code}: {' '.join(tail)}"


def row(name: str, report: dict[str, Any]) -> str:
    """Return one line of the table."""
    if "minutes" not in report or "grown_bytes" not in report:
        return f"| {name} | | | | | {'; '.join(report['findings'])} |"
    return (
        f"| {name} | {report['processor_minutes']:.1f} ({report['minutes']:.1f}) | {report['executions']:,} "
        f"| {report['slowest_ms']:.0f} ms ({report['slowest_bytes']:,} bytes) "
        f"| {report['grown_bytes'] / 1e6:+.1f} MB, {report['grown_blocks']:+,} blocks "
        f"| {'; '.join(report['findings']) or 'none'} |"
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Run from the command line; return 1 where anything was found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("targets", nargs="*", metavar="TARGET")
    parser.add_argument("--all", action="store_true", help="every target")
    parser.add_argument("--list", action="store_true", help="name the targets and end")
    parser.add_argument("--minutes", type=float, default=10.0, help="of a processor, for each target (default 10)")
    parser.add_argument("--jobs", type=int, default=1, help="targets at the same time (default 1)")
    parser.add_argument("--seed", type=int, default=1, help="of the fuzzer's random numbers (default 1)")
    parser.add_argument("--out", type=Path, default=Path("fuzz-out"), help="where inputs and logs are kept")
    parser.add_argument("--growth", action="store_true", help="do not fuzz: look for growth on inputs found before")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--growth-worker", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args(argv)
    if args.worker:
        work(args.targets[0], args.minutes * 60, args.seed, args.out / args.targets[0])
    if args.growth_worker:
        folder = args.out / args.targets[0]
        (folder / "growth.json").write_text(json.dumps(growth(args.targets[0], args.minutes * 60, args.seed, folder)))
        return 0
    from fuzz_targets import TARGETS

    if args.list:
        for name, target in TARGETS.items():
            print(f"{name:18s} {target.what}")
        return 0
    names = list(TARGETS) if args.all else args.targets
    unknown = [name for name in names if name not in TARGETS]
    if unknown or not names:
        parser.error(f"no target '{unknown[0]}'; see --list" if unknown else "name a target, or --all")
    print("| " + " | ".join(HEADINGS) + " |\n" + "|---" * len(HEADINGS) + "|", flush=True)
    clean = True
    with ThreadPoolExecutor(args.jobs) as pool:
        jobs = {
            name: pool.submit(run, name, args.minutes, args.seed, args.out.absolute(), fuzz=not args.growth)
            for name in names
        }
        for name, job in jobs.items():
            report = job.result()
            clean = clean and not report["findings"]
            print(row(name, report), flush=True)
    return 0 if clean else 1


if __name__ == "__main__":
    sys.exit(main())
