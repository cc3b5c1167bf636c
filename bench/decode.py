"""Messages per second out of a telemetry log: pymavlink, ours as messages, and in batches of columns.

    python bench/decode.py [LOG] [--repeat N] [--json]

All on the same file, decompressed, in one run. That they read the same messages with the same fields is checked first,
for every message. Processor time, the best of N; "wanted" counts all messages of the log, of which a motor profile's
ones are decoded.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("MAVLINK20", "1")
os.environ.setdefault("MAVLINK_DIALECT", "ardupilotmega")

from pymavlink import mavutil

from adapters.batch import messages
from adapters.logs.compressed import CompressedFile
from adapters.logs.recordings import read_batches, read_recording

LOG = Path(__file__).parent.parent / "replay" / "data" / "copter_motor1.tlog.xz"
WANTED = frozenset({"HEARTBEAT", "ATTITUDE", "SERVO_OUTPUT_RAW", "HIGHRES_IMU", "LOCAL_POSITION_NED"})
# What pymavlink makes of bytes that are no packet, and of packets that it does not know.
_NO_MESSAGE = ("BAD_DATA", "UNKNOWN")


def by_pymavlink(path: Path) -> Iterator[Any]:
    """Yield what ``recv_msg`` returns, to the end of the log."""
    log = mavutil.mavlink_connection(str(path))
    while (message := log.recv_msg()) is not None:
        yield message
    log.close()


def agree(path: Path) -> int:
    """Return the number of messages if all three read the same ones.

    Raises
    ------
    AssertionError
        They differ.
    """
    theirs = (one for one in by_pymavlink(path) if not one.get_type().startswith(_NO_MESSAGE))
    batched = (message for batch in read_batches(path) for message in messages(batch))
    count = 0
    for their, our, packed in zip(theirs, read_recording(path), batched, strict=True):
        count += 1
        assert repr(our) == repr(packed)
        fields = their.to_dict()
        assert fields.pop("mavpackettype") == packed.name
        assert repr(fields) == repr(dict(packed.fields))
        assert (their.get_srcSystem(), their.get_srcComponent()) == (packed.system, packed.component)
        assert round(their._timestamp * 1e6) == packed.received_ns // 1000
    return count


def seconds(read: Callable[[Path], Iterator[Any]], path: Path, repeat: int) -> float:
    """Return the least processor time in which a log is read to its end."""
    best = float("inf")
    for _ in range(repeat):
        start = time.process_time()
        for _ in read(path):
            pass
        best = min(best, time.process_time() - start)
    return best


def main() -> None:
    """Print a table, or JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("log", type=Path, nargs="?", default=LOG)
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    readers: dict[str, Callable[[Path], Iterator[Any]]] = {
        "pymavlink recv_msg": by_pymavlink,
        "as messages": read_recording,
        "batches": read_batches,
        "batches, wanted": lambda path: read_batches(path, WANTED),
    }
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "flight.tlog"
        path.write_bytes(b"".join(CompressedFile(arguments.log)))
        count = agree(path)
        rate = {name: count / seconds(read, path, arguments.repeat) for name, read in readers.items()}
    base = rate["pymavlink recv_msg"]
    if arguments.json:
        found = {name: {"messages_per_s": round(one), "ratio": round(one / base, 2)} for name, one in rate.items()}
        print(json.dumps({"log": arguments.log.name, "messages": count, "readers": found}, indent=2))
        return
    print(f"{arguments.log.name}: {count:,} messages, the same in all readers\n")
    print("| reader | messages/s | times pymavlink |\n|---|---|---|")
    for name, one in rate.items():
        print(f"| {name} | {one:,.0f} | {one / base:.1f} |")


if __name__ == "__main__":
    main()
