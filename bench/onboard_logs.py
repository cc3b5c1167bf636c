"""Time that `fauio info`, `convert` and `replay` take for a long log of PX4, in multiples of pyulog reading it.

A flight is repeated, each time later by its length, until the log has the size asked for. Each figure is the processor
time of a process of its own, from its start to its end, imports included; the least of some runs. Run it with

    python bench/onboard_logs.py [FLIGHT.ulg] [--mb 100] [--runs 2] [--profile FOLDER]

Without a flight, one is made of the telemetry that the tests have.
"""

from __future__ import annotations

import argparse
import json
import os
import struct
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from onboard_flights import ulog_of

import fauio
from adapters.logs.compressed import CompressedFile
from adapters.logs.recordings import read_recording
from adapters.logs.ulog import parse_format

DATA = Path(__file__).parents[1] / "tests" / "data"
QUAD = Path(fauio.__file__).parent / "replay" / "data" / "quad"
_HEAD = struct.Struct("<HB")
_FILE_HEAD_BYTES = 16
_STAMP = "timestamp"
_PAUSE_US = 10_000


def repeated(flight: bytes, size: int) -> Iterator[bytes]:
    """Yield a log of about so many bytes: the flight, and its topics' records again and again, each time later."""
    formats: dict[str, bool] = {}
    stamped: dict[int, bool] = {}
    records: list[bytes] = []
    at = _FILE_HEAD_BYTES
    while at + _HEAD.size <= len(flight):
        count, kind = _HEAD.unpack_from(flight, at)
        body = flight[at + _HEAD.size : at + _HEAD.size + count]
        if kind == ord("F"):
            name, fields = parse_format(body)
            formats[name] = fields[0].name == _STAMP and fields[0].kind == "uint64_t"
        elif kind == ord("A"):
            stamped[struct.unpack_from("<H", body, 1)[0]] = formats[body[3:].decode()]
        elif kind == ord("D") and stamped[struct.unpack_from("<H", body)[0]]:
            records.append(flight[at : at + _HEAD.size + count])
        at += _HEAD.size + count
    ends = np.cumsum([len(record) for record in records])
    places = np.concatenate([[0], ends[:-1]]) + _HEAD.size + 2
    data = np.frombuffer(b"".join(records), np.uint8).copy()
    eight = places[:, None] + np.arange(8)
    times_us = data[eight].view("<u8").ravel()
    # stamps of other clocks and damaged ones are left as they are
    middle = np.median(times_us)
    good = np.abs(times_us.astype(np.float64) - middle) < 1e10
    period_us = int(times_us[good].max() - times_us[good].min()) + _PAUSE_US
    yield flight
    total, later = len(flight), 0
    while total < size:
        later += period_us
        copy = data.copy()
        copy[eight[good]] = (times_us[good] + np.uint64(later)).view(np.uint8).reshape(-1, 8)
        yield copy.tobytes()
        total += len(copy)


def processor_s(command: list[str], runs: int) -> tuple[float, float]:
    """Return the least processor time of a command, and the most memory it had, in MB."""
    best, memory = float("inf"), 0.0
    for _ in range(runs):
        with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:  # noqa: S603 - ours
            _, status, usage = os.wait4(process.pid, 0)
            process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            raise SystemExit(f"{' '.join(command)}: exit status {process.returncode}")
        best = min(best, usage.ru_utime + usage.ru_stime)
        memory = max(memory, usage.ru_maxrss / 1024)
    return best, memory


def main() -> None:
    """Print the figures as one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("flight", type=Path, nargs="?")
    parser.add_argument("--mb", type=float, default=100.0)
    parser.add_argument("--runs", type=int, default=2)
    parser.add_argument("--profile", type=Path, default=QUAD)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        log, out = Path(folder) / "long.ulg", Path(folder) / "long.mcap"
        flight = args.flight
        if flight is None:
            flight = ulog_of(read_recording(DATA / "copter_5s.tlog.xz"), Path(folder) / "flight.ulg", motors=True)
        with log.open("wb") as file:
            file.writelines(repeated(b"".join(CompressedFile(flight)), round(args.mb * 1e6)))
        python, command = sys.executable, [sys.executable, "-m", "fauio"]
        commands = {
            "pyulog": [python, "-c", "import sys; from pyulog import ULog; ULog(sys.argv[1])", str(log)],
            "info": [*command, "info", str(log)],
            "convert": [*command, "convert", str(log), "-o", str(out)],
            # the log is in the format of another autopilot than the one that flew
            "replay": [*command, "replay", "--force", str(args.profile), str(log)],
        }
        found: dict[str, float] = {"mb": round(log.stat().st_size / 1e6, 1)}
        for name, one in commands.items():
            spent, memory = processor_s(one, args.runs)
            found |= {
                f"{name}_s": round(spent, 2),
                f"{name}_times_pyulog": round(spent / found.get("pyulog_s", spent), 2),
            }
            found[f"{name}_memory_mb"] = round(memory)
        sys.stdout.write(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
