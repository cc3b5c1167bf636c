"""What an alarm event waits for the disk: commits of the journal, of one event and of many at once (group commit).

    python bench/commit.py [FOLDER]

FOLDER is on the disk to be measured (default: this one). Beside it what fsync costs alone there, and a journal that
would not wait (``synchronous = NORMAL``).
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Callable
from itertools import count
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from loopback import event

from monitor.recording.journal import Journal

_FRAME = {"y": [0.123456789] * 300}
"""A freeze frame of 4 kB, as a copter's with two observers."""
_PAUSE_S = 0.002


def timed(name: str, work: Callable[[], object], times: int) -> None:
    """Print how long a piece of work takes."""
    taken = []
    for _ in range(times):
        begin = time.perf_counter()
        work()
        taken.append(1e3 * (time.perf_counter() - begin))
        time.sleep(_PAUSE_S)
    p50, p99, most = np.quantile(taken, [0.5, 0.99, 1.0])
    print(f"{name}: p50 {p50:.2f} ms, p99 {p99:.2f} ms, most {most:.2f} ms")


def main(folder: str = ".") -> None:
    numbers = count(1)
    with tempfile.TemporaryDirectory(dir=folder) as made:
        journal = Journal(Path(made) / "journal.db")

        def commit(events: int) -> None:
            journal.write_all([(event(next(numbers)), _FRAME) for _ in range(events)])

        for events, times in ((1, 300), (16, 60), (64, 30)):
            timed(f"{events} at once", lambda events=events: commit(events), times)
        with (Path(made) / "plain").open("wb", buffering=0) as plain:

            def sync() -> None:
                plain.write(bytes(4096))
                os.fsync(plain.fileno())

            timed("fsync of 4 kB alone", sync, 300)
        assert journal._connection is not None
        journal._connection.execute("PRAGMA synchronous = NORMAL")
        timed("1, without waiting for the disk", lambda: commit(1), 300)
        journal.close()


if __name__ == "__main__":
    main(*sys.argv[1:])
