"""Time that `fauio info`, `convert` and `replay` take for a long log of PX4, in multiples of pyulog reading it.

A flight is repeated, each time later by its length and with other last bits of its floats (with the same it would be a
recording that is sent again, of which fauio warns), until the log has the size asked for. Each figure is the processor
time of a process of its own, from its start to its end, imports included; the least of some runs. Run it with

    python bench/onboard_logs.py [FLIGHT.ulg] [--mb 100] [--runs 2] [--profile FOLDER]

Without a flight, one is made of the telemetry that the tests have.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import os
import struct
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from long_log import PAUSE_US, shaken
from onboard_flights import ulog_of

import fauio
from adapters.logs.compressed import CompressedFile
from adapters.logs.recordings import read_recording
from adapters.logs.ulog import UlogField, compile_type, parse_format

FLIGHT = Path(__file__).parents[1] / "tests" / "data" / "copter_healthy_square.tlog.xz"
QUAD = Path(fauio.__file__).parent / "replay" / "data" / "quad"
_HEAD = struct.Struct("<HB")
_FILE_HEAD_BYTES = 16


def repeated(flight: bytes, size: int) -> Iterator[bytes]:
    """Yield a log of about so many bytes: the flight, and its topics' records again and again, each time later."""
    formats: dict[str, tuple[UlogField, ...]] = {}
    stamped: dict[int, bool] = {}
    # positions of the floats in the records of a topic, and among all records' bytes
    floats: dict[int, NDArray[np.int64]] = {}
    floats_at: list[NDArray[np.int64]] = []
    records: list[bytes] = []
    total = 0
    at = _FILE_HEAD_BYTES
    while at + _HEAD.size <= len(flight):
        count, kind = _HEAD.unpack_from(flight, at)
        body = flight[at + _HEAD.size : at + _HEAD.size + count]
        if kind == ord("F"):
            name, fields = parse_format(body)
            formats[name] = fields
        elif kind == ord("A"):
            name, number = body[3:].decode(), struct.unpack_from("<H", body, 1)[0]
            stamped[number] = formats[name][0] == UlogField("timestamp", "uint64_t", None)
            floats[number] = _HEAD.size + 2 + np.array(_floats(compile_type(name, formats).layout.dtype, 0), np.int64)
        elif kind == ord("D") and stamped[number := struct.unpack_from("<H", body)[0]]:
            records.append(flight[at : at + _HEAD.size + count])
            floats_at.append(total + floats[number])
            total += len(records[-1])
        at += _HEAD.size + count
    ends = np.cumsum([len(record) for record in records])
    places = np.concatenate([[0], ends[:-1]]) + _HEAD.size + 2
    data = np.frombuffer(b"".join(records), np.uint8).copy()
    eight = places[:, None] + np.arange(8)
    four = np.concatenate(floats_at)[:, None] + np.arange(4)
    times_us = data[eight].view("<u8").ravel()
    # stamps of other clocks and damaged ones are left as they are
    middle = np.median(times_us)
    good = np.abs(times_us.astype(np.float64) - middle) < 1e10
    period_us = int(times_us[good].max() - times_us[good].min()) + PAUSE_US
    yield flight
    total, later = len(flight), 0
    while total < size:
        later += period_us
        copy = data.copy()
        copy[four] = shaken(data[four].view(np.uint32), later).view(np.uint8)
        copy[eight[good]] = (times_us[good] + np.uint64(later)).view(np.uint8).reshape(-1, 8)
        yield copy.tobytes()
        total += len(copy)


def write(flight: Path, size: int, log: Path) -> None:
    """Write a log of about so many bytes."""
    with log.open("wb") as file:
        file.writelines(repeated(b"".join(CompressedFile(flight)), size))


def _floats(kind: np.dtype[Any], at: int) -> list[int]:
    """Return the positions of the floats in a field that begins at a position."""
    if kind.subdtype is not None:
        one, shape = kind.subdtype
        return [place for number in range(math.prod(shape)) for place in _floats(one, at + number * one.itemsize)]
    if kind.fields is not None:
        return [place for one, offset, *_ in kind.fields.values() for place in _floats(one, at + offset)]
    return [at] if kind == np.float32 else []


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
            flight = ulog_of(read_recording(FLIGHT), Path(folder) / "flight.ulg", motors=True)
        # in a process of its own: what this one holds would count as memory of those that it starts
        writing = multiprocessing.Process(target=write, args=(flight, round(args.mb * 1e6), log))
        writing.start()
        writing.join()
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
