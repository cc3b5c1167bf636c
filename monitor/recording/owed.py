"""Alarm events on their way to a recording: kept in memory until a file has them, so that a full disk delays them."""

from __future__ import annotations

from collections import deque
from typing import Final

from adapters.encoding.record import Record
from monitor.recording.record_encoder import ALARM_TOPICS

MAX_OWED: Final = 10_000


class OwedEvents:
    """The records of alarm events that are not yet in the file.

    A recorder numbers the records of the file in hand from 1. No more than :data:`MAX_OWED` wait for a file.
    """

    def __init__(self) -> None:
        self._sent: deque[tuple[int, Record]] = deque(maxlen=MAX_OWED)
        self._owed: deque[Record] = deque(maxlen=MAX_OWED)

    def __len__(self) -> int:
        """Return how many records wait for a file."""
        return len(self._owed)

    def sent(self, record: Record, number: int) -> None:
        """Note a record that is about to become the ``number``-th of the file in hand."""
        if record.topic in ALARM_TOPICS:
            self._sent.append((number, record))

    def keep(self, record: Record) -> bool:
        """Keep a record while there is no file; return whether it is an alarm's and there is room."""
        kept = record.topic in ALARM_TOPICS and len(self._owed) < MAX_OWED
        if kept:
            self._owed.append(record)
        return kept

    def settle(self) -> None:
        """Note that the file has all that was sent."""
        self._sent.clear()

    def lacking(self, written: int) -> int:
        """Return how many records sent are not among the first ``written`` of the file in hand."""
        return sum(number > written for number, _ in self._sent)

    def fail(self, written: int) -> None:
        """Note that the file in hand got no more than its first ``written`` records."""
        self._owed.extendleft(record for number, record in reversed(self._sent) if number > written)
        self._sent.clear()

    def send(self, number: int) -> list[Record]:
        """Return what waits, to become the records from the ``number``-th on of the file in hand."""
        records = list(self._owed)
        self._owed.clear()
        self._sent.extend((number + k, record) for k, record in enumerate(records))
        return records
