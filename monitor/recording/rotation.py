"""Records one vehicle for weeks: a new file after so many bytes or seconds, the oldest deleted, no disk error fatal."""

from __future__ import annotations

import contextlib
import os
import re
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Self

from adapters.encoding.record import Record
from adapters.errors import StorageError
from adapters.logs.mcap_log import MessageLogWriter
from adapters.message import Message
from monitor.estimate import Estimate, Layout
from monitor.event import AlarmEvent
from monitor.recording.owed import OwedEvents
from monitor.recording.record_encoder import OWN_TOPICS, RecordEncoder
from monitor.recording.recorder import METADATA, start_log
from monitor.recording.retention import Retention, file_stem

RETRY_S = 10.0

# what the next record may add to a file beside its data: its head, its index entry, a new channel
_RECORD_MARGIN = 512


@dataclass(frozen=True, slots=True)
class RotationStatistics:
    """What a rotating recorder did so far.

    Parameters
    ----------
    records : int
        Records taken.
    unrecordable : int
        Messages, estimates and events that no record can hold.
    dropped : int
        Records lost because no file could be written, those of the chunk a write failed on included; alarm events
        that wait for a file are not.
    failures : int
        Times that opening or writing a file failed.
    failed : str | None
        What failed, while nothing is recorded for that reason; None while recording works.
    files : int
        Files begun.
    deleted : int
        Files deleted to stay within the budget.
    path : Path | None
        The file being written.
    """

    records: int
    unrecordable: int
    dropped: int
    failures: int
    failed: str | None
    files: int
    deleted: int
    path: Path | None


class RotatingRecorder:
    """Records everything one monitor sees and says in files ``<folder>/<vehicle>-<UTC>-<number>.mcap``.

    Each file is complete in itself; read in lexical order they are one recording, whatever the clock did. The name's
    time is that of the telemetry it begins with. A disk that fails ends the file in hand, of which everything flushed
    stays readable; a new one is tried every :data:`RETRY_S` seconds and begins with the alarm events that no file has.
    No method raises after construction. The caller flushes on a timer. Not for several threads at once.

    Parameters
    ----------
    folder : str | PathLike
        Where the files go; created where it does not exist.
    vehicle : str
        The vehicle's name.
    layouts : Sequence[Layout]
        The observers whose estimates will be recorded.
    metadata : Mapping[str, str]
        Entries of the metadata record ``fauio`` of each file.
    profile_files : Mapping[str, bytes]
        The profile's files by name, attached to each file.
    file_bytes, file_s : int, float
        Size, and time between the arrivals of first and last telemetry, after which a new file begins.
    budget_bytes : int
        What the vehicle's files may take together, the one being written included.
    encoder : RecordEncoder | None
        Encoder to share with others that record the same; None makes one.
    monotonic : Callable[[], float]
        Clock of the retries, seconds.

    Raises
    ------
    StorageError
        The folder cannot be written to, or the budget is smaller than two files.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        vehicle: str,
        layouts: Sequence[Layout],
        metadata: Mapping[str, str],
        profile_files: Mapping[str, bytes],
        *,
        file_bytes: int = 64 * 1024 * 1024,
        file_s: float = 600.0,
        budget_bytes: int = 4 * 1024 * 1024 * 1024,
        encoder: RecordEncoder | None = None,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        if budget_bytes < 2 * file_bytes:
            raise StorageError(
                f"{folder}: a recording budget of {budget_bytes} bytes is less than two files of {file_bytes} bytes; "
                "raise the budget or lower the size of a file"
            )
        self._folder = writable_folder(folder)
        self._stem = file_stem(vehicle)
        self._encoder = encoder or RecordEncoder(layouts)
        self._metadata = dict(metadata)
        self._profile_files = dict(profile_files)
        self._file_bytes = file_bytes
        self._file_ns = round(file_s * 1e9)
        self._monotonic = monotonic
        name = re.compile(re.escape(self._stem) + r"-\d{8}T\d{6}Z-\d{6}\.mcap", re.ASCII)
        self._retention = Retention(self._folder, name, budget_bytes)
        self._newest = max((path.name for path in self._retention.files()), default="")
        self._log: MessageLogWriter | None = None
        self._path: Path | None = None
        self._arrived_ns: int | None = None
        self._first_ns = self._file_records = 0
        self._owed = OwedEvents()
        self._closed = False
        self._failed: str | None = None
        self._retry_s = 0.0
        self._records = self._unrecordable = self._dropped = self._failures = self._files = 0

    def message(self, message: Message) -> None:
        """Record telemetry as received."""
        self.record(*self._encoder.message(message))

    def estimate(self, estimate: Estimate) -> None:
        """Record an estimate and the sample it was computed from."""
        self.record(*self._encoder.estimate(estimate))

    def event(self, event: AlarmEvent) -> None:
        """Record an alarm event."""
        self.record(*self._encoder.event(event))

    def record(self, *records: Record) -> None:
        """Record what is encoded already."""
        if self._closed:
            raise RuntimeError("the recorder is closed; make another one")
        for record in records:
            self._records += 1
            if not record.topic.startswith(OWN_TOPICS):
                self._arrived_ns = record.time_ns
            log = None
            try:
                log = self._log_for(record)
                if log is not None:
                    self._owed.sent(record, log.position + 1)
                    log.write_record(record)
                    self._file_records += 1
            except (OSError, StorageError) as error:
                self._fail(error)
            if log is None and not self._owed.keep(record):
                self._dropped += 1

    def add_metadata(self, metadata: Mapping[str, str]) -> None:
        """Add entries to the metadata record ``fauio`` of this file and those that follow."""
        self._metadata.update(metadata)
        if self._log is not None:
            try:
                self._log.add_metadata(METADATA, metadata)
            except OSError as error:
                self._fail(error)

    def flush(self) -> None:
        """Hand everything recorded so far to the operating system: it then survives ``kill -9``."""
        try:
            if self._log is None and self._owed and self._monotonic() >= self._retry_s:
                self._start()
            if self._log is not None:
                self._log.flush()
                self._owed.settle()
        except (OSError, StorageError) as error:
            self._fail(error)

    def close(self) -> None:
        """Finish the file with its index; a second call does nothing."""
        if self._closed:
            return
        if self._owed:
            # the last chance of what waits
            self._retry_s = 0.0
            self.flush()
        if (error := self._finish()) is not None:
            self._note(error)
        self._retention.wait()
        self._closed = True

    def statistics(self) -> RotationStatistics:
        """Return the counts so far."""
        unrecordable = self._unrecordable + self._encoder.unrecordable
        if self._log is not None:
            unrecordable += self._log.statistics().unrecordable
        return RotationStatistics(
            records=self._records,
            unrecordable=unrecordable,
            dropped=self._dropped,
            failures=self._failures,
            failed=self._failed,
            files=self._files,
            deleted=self._retention.deleted,
            path=self._path,
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _log_for(self, record: Record) -> MessageLogWriter | None:
        """Return the file a record belongs into, None while there is none to be had."""
        log = self._log
        if log is not None and not self._is_full(log, record):
            return log
        if (error := self._finish()) is not None:
            self._note(error)
        if self._failed is not None and self._monotonic() < self._retry_s:
            return None
        return self._start(record.time_ns)

    def _is_full(self, log: MessageLogWriter, record: Record) -> bool:
        """Return whether the next record begins a new file.

        Only telemetry tells the time: it is stamped by one clock, while the monitor's own records carry the
        vehicle's, and a file begun for each of two that disagree would be a flood of files.
        """
        if not self._file_records:
            return False
        if self._arrived_ns is not None and abs(self._arrived_ns - self._first_ns) >= self._file_ns:
            return True
        schema_bytes = 2 * len(record.schema.data) if record.schema is not None else 0
        return log.size + len(record.data) + schema_bytes + _RECORD_MARGIN > self._file_bytes

    def _start(self, first_ns: int = 0) -> MessageLogWriter:
        """Begin a file with the events that wait for one; where no telemetry tells the time, ``first_ns`` does."""
        time_ns = first_ns if self._arrived_ns is None else self._arrived_ns
        self._retention.make_room(self._file_bytes)
        path = self._folder / self._next_name(time_ns)
        self._log = log = start_log(path, self._metadata, self._profile_files)
        self._path, self._newest = path, path.name
        self._first_ns = time_ns
        self._file_records = 0
        self._failed = None
        self._files += 1
        for record in self._owed.send(1):
            log.write_record(record)
            self._file_records += 1
        return log

    def _next_name(self, time_ns: int) -> str:
        """Return a name behind all earlier ones: a clock that was set back goes on with the last file's time."""
        seconds = min(max(time_ns, 0) // 1_000_000_000, 253_402_300_799)
        stamp = datetime.fromtimestamp(seconds, UTC).strftime("%Y%m%dT%H%M%SZ")
        number = 0
        if self._newest:
            last_stamp, last_number = self._newest.removesuffix(".mcap").rsplit("-", 2)[1:]
            stamp = max(stamp, last_stamp)
            number = int(last_number) + 1 if stamp == last_stamp else 0
        return f"{self._stem}-{stamp}-{number:06}.mcap"

    def _finish(self) -> OSError | None:
        """End the file in hand; return what went wrong with its end."""
        log, self._log, self._path = self._log, None, None
        if log is None:
            return None
        failed = None
        try:
            log.close()
        except OSError as error:
            failed = error
        found = log.statistics()
        self._unrecordable += found.unrecordable
        before = len(self._owed)
        self._owed.fail(found.written)
        self._dropped += max(0, found.dropped - (len(self._owed) - before))
        return failed

    def _fail(self, error: Exception) -> None:
        """End the file in hand as far as the disk lets us: nothing that was flushed is touched."""
        written = self._log is not None and self._log.statistics().written > 0
        path = self._path
        self._finish()
        self._note(error)
        if path is not None and not written:
            with contextlib.suppress(OSError):
                path.unlink()

    def _note(self, error: Exception) -> None:
        self._failures += 1
        self._failed = str(error)
        self._retry_s = self._monotonic() + RETRY_S


def writable_folder(folder: str | os.PathLike[str]) -> Path:
    """Return a folder for recordings, created where it does not exist.

    Raises
    ------
    StorageError
        There is none to be had, or nothing may be written there.
    """
    path = Path(folder)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        advice = "name a folder that this user may write to"
        raise StorageError(f"{path}: cannot hold recordings: {error.strerror}; {advice}") from error
    if not os.access(path, os.W_OK | os.X_OK):
        raise StorageError(f"{path}: cannot hold recordings: it may not be written to")
    return path
