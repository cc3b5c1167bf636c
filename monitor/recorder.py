"""Flight recorder: telemetry, samples, estimates and alarms in one MCAP file that every MCAP tool reads."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import PurePath
from types import TracebackType
from typing import Self

from adapters.mcap_log import MessageLogWriter, WriterStatistics
from adapters.message import Message
from monitor.estimate import Estimate, Layout
from monitor.event import AlarmEvent
from monitor.payload import ALARM_SCHEMA, to_json
from monitor.protobuf_schema import EstimateType, SampleType, alarm_record

_ALARM_SCHEMA = ("fauio.Alarm", json.dumps(ALARM_SCHEMA).encode())
_MEDIA_TYPES = {".json": "application/json", ".toml": "application/toml"}


class Recorder:
    """Records everything one monitor sees and says.

    Topics: ``/mavlink/<MESSAGE>`` and ``/zenoh/<key>`` telemetry as received; ``/fauio/<observer>/sample``
    and ``/fauio/<observer>/estimate``; ``/fauio/alarm`` (protobuf) and ``/fauio/alarm_json``. Log time and
    publish time are the time of arrival for telemetry and the Unix time of the sample for what the monitor
    made of it. The caller flushes on a timer. Not for several threads at once.

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
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        layouts: Sequence[Layout],
        metadata: Mapping[str, str],
        profile_files: Mapping[str, bytes],
    ) -> None:
        self._samples = {layout.observer: SampleType(layout) for layout in layouts}
        self._estimates = {layout.observer: EstimateType(layout) for layout in layouts}
        self._log = MessageLogWriter(path)
        self._unrecordable = 0
        self.add_metadata(metadata)
        for name, data in profile_files.items():
            media_type = _MEDIA_TYPES.get(PurePath(name).suffix, "application/octet-stream")
            self._log.add_attachment(f"profile/{name}", media_type, data)
        self.flush()

    def message(self, message: Message) -> None:
        """Record telemetry as received."""
        self._log.write(message)

    def estimate(self, estimate: Estimate) -> None:
        """Record an estimate and the sample it was computed from."""
        topic = f"/fauio/{estimate.observer}"
        time_ns = estimate.sample.time_ns
        try:
            sample = self._samples[estimate.observer].record(estimate.sample)
            record = self._estimates[estimate.observer].record(estimate)
        except ValueError:
            self._unrecordable += 1
            return
        self._log.write_protobuf(f"{topic}/sample", sample, time_ns)
        self._log.write_protobuf(f"{topic}/estimate", record, time_ns)

    def event(self, event: AlarmEvent) -> None:
        """Record an alarm event."""
        try:
            record = alarm_record(event)
        except ValueError:
            self._unrecordable += 1
            return
        self._log.write_protobuf("/fauio/alarm", record, event.time_ns)
        self._log.write_json("/fauio/alarm_json", to_json(event.to_json()), event.time_ns, _ALARM_SCHEMA)

    def add_metadata(self, metadata: Mapping[str, str]) -> None:
        """Add entries to the metadata record ``fauio``; a reader takes the latest of each key."""
        self._log.add_metadata("fauio", metadata)

    def flush(self) -> None:
        """Hand everything recorded so far to the operating system: it then survives ``kill -9``."""
        self._log.flush()

    def close(self) -> None:
        """Finish the file with its index; a second call does nothing."""
        self._log.close()

    def statistics(self) -> WriterStatistics:
        """Return the counts so far; clocks that run out of 64 bits make a record impossible too."""
        written = self._log.statistics()
        return WriterStatistics(written.records, written.unrecordable + self._unrecordable)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
