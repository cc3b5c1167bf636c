"""Flight recorder: a vehicle's records in MCAP files that every MCAP tool reads, one file or one after the other."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath
from types import TracebackType
from typing import Final, Self

from adapters.errors import StorageError
from adapters.logs.mcap_log import MessageLogWriter
from monitor.recording.encoded_record import EncodedRecord, TopicTable
from monitor.recording.file_series import FileSeries
from monitor.recording.pending_events import PendingEvents

METADATA: Final = "fauio"
"""Name of the metadata record in our files."""
RETRY_S: Final = 10.0
"""Seconds after which a disk that refused is tried again. Chosen: a full disk is freed by hand, so within minutes; each
try may cost the loop that monitors the time of a failing system call."""

# An upper bound of what a record adds to a file beside its data: the head (31 bytes), two index entries (16 each), and
# the channel definition, in the data and in the summary, where its topic is new.
_RECORD_MARGIN = 512
_MEDIA_TYPES = {".json": "application/json", ".toml": "application/toml"}


def start_log(
    path: str | os.PathLike[str], metadata: Mapping[str, str], profile_files: Mapping[str, bytes]
) -> MessageLogWriter:
    """Create a recording with its metadata and profile, and hand it to the operating system.

    Parameters
    ----------
    path : str | PathLike
        File to create.
    metadata : Mapping[str, str]
        Entries of the metadata record ``fauio``.
    profile_files : Mapping[str, bytes]
        The profile's files by name; each becomes the attachment ``profile/<name>``.

    Raises
    ------
    StorageError
        The file cannot be created.
    OSError
        It cannot be written; it is removed again.
    """
    log = None
    try:
        log = MessageLogWriter(path)
        log.add_metadata(METADATA, metadata)
        for name, data in profile_files.items():
            media_type = _MEDIA_TYPES.get(PurePath(name).suffix, "application/octet-stream")
            log.add_attachment(f"profile/{name}", media_type, data)
        log.flush()
    except OSError:
        with contextlib.suppress(OSError):
            if log is not None:
                log.close()
        with contextlib.suppress(OSError):
            # /dev/stdout and the like are not ours to remove
            if Path(path).is_file():
                Path(path).unlink()
        raise
    return log


@dataclass(frozen=True, slots=True)
class RecorderStatistics:
    """Counts of a recorder so far.

    Parameters
    ----------
    records : int
        Records taken.
    unrecordable : int
        Records left out because their file has too many topics.
    dropped : int
        Records lost because no file could be written, those of the chunk on which a write failed included; alarm events
        that wait for a file are not.
    failures : int
        Times that opening or writing a file failed.
    failed : str | None
        The error, while nothing is recorded because of it; None while recording works.
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


class Recorder:
    """Writes one vehicle's records into one file, or into a series of files for weeks.

    Each file is complete in itself; the files of a series, read in lexical order, are one recording. The caller
    flushes on a timer: everything flushed survives ``kill -9``. After a write that failed, everything flushed stays
    readable, and recording is tried again every :data:`RETRY_S` seconds, in the same file or, of a series, in the next;
    it continues with the alarm events that no file has. Not for several threads at once.

    Parameters
    ----------
    target : str | PathLike | FileSeries
        File to create now, or the files to create with the first record and after that one by one.
    topics : TopicTable
        Topics of the records.
    metadata : Mapping[str, str]
        Entries of the metadata record ``fauio`` of each file.
    profile_files : Mapping[str, bytes]
        The profile's files by name, attached to each file.
    strict : bool
        Whether a write that fails raises OSError and is not tried again: for commands whose result the file is.
    monotonic : Callable[[], float]
        Clock of the retries, seconds.

    Raises
    ------
    StorageError, OSError
        The file cannot be created or written. Unless it is strict, no method raises after construction.
    """

    def __init__(
        self,
        target: str | os.PathLike[str] | FileSeries,
        topics: TopicTable,
        metadata: Mapping[str, str],
        profile_files: Mapping[str, bytes],
        *,
        strict: bool = False,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        self._series = target if isinstance(target, FileSeries) else None
        self._topics = topics
        self._metadata = dict(metadata)
        self._profile_files = dict(profile_files)
        self._strict = strict
        self._monotonic = monotonic
        self._log: MessageLogWriter | None = None
        self._path: Path | None = None
        self._channels: dict[int, int | None] = {}
        self._first_ns = 0
        self._arrived_ns: int | None = None
        self._pending = PendingEvents()
        self._closed = False
        self._failed: str | None = None
        self._retry_s = 0.0
        self._records = self._unrecordable = self._dropped = self._failures = self._files = 0
        if not isinstance(target, FileSeries):
            self._start(Path(target))

    def record(self, records: Sequence[EncodedRecord], *, telemetry: bool = False, keep: bool = False) -> None:
        """Write records.

        Parameters
        ----------
        records : Sequence[EncodedRecord]
            The records.
        telemetry : bool
            Whether their time is that of their arrival: a series looks at it to begin a new file.
        keep : bool
            Whether they wait in memory while no file can be written, as alarm events do; others are dropped.
        """
        if self._closed:
            raise RuntimeError("the recorder is closed; make another one")
        self._records += len(records)
        for record in records:
            if telemetry:
                self._arrived_ns = record[2]
            log = None
            try:
                log = self._log_for(record)
                if log is not None:
                    if keep:
                        self._pending.sent(log.position + 1, record)
                    self._write(log, record)
            except (OSError, StorageError) as error:
                self._fail(error)
            if log is None and not (keep and self._pending.keep(record)):
                self._dropped += 1

    def add_metadata(self, metadata: Mapping[str, str]) -> None:
        """Add entries to the metadata of this file and of those that follow; a reader takes the latest of each key."""
        self._metadata.update(metadata)
        if self._log is not None and not self._log.failed:
            try:
                self._log.add_metadata(METADATA, metadata)
            except OSError as error:
                self._fail(error)

    def flush(self) -> None:
        """Hand everything recorded so far to the operating system; after a failure, try again when that is due."""
        try:
            if self._log is not None and not self._log.failed:
                self._log.flush()
                self._pending.settle()
            elif (self._log is not None or self._pending) and self._monotonic() >= self._retry_s:
                self._continue(0)
        except (OSError, StorageError) as error:
            self._fail(error)

    def close(self) -> None:
        """Finish the file with its index, after a last try to write pending events; a second call does nothing."""
        if self._closed:
            return
        self._closed = True
        if self._failed is not None and not self._strict:
            self._retry_s = 0.0
            self.flush()
        self._end_file()
        if self._series is not None:
            self._series.wait()

    def statistics(self) -> RecorderStatistics:
        """Return the counts so far."""
        return RecorderStatistics(
            records=self._records,
            unrecordable=self._unrecordable,
            dropped=self._dropped,
            failures=self._failures,
            failed=self._failed,
            files=self._files,
            deleted=0 if self._series is None else self._series.deleted,
            path=self._path,
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _write(self, log: MessageLogWriter, record: EncodedRecord) -> None:
        number, data, time_ns = record
        channel = self._channels.get(number)
        if channel is None:
            topic = self._topics[number]
            channel = self._channels[number] = log.channel(topic.name, topic.encoding, topic.schema)
        if channel is None:
            self._unrecordable += 1
        else:
            log.add(channel, data, time_ns)

    def _log_for(self, record: EncodedRecord) -> MessageLogWriter | None:
        """Return the file that a record belongs into, None while there is none."""
        log = self._log
        if log is not None and not log.failed:
            if self._series is None or not self._is_full(self._series, log, record):
                return log
            self._end_file()
        if self._failed is not None and self._monotonic() < self._retry_s:
            return None
        return self._continue(record[2])

    def _is_full(self, series: FileSeries, log: MessageLogWriter, record: EncodedRecord) -> bool:
        """Return whether the next record begins a new file.

        Only telemetry tells the time: it is stamped by one clock, while the monitor's own records carry the
        vehicle's, and a file begun for each of two that disagree would be a flood of files.
        """
        if not log.position:
            return False
        if self._arrived_ns is not None and abs(self._arrived_ns - self._first_ns) >= series.file_ns:
            return True
        number, data, _ = record
        schema = None if number in self._channels else self._topics[number].schema
        schema_bytes = 0 if schema is None else 2 * len(schema.data)
        return log.size + len(data) + schema_bytes + _RECORD_MARGIN > series.file_bytes

    def _continue(self, first_ns: int) -> MessageLogWriter:
        """Resume the file in hand, or begin the next; write the events that wait.

        Parameters
        ----------
        first_ns : int
            Time of the first record, for the file's name where no telemetry has told the time.
        """
        if self._series is not None:
            self._first_ns = first_ns if self._arrived_ns is None else self._arrived_ns
            log = self._start(self._series.next_path(self._first_ns))
        elif self._log is not None:
            log = self._log
            log.resume()
            # metadata may have been lost with the failed write
            log.add_metadata(METADATA, self._metadata)
        else:
            raise RuntimeError("a recorder of one file has begun it")
        for record in self._pending.send(log.position + 1):
            self._write(log, record)
        log.flush()
        self._pending.settle()
        self._failed = None
        return log

    def _start(self, path: Path) -> MessageLogWriter:
        self._log = start_log(path, self._metadata, self._profile_files)
        self._path = path
        self._channels = {}
        self._files += 1
        return self._log

    def _fail(self, error: Exception) -> None:
        """Keep the records that were flushed, count those that are lost, and try again later."""
        log, path = self._log, self._path
        if log is not None:
            self._count_lost(log)
        self._note(error)
        if log is not None and self._series is not None:
            self._log = self._path = None
            with contextlib.suppress(OSError):
                log.close()
            if path is not None and not log.written:
                with contextlib.suppress(OSError):
                    path.unlink()
        if self._strict:
            raise error

    def _end_file(self) -> None:
        """Close the file in hand; the next record begins another."""
        log, self._log, self._path = self._log, None, None
        if log is None:
            return
        try:
            log.close()
            self._pending.settle()
        except OSError as error:
            self._count_lost(log)
            self._note(error)
            if self._strict:
                raise

    def _count_lost(self, log: MessageLogWriter) -> None:
        """Count the records that a file lacks, once for each failure; events wait for the next try."""
        waiting = self._pending.fail(log.written)
        if self._failed is None:
            self._dropped += log.position - log.written - waiting

    def _note(self, error: Exception) -> None:
        self._failures += 1
        self._failed = str(error)
        self._retry_s = self._monotonic() + RETRY_S
