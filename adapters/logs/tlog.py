"""Telemetry logs (.tlog, plain or .xz / .gz): MAVLink packets, each behind its time of arrival.

A record is the Unix time in microseconds, eight bytes, big-endian, and one packet as it came from the link. Where a log
is whole many records are decoded at once; where it is not, :class:`RecordScan` goes from one to the next.
"""

from __future__ import annotations

import os
import re
from collections.abc import Container, Iterator
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from adapters.batch import Batch, Columns, messages
from adapters.errors import TelemetryError
from adapters.logs.compressed import CompressedFile
from adapters.mavlink.mavlink_columns import PADDING, Heads, columns, heads, intact, kinds, payload_layout, payloads
from adapters.mavlink.mavlink_message import (
    HEAD_BYTES,
    MAGIC_1,
    MAGIC_2,
    MAGICS,
    MAX_PACKET_BYTES,
    SIGNATURE_BYTES,
    MavlinkType,
    mavlink_types,
    message_number,
    packet_size,
)
from adapters.message import LATEST_NS, Message

TIME_BYTES = 8
"""Each packet follows its time of arrival, microseconds in 64 bits."""
MAX_TIME_US = LATEST_NS // 1_000
READ_AHEAD_BYTES = 1 << 20
"""Bytes of a log in a batch: half a minute of a flight."""

_MIN_RECORD = TIME_BYTES + HEAD_BYTES
_MAX_RECORD = TIME_BYTES + MAX_PACKET_BYTES
_MAGIC = re.compile(b"[\xfd\xfe]")
_FEW = 200
"""Below this number of records in a chain, looking at them one by one costs less. Measured: 200 records take 0.3 ms
either way, of which 0.3 ms are needed for the first one where many are looked at together.
"""
_SHORT_REACH = 1 << 14
"""Bytes that are looked at together behind damage, twice as many after each whole chain: so damage costs no more."""
_RECORD_2 = TIME_BYTES + 12
_SIGNED_RECORD_2 = _RECORD_2 + SIGNATURE_BYTES
_RECORD_1 = TIME_BYTES + 8


@dataclass(slots=True)
class TlogStatistics:
    """What was found in a telemetry log.

    Parameters
    ----------
    packets : int
        Packets, wanted or not.
    unknown : int
        Those among them whose message is not in the dialect.
    damaged : int
        Places where the log was damaged.
    skipped_bytes : int
        Bytes that belong to no intact packet.
    broken_off : bool
        Whether the log ends within a packet, or its compressed data early.
    """

    packets: int = 0
    unknown: int = 0
    damaged: int = 0
    skipped_bytes: int = 0
    broken_off: bool = False


class RecordScan:
    """Finds the records of a log one by one, over damage if need be, and counts what it found.

    Every packet's checksum is tested, wanted or not: damage is noticed where it is, and costs no intact packet
    behind it.

    Attributes
    ----------
    counts : TlogStatistics
        What was found so far; ``broken_off`` after :meth:`end`.
    noise : int
        Bytes skipped since the last intact packet.
    """

    def __init__(self) -> None:
        self.counts = TlogStatistics()
        self.noise = 0
        self._types = mavlink_types()

    def step(self, buffer: bytes, at: int) -> tuple[MavlinkType | None, int]:
        """Look at what may be a record, which begins at ``at``, at most :func:`last_record`.

        Returns
        -------
        MavlinkType | None
            The message of its packet, None where there is no intact packet of a known message.
        int
            Where to go on: behind the packet, or where the next may be.
        """
        start = at + TIME_BYTES
        length = packet_size(buffer, start)
        packet = buffer[start : start + length] if length else b""
        whole = bool(packet) and len(packet) == length
        kind = self._types.get(message_number(packet)) if whole else None
        if kind is not None and int.from_bytes(buffer[at:start]) < MAX_TIME_US and kind.intact(packet):
            self.counts.damaged += self.noise > 0
            self.noise = 0
            self.counts.packets += 1
            return kind, start + len(packet)
        if whole and kind is None and not self.noise and _followed(buffer, start + len(packet)):
            self.counts.packets += 1
            self.counts.unknown += 1
            return None, start + len(packet)
        magic = _MAGIC.search(buffer, start + 1)
        skipped = (magic.start() if magic else len(buffer)) - start
        self.noise += skipped
        self.counts.skipped_bytes += skipped
        return None, at + skipped

    def end(self, path: Path, left: int, damaged: bool) -> None:
        """Take note that the log is over: so many bytes are left, and its compressed data ended early or not.

        Raises
        ------
        TelemetryError
            There was no packet at all.
        """
        self.counts.skipped_bytes += left
        self.counts.broken_off = damaged or left > 0 or self.noise > 0
        if not self.counts.packets:
            if Path(path).stat().st_size == 0:
                raise TelemetryError(f"{path}: is empty; was the recording started, or the copy finished?")
            raise TelemetryError(f"{path}: holds no MAVLink packet; is it a telemetry log?")


class TlogReader:
    """Reads a telemetry log in the order it was written, over damage if need be, as batches.

    Iterate over it, or over :meth:`packets`, once; :meth:`statistics` tells what was found. Messages with text are no
    columns.

    Parameters
    ----------
    path : str | PathLike
        The log, plain or compressed.
    only : Container[str] | None
        Names of the messages wanted; None wants all.
    read_ahead_bytes : int
        Bytes of the log, decompressed, in a batch.
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
        return replace(self._scan.counts)

    def __iter__(self) -> Iterator[Batch]:
        """Return the batches in which there are wanted messages.

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
                yield _batch(buffer, data, records)
        self._scan.end(self._path, size, source.damaged)

    def packets(self) -> Iterator[tuple[int, bytes]]:
        """Return time of arrival, nanoseconds, and bytes of the wanted packets; raises as iteration does."""
        source = CompressedFile(self._path)
        buffer, at = b"", 0
        for piece in chain(source, (None,)):
            buffer, at = buffer[at:] + (piece or b""), 0
            last = last_record(len(buffer), final=piece is None)
            while at <= last:
                kind, end = self._scan.step(buffer, at)
                if kind in self._wanted_kinds:
                    start = at + TIME_BYTES
                    yield int.from_bytes(buffer[at:start]) * 1_000, buffer[start:end]
                at = end
        self._scan.end(self._path, len(buffer) - at, source.damaged)

    def _records(self, buffer: bytes, data: NDArray[np.uint8], last: int) -> tuple[NDArray[np.int64], int]:
        """Return where the wanted records of a buffer begin, and where its rest begins."""
        wanted: list[NDArray[np.int64]] = []
        at = 0
        while at <= last:
            # Damage may reach on from the buffer before.
            chained, end = _chain(buffer, at, min(last, at + self._reach)) if not self._scan.noise else ([], at)
            if len(chained) < _FEW:
                starts, at = self._one_by_one(buffer, at, end, last)
            else:
                starts, at = self._at_once(buffer, data, np.array(chained), end, last)
            wanted.append(starts)
        return np.concatenate(wanted) if wanted else np.empty(0, np.int64), at

    def _at_once(
        self, buffer: bytes, data: NDArray[np.uint8], chained: NDArray[np.int64], end: int, last: int
    ) -> tuple[NDArray[np.int64], int]:
        """Take a chain of records; return where the wanted ones begin, and where to go on."""
        packets = heads(data, chained + TIME_BYTES)
        unknown = packets.kind < 0
        right = intact(data, packets) & (_times_us(data, chained) < MAX_TIME_US)
        # A packet of an unknown message is known by the one behind it.
        bad = np.flatnonzero(~np.where(unknown, chained != chained[-1], right))
        wanted = self._wanted[packets.kind] & ~unknown
        parts: list[NDArray[np.int64]] = []
        first, count = 0, len(chained)
        while True:
            following = np.searchsorted(bad, first)
            stop = int(bad[following]) if following < len(bad) else count
            self._scan.counts.packets += stop - first
            self._scan.counts.unknown += int(np.count_nonzero(unknown[first:stop]))
            parts.append(chained[first:stop][wanted[first:stop]])
            if stop == count:
                self._reach = min(2 * self._reach, self._read_ahead_bytes)
                return np.concatenate(parts), end
            at = int(chained[stop])
            starts, at = self._one_by_one(buffer, at, at, last)
            parts.append(starts)
            first = int(np.searchsorted(chained, at))
            if at != end and (first == count or chained[first] != at):
                self._reach = _SHORT_REACH
                return np.concatenate(parts), at

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
    """Return the time stamps of records (n,), as they are in the log."""
    stamps = np.ndarray((len(data) - TIME_BYTES + 1,), ">u8", data, strides=(1,))
    return stamps[starts].astype(np.uint64)


def _batch(buffer: bytes, data: NDArray[np.uint8], starts: NDArray[np.int64]) -> Batch:
    """Return the messages of intact records."""
    packets = heads(data, starts + TIME_BYTES)
    received_ns = _times_us(data, starts).astype(np.int64) * 1_000
    groups: list[Columns] = []
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
        groups.append(columns(kind, (system, component), position, received_ns[position], content))
    return Batch(len(starts), tuple(groups), others)


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


def last_record(size: int, final: bool) -> int:
    """Return the last place in a buffer of ``size`` bytes at which it can be decided whether a record begins there.

    Unless the log ends with the buffer (``final``) the longest record and the magic byte behind it have to fit in.
    """
    return size - (_MIN_RECORD if final else _MAX_RECORD + _MIN_RECORD)


def _followed(buffer: bytes, end: int) -> bool:
    """Return whether a record or the end follows: all there is to check a packet of unknown kind by."""
    return end == len(buffer) or (end + TIME_BYTES < len(buffer) and buffer[end + TIME_BYTES] in MAGICS)


def read_tlog(path: str | os.PathLike[str], only: Container[str] | None = None) -> Iterator[Message]:
    """Return the messages of a telemetry log; see :class:`TlogReader`."""
    return (message for batch in TlogReader(path, only) for message in messages(batch))
