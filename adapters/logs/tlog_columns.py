"""Telemetry logs as blocks of columns: many packets at once where a log is whole, one by one where it is not."""

from __future__ import annotations

import os
from collections.abc import Container, Iterator
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from adapters.batch import Batch, Columns
from adapters.logs.compressed import CompressedFile
from adapters.logs.tlog import MAX_TIME_US, TIME_BYTES, RecordScan, TlogStatistics, last_record
from adapters.mavlink.mavlink_columns import PADDING, Heads, columns, heads, intact, kinds, payload_layout, payloads
from adapters.mavlink.mavlink_message import MAGIC_1, MAGIC_2, MAX_PACKET_BYTES, SIGNATURE_BYTES
from adapters.message import Message

READ_AHEAD_BYTES = 1 << 20

# Below this number of records, looking at them one by one costs less.
_FEW = 200
# What is looked at together; a chain that ends early makes it shorter, so that no damage costs more than that.
_SHORT_REACH = 1 << 14
_RECORD_2 = TIME_BYTES + 12
_SIGNED_RECORD_2 = _RECORD_2 + SIGNATURE_BYTES
_RECORD_1 = TIME_BYTES + 8


class TlogBlocks:
    """Reads a telemetry log as blocks: the messages, the statistics and the errors of a ``TlogReader``.

    Iterate over it once. Messages with text are no columns. The tests hold it against the reader, whose
    :class:`adapters.logs.tlog.RecordScan` also leads it over damage.

    Parameters
    ----------
    path : str | PathLike
        The log, plain or compressed.
    only : Container[str] | None
        Names of the messages wanted; None wants all.
    read_ahead_bytes : int
        Bytes of the log, decompressed, in a block: half a minute of a flight is about 1 MB.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        only: Container[str] | None = None,
        read_ahead_bytes: int = READ_AHEAD_BYTES,
    ) -> None:
        self._path = Path(path)
        self._read_ahead_bytes = read_ahead_bytes
        self._scan = RecordScan()
        self._wanted = np.array([only is None or kind.name in only for kind in kinds()])
        self._wanted_kinds = {kind for kind, wanted in zip(kinds(), self._wanted, strict=True) if wanted}
        self._reach = read_ahead_bytes

    def statistics(self) -> TlogStatistics:
        """Return the counts so far."""
        return self._scan.statistics()

    def __iter__(self) -> Iterator[Batch]:
        """Return the blocks in which there are wanted messages.

        Raises
        ------
        TelemetryError
            The file cannot be opened or holds no MAVLink packet at all.
        """
        source = CompressedFile(self._path)
        pieces, size = [b""], 0
        for piece in chain(source, (None,)):
            if piece is not None:
                pieces.append(piece)
                size += len(piece)
                if size < self._read_ahead_bytes:
                    continue
            buffer = b"".join(pieces)
            data = np.frombuffer(buffer + bytes(PADDING), np.uint8)
            records, at = self._records(buffer, data, last_record(len(buffer), final=piece is None))
            pieces = [buffer[at:]]
            size = len(pieces[0])
            if len(records):
                yield _block(buffer, data, records)
        self._scan.end(self._path, size, source.damaged)

    def _records(self, buffer: bytes, data: NDArray[np.uint8], last: int) -> tuple[NDArray[np.int64], int]:
        """Return where the wanted records of a buffer begin, and where its rest begins."""
        found: list[NDArray[np.int64]] = []
        at = 0
        while at <= last:
            # Damage may reach on from the buffer before.
            chained, end = _chain(buffer, at, min(last, at + self._reach)) if not self._scan.noise else ([], at)
            if len(chained) < _FEW:
                starts, at = self._one_by_one(buffer, at, end, last)
            else:
                starts, at = self._at_once(buffer, data, np.array(chained), end, last)
            found.append(starts)
        return np.concatenate(found) if found else np.empty(0, np.int64), at

    def _at_once(
        self, buffer: bytes, data: NDArray[np.uint8], chained: NDArray[np.int64], end: int, last: int
    ) -> tuple[NDArray[np.int64], int]:
        """Take a chain of records; return where the wanted ones begin, and where to go on."""
        packets = heads(data, chained + TIME_BYTES)
        unknown = packets.kind < 0
        right = intact(data, packets) & (_times_us(data, chained) < MAX_TIME_US)
        # A packet of an unknown message is told by the one behind it.
        bad = np.flatnonzero(~np.where(unknown, chained != chained[-1], right))
        wanted = self._wanted[packets.kind] & ~unknown
        found: list[NDArray[np.int64]] = []
        first, count = 0, len(chained)
        while True:
            following = np.searchsorted(bad, first)
            stop = int(bad[following]) if following < len(bad) else count
            self._scan.packets += stop - first
            self._scan.unknown += int(np.count_nonzero(unknown[first:stop]))
            found.append(chained[first:stop][wanted[first:stop]])
            if stop == count:
                self._reach = min(2 * self._reach, self._read_ahead_bytes)
                return np.concatenate(found), end
            at = int(chained[stop])
            starts, at = self._one_by_one(buffer, at, at, last)
            found.append(starts)
            first = int(np.searchsorted(chained, at))
            if at != end and (first == count or chained[first] != at):
                self._reach = _SHORT_REACH
                return np.concatenate(found), at

    def _one_by_one(self, buffer: bytes, at: int, end: int, last: int) -> tuple[NDArray[np.int64], int]:
        """Take records up to a place, at least one, and on to the end of any damage; return as :meth:`_at_once`."""
        starts = []
        while True:
            kind, behind = self._scan.step(buffer, at)
            if kind in self._wanted_kinds:
                starts.append(at)
            at = behind
            if at > last or (at >= end and not self._scan.noise):
                return np.array(starts, np.int64), at


def _chain(buffer: bytes, at: int, last: int) -> tuple[list[int], int]:
    """Return where whole records begin if each is as long as it says, and where something else may begin."""
    starts: list[int] = []
    append = starts.append
    while at <= last:
        magic, flags = buffer[at + 8], buffer[at + 10]
        if magic == MAGIC_2 and flags == 0:
            size = _RECORD_2
        elif magic == MAGIC_1:
            size = _RECORD_1
        elif magic == MAGIC_2 and flags == 1:
            size = _SIGNED_RECORD_2
        else:
            break
        append(at)
        at += size + buffer[at + 9]
    if at > len(buffer):
        at = starts.pop()
    return starts, at


def _times_us(data: NDArray[np.uint8], starts: NDArray[np.int64]) -> NDArray[np.uint64]:
    """Return the time stamps of records (n,), as they stand in the log."""
    stamps = np.ndarray((len(data) - TIME_BYTES + 1,), ">u8", data, strides=(1,))
    return stamps[starts].astype(np.uint64)


def _block(buffer: bytes, data: NDArray[np.uint8], starts: NDArray[np.int64]) -> Batch:
    """Return the messages of intact records."""
    packets = heads(data, starts + TIME_BYTES)
    received_ns = _times_us(data, starts).astype(np.int64) * 1_000
    found: list[Columns] = []
    others: dict[int, Message] = {}
    for position in _groups(packets):
        first = int(position[0])
        kind = kinds()[packets.kind[first]]
        if payload_layout(kind) is None:
            for place, start in zip(position.tolist(), packets.place[position].tolist(), strict=True):
                others[place] = kind.decode(buffer[start : start + MAX_PACKET_BYTES], int(received_ns[place]))
            continue
        system, component = divmod(int(packets.sender[first]), 256)
        content = payloads(data, kind.size, packets.payload[position], packets.length[position])
        found.append(columns(kind, (system, component), position, received_ns[position], content))
    return Batch(len(starts), tuple(found), others)


def _groups(packets: Heads) -> Iterator[NDArray[np.int64]]:
    """Yield the places of the packets of each kind and sender, ascending."""
    by_kind = np.argsort(packets.kind, kind="stable")
    ends = np.flatnonzero(np.diff(packets.kind[by_kind])) + 1
    for group in np.split(by_kind, ends):
        senders = packets.sender[group]
        if (senders == senders[0]).all():
            yield group
        else:
            yield from (group[senders == sender] for sender in np.unique(senders))
