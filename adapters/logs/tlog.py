"""Telemetry logs (.tlog, plain or .xz / .gz): MAVLink packets, each behind its time of arrival.

A record is the Unix time in microseconds, eight bytes, big-endian, and one packet as it came from the link.
"""

from __future__ import annotations

import os
import re
from collections.abc import Container, Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

from adapters.errors import TelemetryError
from adapters.logs.compressed import CompressedFile
from adapters.mavlink.mavlink_message import (
    HEAD_BYTES,
    MAGICS,
    MAX_PACKET_BYTES,
    MavlinkType,
    mavlink_types,
    message_number,
    packet_size,
)
from adapters.message import LATEST_NS, Message

TIME_BYTES = 8
_MIN_RECORD = TIME_BYTES + HEAD_BYTES
_MAX_RECORD = TIME_BYTES + MAX_PACKET_BYTES
_MAGIC = re.compile(b"[\xfd\xfe]")
MAX_TIME_US = LATEST_NS // 1_000


@dataclass(frozen=True, slots=True)
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

    packets: int
    unknown: int
    damaged: int
    skipped_bytes: int
    broken_off: bool


class RecordScan:
    """Finds the records of a log one by one, over damage if need be, and counts what it found.

    Every packet's checksum is tested, wanted or not: damage is noticed where it is, and costs no intact packet
    behind it.

    Attributes
    ----------
    packets, unknown, damaged, skipped_bytes : int
        As of :class:`TlogStatistics`.
    broken_off : bool
        The same, after :meth:`end`.
    noise : int
        Bytes skipped since the last intact packet.
    """

    def __init__(self) -> None:
        self.packets = self.unknown = self.damaged = self.skipped_bytes = self.noise = 0
        self.broken_off = False
        self._types = mavlink_types()

    def step(self, buffer: bytes, at: int) -> tuple[MavlinkType | None, int]:
        """Look at what may be a record.

        Parameters
        ----------
        buffer : bytes
            A part of the log.
        at : int
            Where the record begins; at most :func:`last_record`.

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
            self.damaged += self.noise > 0
            self.noise = 0
            self.packets += 1
            return kind, start + len(packet)
        if whole and kind is None and not self.noise and _followed(buffer, start + len(packet)):
            self.packets += 1
            self.unknown += 1
            return None, start + len(packet)
        magic = _MAGIC.search(buffer, start + 1)
        skipped = (magic.start() if magic else len(buffer)) - start
        self.noise += skipped
        self.skipped_bytes += skipped
        return None, at + skipped

    def end(self, path: Path, rest: int, damaged: bool) -> None:
        """Take note that the log is over.

        Parameters
        ----------
        path : Path
            The log.
        rest : int
            Bytes that are left.
        damaged : bool
            Whether its compressed data ended early.

        Raises
        ------
        TelemetryError
            There was no packet at all.
        """
        self.skipped_bytes += rest
        self.broken_off = damaged or rest > 0 or self.noise > 0
        if not self.packets:
            if Path(path).stat().st_size == 0:
                raise TelemetryError(f"{path}: is empty; was the recording started, or the copy finished?")
            raise TelemetryError(f"{path}: holds no MAVLink packet; is it a telemetry log?")

    def statistics(self) -> TlogStatistics:
        """Return the counts so far."""
        return TlogStatistics(
            packets=self.packets,
            unknown=self.unknown,
            damaged=self.damaged,
            skipped_bytes=self.skipped_bytes,
            broken_off=self.broken_off,
        )


class TlogReader:
    """Reads a telemetry log in the order it was written, over damage if need be.

    Iterate over it, or over :meth:`packets`, once; :meth:`statistics` tells what was found.

    Parameters
    ----------
    path : str | PathLike
        The log.
    only : Container[str] | None
        Names of the messages wanted; None wants all.
    """

    def __init__(self, path: str | os.PathLike[str], only: Container[str] | None = None) -> None:
        self._path = Path(path)
        self._only = only
        self._scan = RecordScan()

    def statistics(self) -> TlogStatistics:
        """Return the counts so far."""
        return self._scan.statistics()

    def __iter__(self) -> Iterator[Message]:
        """Return the wanted messages.

        Raises
        ------
        TelemetryError
            The file cannot be opened or holds no MAVLink packet at all.
        """
        for received_ns, kind, packet in self._records():
            yield kind.decode(packet, received_ns)

    def packets(self) -> Iterator[tuple[int, bytes]]:
        """Return time of arrival, nanoseconds, and bytes of the wanted packets; raises as iteration does."""
        for received_ns, _, packet in self._records():
            yield received_ns, packet

    def _records(self) -> Iterator[tuple[int, MavlinkType, bytes]]:
        step, only = self._scan.step, self._only
        wanted = {kind for kind in mavlink_types().values() if only is None or kind.name in only}
        source = CompressedFile(self._path)
        buffer, at = b"", 0
        for piece in chain(source, (None,)):
            buffer, at = buffer[at:] + (piece or b""), 0
            last = last_record(len(buffer), final=piece is None)
            while at <= last:
                kind, end = step(buffer, at)
                if kind is not None and kind in wanted:
                    start = at + TIME_BYTES
                    yield int.from_bytes(buffer[at:start]) * 1_000, kind, buffer[start:end]
                at = end
        self._scan.end(self._path, len(buffer) - at, source.damaged)


def last_record(size: int, final: bool) -> int:
    """Return the last place in a buffer at which whether a record begins there can be told.

    Parameters
    ----------
    size : int
        Bytes in the buffer.
    final : bool
        Whether the log ends with it; otherwise the longest record and the magic byte behind it have to fit in.
    """
    return size - (_MIN_RECORD if final else _MAX_RECORD + _MIN_RECORD)


def _followed(buffer: bytes, end: int) -> bool:
    """Return whether a record or the end follows: all there is to check a packet of unknown kind by."""
    return end == len(buffer) or (end + TIME_BYTES < len(buffer) and buffer[end + TIME_BYTES] in MAGICS)


def read_tlog(path: str | os.PathLike[str], only: Container[str] | None = None) -> Iterator[Message]:
    """Return the messages of a telemetry log; see :class:`TlogReader`."""
    return iter(TlogReader(path, only))
