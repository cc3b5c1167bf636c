"""Everything of one vehicle that goes to disk: each record encoded once, for the recording and for the black box."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol

from adapters.batch import Batch
from adapters.encoding.record import Record, in_order
from adapters.message import Message
from monitor.estimate import Estimate, Estimates
from monitor.event import AlarmEvent
from monitor.recording.black_box import BlackBox
from monitor.recording.record_encoder import RecordEncoder

RETRY_S = 10.0


class Recording(Protocol):
    """A recording in one file or in many."""

    def record(self, *records: Record) -> None: ...  # noqa: D102
    def flush(self) -> None: ...  # noqa: D102
    def statistics(self) -> Any: ...  # noqa: D102


@dataclass(frozen=True, slots=True)
class ArchiveStatistics:
    """What became of the records.

    Parameters
    ----------
    records, lost : int
        Records written, and those that could not be.
    trouble : str | None
        Why nothing can be written at present; None where all is well.
    """

    records: int = 0
    lost: int = 0
    trouble: str | None = None


class Archive:
    """Hands what one monitor sees and says to its recording and its black box; a disk that fails stops neither.

    A recording that cannot be written is tried again every :data:`RETRY_S` seconds; it keeps alarm events until then.

    Parameters
    ----------
    encoder : RecordEncoder
        Encodes for both.
    recording : Recording | None
        The recording, if any.
    black_box : BlackBox | None
        The black box, if any.
    monotonic : Callable[[], float]
        Clock of the retries, seconds.
    """

    def __init__(
        self,
        encoder: RecordEncoder,
        recording: Recording | None,
        black_box: BlackBox | None,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        self._encoder = encoder
        self._recording = recording
        self._black_box = black_box
        self._monotonic = monotonic
        self._failed: str | None = None
        self._retry_s = 0.0

    def message(self, message: Message) -> None:
        """Take a message of the vehicle."""
        self._record(*self._encoder.message(message))

    def estimate(self, estimate: Estimate) -> None:
        """Take an estimate and the sample it was computed from."""
        self._record(*self._encoder.estimate(estimate))

    def batch(self, batch: Batch) -> None:
        """Record telemetry as received."""
        self._record(*in_order(self._encoder.block(batch)))

    def estimates(self, estimates: Estimates) -> None:
        """Record estimates and the samples they were computed from."""
        self._record(*in_order(self._encoder.estimates(estimates)))

    def event(self, event: AlarmEvent) -> None:
        """Take an alarm event; one that is raised begins a clip of the black box."""
        self._record(*self._encoder.event(event))
        if self._black_box is not None:
            self._black_box.alarm(event)

    def flush(self) -> None:
        """Hand the recording to the operating system, as often as the disk takes it."""
        if self._recording is None or (self._failed is not None and self._monotonic() < self._retry_s):
            return
        try:
            self._recording.flush()
            self._failed = None
        except OSError as error:
            self._note(error)

    def statistics(self) -> ArchiveStatistics:
        """Return the counts so far, and what is wrong."""
        found = ArchiveStatistics()
        if self._recording is not None:
            counts = self._recording.statistics()
            trouble = self._failed or getattr(counts, "failed", None)
            found = ArchiveStatistics(counts.records, counts.unrecordable + counts.dropped, trouble)
        if self._black_box is not None and found.trouble is None:
            found = replace(found, trouble=self._black_box.statistics().failed)
        return found

    def work(self, max_records: int, now_ns: int) -> int:
        """Write so many records at most of the clips that are open; return how many."""
        return 0 if self._black_box is None else self._black_box.work(max_records, now_ns)

    def _note(self, error: OSError) -> None:
        self._failed = f"recording stopped: {error.strerror or error}"
        self._retry_s = self._monotonic() + RETRY_S

    def _record(self, *records: Record) -> None:
        if self._recording is not None:
            try:
                self._recording.record(*records)
            except OSError as error:
                if self._failed is None:
                    self._note(error)
        if self._black_box is not None:
            self._black_box.record(*records)
