"""Flight recorder: telemetry, samples, estimates and alarms in one MCAP file that every MCAP tool reads."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePath
from types import TracebackType
from typing import Self

from adapters.batch import Batch
from adapters.encoding.record import Record
from adapters.logs.mcap_log import MessageLogWriter, WriterStatistics
from adapters.message import Message
from monitor.estimate import Estimate, Estimates, Layout
from monitor.event import AlarmEvent
from monitor.recording.owed import OwedEvents
from monitor.recording.record_encoder import RecordEncoder

METADATA = "fauio"

_MEDIA_TYPES = {".json": "application/json", ".toml": "application/toml"}


def start_log(
    path: str | os.PathLike[str], metadata: Mapping[str, str], profile_files: Mapping[str, bytes]
) -> MessageLogWriter:
    """Create a recording that says where it comes from, and hand that to the operating system.

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
    TelemetryError
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


class Recorder:
    """Records everything one monitor sees and says in one file.

    Topics and times are those of :class:`~monitor.recording.record_encoder.RecordEncoder`. The caller flushes on a
    timer. A write that fails costs what was not flushed, save alarm events: they are kept until :meth:`flush` can go on
    in the same file. Not for several threads at once.

    Parameters
    ----------
    path : str | PathLike
        File to create.
    layouts : Sequence[Layout]
        The observers whose estimates will be recorded.
    metadata : Mapping[str, str]
        Entries of the metadata record ``fauio``.
    profile_files : Mapping[str, bytes]
        The profile's files by name; each becomes the attachment ``profile/<name>``.

    Raises
    ------
    TelemetryError
        The file cannot be created.
    OSError
        It cannot be written (any method).
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        layouts: Sequence[Layout],
        metadata: Mapping[str, str],
        profile_files: Mapping[str, bytes],
    ) -> None:
        self._encoder = RecordEncoder(layouts)
        self._log = start_log(path, metadata, profile_files)
        self._owed = OwedEvents()
        self._again = 0

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
        failure = None
        for record in records:
            self._owed.sent(record, self._log.position + 1)
            try:
                self._log.write_record(record)
            except OSError as error:
                failure = error
        if failure is not None:
            raise failure

    def block(self, block: Batch) -> None:
        """Record a stretch of telemetry as received."""
        self._log.write_together(self._encoder.block(block))

    def estimates(self, estimates: Estimates) -> None:
        """Record estimates and the samples they were computed from."""
        self._log.write_together(self._encoder.estimates(estimates))

    def add_metadata(self, metadata: Mapping[str, str]) -> None:
        """Add entries to the metadata record ``fauio``; a reader takes the latest of each key."""
        self._log.add_metadata(METADATA, metadata)

    def flush(self) -> None:
        """Hand everything recorded so far to the operating system: it then survives ``kill -9``.

        After a write that failed, go on behind what stands in the file, with the alarm events that it lacks.
        """
        if self._log.failed:
            self._owed.fail(self._log.statistics().written)
            self._log.resume()
            records = self._owed.send(self._log.position + 1)
            self._again += len(records)
            for record in records:
                self._log.write_record(record)
        self._log.flush()
        self._owed.settle()

    def close(self) -> None:
        """Finish the file with its index; a second call does nothing."""
        try:
            if self._log.failed:
                self.flush()
        finally:
            self._log.close()

    def statistics(self) -> WriterStatistics:
        """Return the counts so far."""
        found = self._log.statistics()
        # what is written once more is counted once, and what waits is not lost
        kept = self._again + (self._owed.lacking(found.written) if self._log.failed else 0)
        return replace(
            found,
            records=found.records - self._again,
            unrecordable=found.unrecordable + self._encoder.unrecordable,
            dropped=found.dropped - kept,
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
