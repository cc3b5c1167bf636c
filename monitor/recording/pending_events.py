"""Records of alarm events that are not yet in a file: a full disk delays them, it does not lose them."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Final

from monitor.recording.encoded_record import EncodedRecord

MAX_PENDING_RECORDS: Final = 10_000
"""Records that wait at most. Chosen: two an event, so a night of 5,000 events on a full disk, in 4 MB of memory."""


class PendingEvents:
    """Alarm records from when they are given to a file until that file was flushed.

    A recorder numbers the records of the file in hand from 1.
    """

    def __init__(self) -> None:
        self._sent: deque[tuple[int, EncodedRecord]] = deque(maxlen=MAX_PENDING_RECORDS)
        self._waiting: deque[EncodedRecord] = deque(maxlen=MAX_PENDING_RECORDS)

    def __len__(self) -> int:
        """Return how many records wait for a file."""
        return len(self._waiting)

    def sent(self, number: int, records: Sequence[EncodedRecord]) -> None:
        """Note records that are about to become the ``number``-th and following of the file in hand."""
        self._sent.extend(enumerate(records, number))

    def keep(self, records: Sequence[EncodedRecord]) -> int:
        """Keep records while there is no file; return for how many there was room."""
        kept = records[: MAX_PENDING_RECORDS - len(self._waiting)]
        self._waiting.extend(kept)
        return len(kept)

    def settle(self) -> None:
        """Forget the records that were sent: the file was flushed."""
        self._sent.clear()

    def fail(self, written: int) -> int:
        """Return how many records wait again because the file in hand ends with its ``written``-th record."""
        before = len(self._waiting)
        self._waiting.extendleft(record for number, record in reversed(self._sent) if number > written)
        self._sent.clear()
        return len(self._waiting) - before

    def take(self) -> list[EncodedRecord]:
        """Return the records that wait, and forget them."""
        records = list(self._waiting)
        self._waiting.clear()
        return records
