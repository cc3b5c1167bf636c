"""Flight recorder: a vehicle's records in MCAP files that every MCAP tool reads, one file or a series of files."""

import contextlib
import os
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePath
from typing import Final, Self

from adapters.errors import StorageError
from adapters.logs.mcap_log import MessageLogWriter
from monitor.recording.record_encoder import EncodedRecord, EncodedRecords, Topic
from monitor.recording.retention import FileSeries

MAX_PENDING_RECORDS: Final = 10_000
"""Most events' records that wait. Chosen: two per event, so a night of 5,000 events on a full disk, in 4 MB of
memory."""
METADATA: Final = "fauio"
"""Name of the metadata record in fauio's files."""
RETRY_S: Final = 10.0
"""Pause after which a failed disk is tried again, seconds. Chosen: a full disk is freed by hand, in minutes; each try
may cost the monitoring loop the time of a failing system call."""

# An upper bound of what a record adds to a file besides its data: the head (31 bytes), two index entries (16 each), and
# the channel definition, in the data and in the summary, if its topic is new.
_RECORD_MARGIN = 512
_MEDIA_TYPES = {".json": "application/json", ".toml": "application/toml"}


class RecordFile(MessageLogWriter):
    """An MCAP file that takes records by the numbers of their ``topics``, the profile's files attached as ``profile/``.

    Raises StorageError where it cannot be created, OSError where it cannot be written; it is removed again then.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        topics: Sequence[Topic],
        metadata: Mapping[str, str],
        profile_files: Mapping[str, bytes],
    ) -> None:
        self._topics = topics
        # None for a topic for which the file has no room
        self._numbers: dict[int, int | None] = {}
        try:
            super().__init__(path)
            self.add_metadata(METADATA, metadata)
            for name, data in profile_files.items():
                media_type = _MEDIA_TYPES.get(PurePath(name).suffix, "application/octet-stream")
                self.add_attachment(f"profile/{name}", media_type, data)
            self.flush()
        except OSError:
            with contextlib.suppress(OSError):
                self.close()
            with contextlib.suppress(OSError):
                # /dev/stdout and the like must not be removed
                if Path(path).is_file():
                    Path(path).unlink()
            raise

    def size_with(self, records: EncodedRecords) -> int:
        """Return an upper bound of the file's size, bytes, if it is closed after these records."""
        new = {*records.topics} - self._numbers.keys()
        schemas = [schema for number in new if (schema := self._topics[number].schema) is not None]
        written = sum(map(len, records.data)) + len(records) * _RECORD_MARGIN
        return self.size + written + sum(2 * len(schema.data) for schema in schemas)

    def recordable(self, records: EncodedRecords) -> EncodedRecords:
        """Return the records whose topics the file has room for."""
        numbers = self._numbers
        for number in {*records.topics} - numbers.keys():
            topic = self._topics[number]
            numbers[number] = self.channel(topic.name, topic.encoding, topic.schema)
        if None not in numbers.values():
            return records
        return EncodedRecords.of(record for record in records if numbers[record[0]] is not None)

    def add(self, records: EncodedRecords) -> None:
        """Write records that are :meth:`recordable`, all at once."""
        self.add_all([self._numbers[topic] or 0 for topic in records.topics], records.data, records.times_ns)


@dataclass(slots=True)
class RecorderStatistics:
    """Counts of a recorder so far."""

    records: int = 0  # records taken
    unrecordable: int = 0  # records left out because their file has too many topics
    # records lost because no file could be written, those of the chunk on which a write failed included; alarm events
    # that wait for a file are not
    dropped: int = 0
    failures: int = 0  # times that opening or writing a file failed
    failed: str | None = None  # the error, while nothing is recorded because of it; None while recording works
    files: int = 0  # files begun
    path: Path | None = None  # the file being written


class Recorder:
    """Writes one vehicle's records into one file, or into a series of files for weeks.

    Each file is complete in itself; the files of a series, read in lexical order, are one recording. The caller flushes
    on a timer: everything flushed survives ``kill -9``. After a write that failed, everything flushed stays readable,
    and recording is tried again every :data:`RETRY_S` seconds, in the same file or, of a series, in the next; it
    continues with the alarm events that no file has. Not for several threads at once.

    ``target`` is a file to create now, or the files to create with the first record and after that one by one. The
    encoder adds to ``topics``, by whose numbers records come. ``metadata`` are entries of the metadata record ``fauio``
    of each file, ahead of its data; the profile's files, by name, are attached to each. With ``strict`` a write that
    fails raises OSError and is not tried again: for commands whose result the file is.

    Raises
    ------
    StorageError, OSError
        The file cannot be created or written. Unless it is strict, no method raises after construction.
    """

    def __init__(
        self,
        target: str | os.PathLike[str] | FileSeries,
        topics: Sequence[Topic],
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
        self._log: RecordFile | None = None
        self._first_ns = self._given = 0
        self._arrived_ns: int | None = None
        # Records of alarm events written to the present file, with their numbers in it, until it is flushed; those
        # without a file.
        self._unflushed: deque[tuple[int, EncodedRecord]] = deque(maxlen=MAX_PENDING_RECORDS)
        self._waiting: deque[EncodedRecord] = deque(maxlen=MAX_PENDING_RECORDS)
        self._closed = False
        self._retry_s = 0.0
        self._counts = RecorderStatistics()
        if not isinstance(target, FileSeries):
            self._start(Path(target))

    def record(self, records: EncodedRecords, *, telemetry: bool = False, keep: bool = False) -> None:
        """Write records.

        The time of ``telemetry`` is that of its arrival: a series looks at it to begin a new file. What is to ``keep``,
        alarm events, waits in memory while no file can be written; other records are dropped.
        """
        if self._closed:
            raise RuntimeError("the recorder is closed; make another one")
        self._counts.records += len(records)
        while records:
            log, part = None, records
            try:
                log = self._log_for(records, telemetry)
                if log is not None:
                    # Near the end of a file of a series fewer and fewer fit.
                    while len(part) > 1 and not self._fits(log, part, telemetry):
                        part = part[: len(part) // 2]
                    self._write(log, part, keep)
            except (OSError, StorageError) as error:
                self._fail(error)
            if log is None:
                kept = part[: MAX_PENDING_RECORDS - len(self._waiting) if keep else 0]
                self._waiting.extend(kept)
                self._counts.dropped += len(part) - len(kept)
            if telemetry:
                self._arrived_ns = part.times_ns[-1]
            records = records[len(part) :]

    def add_metadata(self, metadata: Mapping[str, str]) -> None:
        """Fill in metadata entries that were blank so far, in this file and the following ones.

        Lengths do not change.
        """
        self._metadata.update(metadata)
        if self._log is not None and not self._log.failed:
            try:
                self._log.amend_metadata(METADATA, self._metadata)
            except OSError as error:
                self._fail(error)

    def flush(self) -> None:
        """Flush all records to the operating system; after a failure, try again once the pause is over."""
        try:
            if self._log is not None and not self._log.failed:
                self._log.flush()
                self._unflushed.clear()
            elif (self._log is not None or self._waiting) and self._monotonic() >= self._retry_s:
                self._continue(self._arrived_ns or 0)
        except (OSError, StorageError) as error:
            self._fail(error)

    def close(self) -> None:
        """Finish the file with its index, after a last try to write pending events; a second call does nothing."""
        if self._closed:
            return
        self._closed = True
        if self._counts.failed is not None and not self._strict:
            self._retry_s = 0.0
            self.flush()
        self._end_file()

    def statistics(self) -> RecorderStatistics:
        """Return the counts so far."""
        return replace(self._counts)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _write(self, log: RecordFile, records: EncodedRecords, keep: bool) -> None:
        """Write records to a file."""
        kept = log.recordable(records)
        self._counts.unrecordable += len(records) - len(kept)
        if keep:
            self._unflushed.extend(enumerate(kept, self._given + 1))
        self._given += len(kept)
        log.add(kept)

    def _log_for(self, records: EncodedRecords, telemetry: bool) -> RecordFile | None:
        """Return the file for the first of some records, None while there is none."""
        log = self._log
        if log is not None and not log.failed:
            if not self._given or self._fits(log, records[:1], telemetry):
                return log
            self._end_file()
        if self._counts.failed is not None and self._monotonic() < self._retry_s:
            return None
        return self._continue((None if telemetry else self._arrived_ns) or records.times_ns[0])

    def _fits(self, log: RecordFile, records: EncodedRecords, telemetry: bool) -> bool:
        """Return whether records belong into a file, by its size and by the times of telemetry.

        Only times of telemetry count: they come from one clock, while the monitor's own records have the vehicle's. If
        the two disagreed, a new file would begin at every change between them.
        """
        series = self._series
        if series is None:
            return True
        times_ns, first_ns = records.times_ns, self._first_ns
        if telemetry and max(max(times_ns) - first_ns, first_ns - min(times_ns)) >= series.file_ns:
            return False
        return log.size_with(records) <= series.file_bytes

    def _continue(self, first_ns: int) -> RecordFile:
        """Resume the present file, or begin the next one, named by the first time of its telemetry.

        Write pending events.
        """
        log = self._log
        if log is None and self._series is not None:
            self._first_ns = first_ns
            log = self._start(self._series.next_path(first_ns))
        elif log is not None:
            log.resume()
            self._given = log.written
        else:
            raise RuntimeError("a recorder of one file has begun it")
        pending = EncodedRecords.of(self._waiting)
        self._waiting.clear()
        self._write(log, pending, keep=True)
        log.flush()
        self._unflushed.clear()
        self._counts.failed = None
        return log

    def _start(self, path: Path) -> RecordFile:
        self._log = RecordFile(path, self._topics, self._metadata, self._profile_files)
        self._counts.path = path
        self._given = 0
        self._counts.files += 1
        return self._log

    def _fail(self, error: Exception) -> None:
        """Keep the flushed records, count those that are lost, and try again later."""
        log, path = self._log, self._counts.path
        if log is not None:
            self._count_lost(log)
        self._note(error)
        if log is not None and self._series is not None:
            self._log = self._counts.path = None
            with contextlib.suppress(OSError):
                log.close()
            if path is not None and not log.written:
                with contextlib.suppress(OSError):
                    path.unlink()
        if self._strict:
            raise error

    def _end_file(self) -> None:
        """Close the present file; the next record begins another one."""
        log, self._log, self._counts.path = self._log, None, None
        if log is None:
            return
        try:
            log.close()
            self._unflushed.clear()
        except OSError as error:
            self._count_lost(log)
            self._note(error)
            if self._strict:
                raise

    def _count_lost(self, log: RecordFile) -> None:
        """Count the records that a file was given and lacks, without events, which wait for the next try."""
        before = len(self._waiting)
        self._waiting.extendleft(record for number, record in reversed(self._unflushed) if number > log.written)
        self._unflushed.clear()
        self._counts.dropped += self._given - log.written - (len(self._waiting) - before)
        self._given = log.written

    def _note(self, error: Exception) -> None:
        self._counts.failures += 1
        self._counts.failed = str(error)
        self._retry_s = self._monotonic() + RETRY_S
