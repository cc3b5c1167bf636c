"""Records of alarm events that are not yet in a file: a full disk delays them, it does not lose them."""

from __future__ import annotations

from collections import deque
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

    def sent(self, number: int, record: EncodedRecord) -> None:
        """Note a record that is about to become the ``number``-th of the file in hand."""
        self._sent.append((number, record))

    def keep(self, record: EncodedRecord) -> bool:
        """Keep a record while there is no file; return whether there was room."""
        kept = len(self._waiting) < MAX_PENDING_RECORDS
        if kept:
            self._waiting.append(record)
        return kept

    def settle(self) -> None:
        """Forget the records that were sent: the file was flushed."""
        self._sent.clear()

    def fail(self, written: int) -> int:
        """Return how many records wait again because the file in hand ends with its ``written``-th record."""
        before = len(self._waiting)
        self._waiting.extendleft(record for number, record in reversed(self._sent) if number > written)
        self._sent.clear()
        return len(self._waiting) - before

    def send(self, number: int) -> list[EncodedRecord]:
        """Return the records that wait; they are about to become those from the ``number``-th on."""
        records = list(self._waiting)
        self._waiting.clear()
        self._sent.extend((number + k, record) for k, record in enumerate(records))
        return records
