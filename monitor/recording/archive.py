"""Everything of one vehicle that goes to disk: each record is encoded once, for the recording and for the black box."""

from collections.abc import Mapping
from dataclasses import dataclass

from adapters.batch import Batch, joined, memory_bytes
from monitor.estimate import Estimates, joined_estimates
from monitor.event import AlarmEvent
from monitor.recording.black_box import BlackBox
from monitor.recording.foxglove_records import FoxgloveRecords
from monitor.recording.record_encoder import EncodedRecords, RecordEncoder
from monitor.recording.recorder import Recorder

_MOST_ROWS = 4096
"""Most messages and samples held before they are encoded: as many as one turn of the daemon's loop processes of a
backlog. Live ones are flushed long before, twice a second."""

_ROW_BYTES = 2000
"""Memory of a message of a dozen fields as Python objects (``adapters/batch.py``)."""


@dataclass(frozen=True, slots=True)
class ArchiveStatistics:
    """Counts of an archive so far."""

    records: int = 0  # records taken by the recording
    lost: int = 0  # records that could not be encoded or written
    trouble: str | None = None  # why nothing can be written at present; None: writing works


class Archive:
    """Records what one monitor receives and computes in a recording and a black box, either of which may be absent.

    Records are encoded when they are flushed, all rows of a kind at once, or when an alarm event or a clip needs them.
    The encoder works for both outputs, which have its table of topics. A disk that fails stops neither the monitor nor
    the other output.
    """

    def __init__(
        self, encoder: RecordEncoder, recorder: Recorder | None = None, black_box: BlackBox | None = None
    ) -> None:
        self._encoder = encoder
        self._shown = FoxgloveRecords(encoder)
        self._recorder = recorder
        self._black_box = black_box
        self._parts = [part for part in (recorder, black_box) if part is not None]
        self._batches: list[Batch] = []
        self._estimates: dict[str, list[Estimates]] = {}
        self._rows = 0

    def batch(self, batch: Batch) -> None:
        """Record telemetry as received."""
        self._batches.append(batch)
        # in rows of limited size: messages from a network may have any
        self._hold(max(batch.count, memory_bytes(batch) // _ROW_BYTES))

    def estimates(self, estimates: Estimates) -> None:
        """Record estimates and the samples they were computed from."""
        self._estimates.setdefault(estimates.observer, []).append(estimates)
        self._hold(len(estimates))

    def event(self, event: AlarmEvent) -> None:
        """Record an alarm event after everything that came before it; a raised alarm begins a clip of the black box."""
        self.encode()
        encoded = self._encoder.event(event)
        records = EncodedRecords.of([*encoded, *self._shown.event(event)] if encoded else ())
        if self._recorder is not None:
            self._recorder.record(records, keep=True)
        if self._black_box is not None:
            self._black_box.record(records)
            self._black_box.alarm(event)

    def _hold(self, rows: int) -> None:
        self._rows += rows
        if self._rows >= _MOST_ROWS:
            self.encode()

    def encode(self) -> None:
        """Pass everything that is held to the recording and to the black box."""
        batches, estimates = self._batches, self._estimates
        self._batches, self._estimates, self._rows = [], {}, 0
        if batches:
            batch = joined(batches)
            self._record(self._encoder.batch(batch), telemetry=True)
            self._record(EncodedRecords.of(self._shown.batch(batch)), telemetry=False)
        for parts in estimates.values():
            part = joined_estimates(parts)
            self._record(self._encoder.estimates(part), telemetry=False)
            self._record(EncodedRecords.of(self._shown.estimates(part)), telemetry=False)

    def _record(self, records: EncodedRecords, telemetry: bool) -> None:
        for part in self._parts:
            part.record(records, telemetry=telemetry)

    def add_metadata(self, metadata: Mapping[str, str]) -> None:
        """Add entries to the metadata of the recording and of later clips."""
        for part in self._parts:
            part.add_metadata(metadata)

    def flush(self) -> None:
        """Flush the recording to the operating system, or try a failed disk again; call it on a timer."""
        self.encode()
        if self._recorder is not None:
            self._recorder.flush()

    @property
    def has_clips(self) -> bool:
        """Whether clips are being made."""
        return self._black_box is not None and self._black_box.has_clips

    def work(self, max_records: int, now_ns: int) -> None:
        """Write up to so many records of open clips."""
        if self._black_box is not None:
            self.encode()
            self._black_box.work(max_records, now_ns)

    def close(self) -> None:
        """Finish the recording and the open clips; a second call does nothing."""
        self.encode()
        for part in self._parts:
            part.close()

    def statistics(self) -> ArchiveStatistics:
        """Return the counts so far, and the trouble with the disk."""
        records = lost = 0
        trouble = None
        if self._recorder is not None:
            counts = self._recorder.statistics()
            records, lost = counts.records, self._encoder.unrecordable + counts.unrecordable + counts.dropped
            trouble = None if counts.failed is None else f"recording stopped: {counts.failed}"
        if self._black_box is not None and trouble is None:
            trouble = self._black_box.statistics().failed
        return ArchiveStatistics(records, lost, trouble)
