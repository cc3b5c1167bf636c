"""Work that waits for a disk, in its own threads: a disk that hangs costs recordings, not monitoring."""

import functools
import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from adapters.batch import Batch, memory_bytes
from monitor.estimate import Estimates
from monitor.event import AlarmEvent
from monitor.recording.archive import Archive, ArchiveStatistics
from monitor.recording.journal import MAX_PENDING, Journal, JournalStatistics

HELD_BYTES = 1 << 26
"""Memory of all vehicles' messages and samples that wait for recordings. Chosen: 64 MB hold two minutes of a vehicle
with 1,000 a second and 10 s of sixteen, so that pauses of an SD card (seconds) cost nothing."""
_SAMPLE_BYTES = 500
"""Memory of a sample with its estimate: some 60 numbers of two observers."""
_JOBS = 50_000
"""Most waiting jobs without rows: alarm events and flushes."""
_CLIP_RECORDS = 300
"""Records of clips written in one turn, ten times a second: they take about 10 ms and are three times what a vehicle
sends."""
_STALLED_S = 1.0
"""A job that takes this long has a disk that hangs: a thousand times the usual time."""
_BUSY = 0.01
"""If a job uses at least this share of its time as processor time, it is slow because of the processor and not of the
disk. Chosen: the writer of sixteen vehicles gets several times as much of a seventh of a core, and a thread that
hangs uses none."""
FINISH_S = 8.0
"""Time for the jobs that still wait at the end. Chosen: the systemd unit allows 20 s for stopping, and there are two
threads to wait for."""


class Turn:
    """Lets one of several threads write at a time: many at once would take too much time from the monitoring thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        # start of the current job, monotonic; the processor-time clock of its thread, and its value then
        self._begun: tuple[float, int, float] | None = None

    @property
    def stalled_s(self) -> float:
        """Seconds for which the current job has been waiting for the disk, 0 below a second."""
        if (begun := self._begun) is None:
            return 0.0
        begun_s, clock, used_s = begun
        stalled_s = time.monotonic() - begun_s
        is_busy = time.clock_gettime(clock) - used_s > _BUSY * stalled_s
        return stalled_s if stalled_s >= _STALLED_S and not is_busy else 0.0

    def do(self, job: Callable[[], object]) -> None:
        """Run a job when this thread has its turn."""
        with self._lock:
            clock = time.pthread_getcpuclockid(threading.get_ident())
            self._begun = time.monotonic(), clock, time.clock_gettime(clock)
            try:
                job()
            finally:
                self._begun = None


_RECORDINGS = Turn()


class DiskThread:
    """Runs jobs one after the other in a thread; refuses a job when too many wait.

    Jobs with a size do not wake the thread, since waking takes as long as some of them: they wait for the next job
    without a size, or until half of the room is taken. Threads that share a ``turn`` run their jobs one at a time.
    ``stalled_s`` is how long the current job has been waiting for the disk, 0 if not for long.
    """

    def __init__(self, name: str, limit: int, turn: Turn | None = None) -> None:
        self._jobs: deque[tuple[Callable[[], object], int]] = deque()
        self._limit = limit
        self._waiting = 0
        self._given = self._done = 0
        self._turn = turn or Turn()
        self._in_vain = False
        self._closing = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def put(self, job: Callable[[], object], size: int = 0) -> bool:
        """Queue a job; return whether there was room for it."""
        with self._changed:
            if (size and self._waiting + size > self._limit) or len(self._jobs) >= _JOBS or self._closing:
                return False
            self._jobs.append((job, size))
            self._waiting += size
            self._given += 1
            if not size or 2 * self._waiting > self._limit:
                self._changed.notify_all()
            return True

    def wait(self, timeout_s: float) -> bool:
        """Wait until all queued jobs are done; return whether they are.

        After it timed out once, the next call waits only when the thread has caught up.
        """
        with self._changed:
            given = self._given
            self._changed.notify_all()
            if self._in_vain:
                return self._done >= given
            done = self._changed.wait_for(lambda: self._done >= given, max(timeout_s, 0.0))
            self._in_vain = not done
            return done

    @property
    def stalled_s(self) -> float:
        """Seconds for which the disk has kept its jobs waiting, 0 below a second."""
        return self._turn.stalled_s if self._given > self._done else 0.0

    def close(self, timeout_s: float) -> bool:
        """Run the waiting jobs, for this long at most, and end; return whether all were done."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._jobs or self._closing)
                if not self._jobs:
                    return
                job, size = self._jobs.popleft()
            try:
                self._turn.do(job)
            except Exception:
                # Whatever the disk does to this job, the next one is run.
                logging.getLogger(__name__).exception("%s failed", self._thread.name)
            with self._changed:
                self._waiting -= size
                self._done += 1
                if not self._jobs:
                    self._in_vain = False
                self._changed.notify_all()


class BackgroundArchive:
    """An archive written in a thread, one of ``sharers``; records without room are lost and counted."""

    def __init__(self, archive: Archive, vehicle: str, sharers: int = 1) -> None:
        self._archive = archive
        self._thread = DiskThread(f"recording of {vehicle}", HELD_BYTES // sharers, _RECORDINGS)
        self._lost = 0

    def batch(self, batch: Batch) -> None:
        """Record telemetry as received."""
        self._put(functools.partial(self._archive.batch, batch), batch.count, memory_bytes(batch))

    def estimates(self, estimates: Estimates) -> None:
        """Record estimates and the samples they were computed from."""
        rows = len(estimates)
        self._put(functools.partial(self._archive.estimates, estimates), rows, rows * _SAMPLE_BYTES)

    def event(self, event: AlarmEvent) -> None:
        """Record an alarm event after everything that came before it; a raised alarm begins a clip of the black box."""
        self._put(functools.partial(self._archive.event, event), 1, 0)

    def flush(self) -> None:
        """Flush the recording, or try a disk again that refused; call it on a timer."""
        self._thread.put(self._archive.flush)

    def work(self, now_ns: int) -> None:
        """Write some of the open clips; call it on a timer."""
        if self._archive.has_clips:
            self._thread.put(functools.partial(self._archive.work, _CLIP_RECORDS, now_ns))

    def wait(self, timeout_s: float) -> bool:
        """Wait until all is written; return whether it is."""
        return self._thread.wait(timeout_s)

    def close(self, metadata: Mapping[str, str]) -> None:
        """Finish the recording and the open clips with more metadata, as far as the disk does so in time."""
        self._thread.put(functools.partial(self._archive.add_metadata, metadata))
        self._thread.put(self._archive.close)
        if not self._thread.close(FINISH_S):
            logging.getLogger(__name__).error("a recording is not finished: the disk does not answer")

    def statistics(self) -> ArchiveStatistics:
        """Return the counts so far, and the trouble with the disk."""
        counts = self._archive.statistics()
        trouble = counts.trouble
        if stalled_s := self._thread.stalled_s:
            trouble = f"recording waits for a disk that has not answered for {stalled_s:.0f} s"
        return replace(counts, lost=counts.lost + self._lost, trouble=trouble)

    def _put(self, job: Callable[[], object], rows: int, size: int) -> None:
        if not self._thread.put(job, size):
            self._lost += rows


class BackgroundJournal:
    """A journal written in a thread, all waiting events in one transaction (group commit)."""

    def __init__(self, journal: Journal) -> None:
        self._journal = journal
        self._thread = DiskThread("journal", MAX_PENDING)
        self._lock = threading.Lock()
        self._waiting: list[tuple[AlarmEvent, Mapping[str, Any] | None]] = []
        self._dropped = 0
        self._counts = journal.statistics()
        # read without access to the disk
        self.active, self.shelved, self.last_seq = journal.active, journal.shelved, journal.last_seq
        self.events = journal.events

    def write(self, event: AlarmEvent, frame: Mapping[str, Any] | None = None) -> None:
        """Have an event committed, once however often it is given."""
        with self._lock:
            if len(self._waiting) >= MAX_PENDING:
                del self._waiting[0]
                self._dropped += 1
            self._waiting.append((event, frame))
            first = len(self._waiting) == 1
        if first:
            self._thread.put(self._write)

    def shelve(self, vehicle: str, channels: Mapping[str, int]) -> None:
        """Have the stored shelved channels replaced."""
        self._thread.put(functools.partial(self._journal.shelve, vehicle, dict(channels)))

    def retry(self) -> None:
        """Have the events written that the disk refused; call it once a second."""
        self._thread.put(self._retry)

    def wait(self, timeout_s: float) -> bool:
        """Wait until all events are on the disk, or the time is over; return whether waiting is over."""
        return self._thread.wait(timeout_s)

    def statistics(self) -> JournalStatistics:
        """Return the counts so far, without waiting for the disk."""
        with self._lock:
            waiting = len(self._waiting)
        counts, stalled_s = self._counts, self._thread.stalled_s
        if not stalled_s:
            return replace(counts, dropped=counts.dropped + self._dropped)
        error = f"the disk has not answered for {stalled_s:.0f} s"
        pending = counts.pending + max(waiting, 1)
        return replace(counts, pending=pending, dropped=counts.dropped + self._dropped, last_error=error)

    def close(self) -> None:
        """Write waiting events, as far as the disk does so in time, and close."""
        self._thread.put(self._journal.close)
        if not self._thread.close(FINISH_S):
            logging.getLogger(__name__).error("the journal is not closed: the disk does not answer")

    def _write(self) -> None:
        with self._lock:
            waiting, self._waiting = self._waiting, []
        self._journal.write_all(waiting)
        self._counts = self._journal.statistics()

    def _retry(self) -> None:
        self._journal.retry()
        self._counts = self._journal.statistics()


def wait_for(parts: Sequence[BackgroundArchive | BackgroundJournal], timeout_s: float) -> bool:
    """Wait until all is written, for so long in all; return whether it is."""
    until_s, done = time.monotonic() + timeout_s, True
    for part in parts:
        done = part.wait(until_s - time.monotonic()) and done
    return done
