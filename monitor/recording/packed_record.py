"""Records held in memory by the ten thousand: plain tuples, which the garbage collector leaves out of its search.

A full collection visits every object that it tracks: with 80,000 records held for four vehicles it took a tenth of a
second, in which no alarm could be raised. CPython no longer tracks a tuple (but not an instance of a class made of
one) of nothing but numbers and bytes after the first collection that meets it.
"""

from __future__ import annotations

from typing import TypeAlias

from adapters.encoding.record import Record, Schema

PackedRecord: TypeAlias = tuple[int, bytes, int, int | None]
"""Number of the kind, data, log time and publish time (as of :class:`~adapters.encoding.record.Record`)."""

_Kind: TypeAlias = tuple[str, str, Schema | None, int]


class RecordPacking:
    """Packs records and gives them back as they were.

    What records have in common (topic, encoding, schema, component) is kept once for each kind of them, of which there
    are as many as a recording has channels.
    """

    def __init__(self) -> None:
        self._numbers: dict[_Kind, int] = {}
        self._kinds: list[_Kind] = []

    def pack(self, record: Record) -> PackedRecord:
        """Return a record as a plain tuple, which only this packing can read."""
        kind = (record.topic, record.encoding, record.schema, record.component)
        number = self._numbers.get(kind)
        if number is None:
            number = self._numbers[kind] = len(self._kinds)
            self._kinds.append(kind)
        return number, record.data, record.time_ns, record.publish_ns

    def unpack(self, packed: PackedRecord) -> Record:
        """Return the record that was packed."""
        number, data, time_ns, publish_ns = packed
        topic, encoding, schema, component = self._kinds[number]
        return Record(topic, encoding, schema, data, time_ns, component, publish_ns)

    @staticmethod
    def time_ns(packed: PackedRecord) -> int:
        """Return a packed record's log time, Unix nanoseconds."""
        return packed[2]

    def topic(self, packed: PackedRecord) -> str:
        """Return a packed record's topic."""
        return self._kinds[packed[0]][0]
