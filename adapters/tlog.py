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

from adapters.compressed import CompressedFile
from adapters.errors import TelemetryError
from adapters.mavlink_message import (
    HEAD_BYTES,
    MAGICS,
    MAX_PACKET_BYTES,
    MavlinkType,
    mavlink_types,
    message_number,
    packet_size,
)
from adapters.message import Message

_TIME_BYTES = 8
_MIN_RECORD = _TIME_BYTES + HEAD_BYTES
_MAX_RECORD = _TIME_BYTES + MAX_PACKET_BYTES
_MAGIC = re.compile(b"[\xfd\xfe]")
_MAX_TIME_US = (1 << 63) // 1_000


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


class TlogReader:
    """Reads a telemetry log in the order it was written, over damage if need be.

    Iterate over it, or over :meth:`packets`, once; :meth:`statistics` tells what was found. Every packet's
    checksum is tested, wanted or not: damage is noticed where it is, and costs no intact packet behind it.

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
        self._packets = self._unknown = self._damaged = self._skipped_bytes = 0
        self._broken_off = False

    def statistics(self) -> TlogStatistics:
        """Return the counts so far."""
        return TlogStatistics(
            packets=self._packets,
            unknown=self._unknown,
            damaged=self._damaged,
            skipped_bytes=self._skipped_bytes,
            broken_off=self._broken_off,
        )

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
        types, only = mavlink_types(), self._only
        wanted = {number for number, kind in types.items() if only is None or kind.name in only}
        source = CompressedFile(self._path)
        buffer, at, noise = b"", 0, 0
        for piece in chain(source, (None,)):
            buffer, at = buffer[at:] + (piece or b""), 0
            last = len(buffer) - (_MIN_RECORD if piece is None else _MAX_RECORD)
            while at <= last:
                start = at + _TIME_BYTES
                length = packet_size(buffer, start)
                packet = buffer[start : start + length] if length else b""
                whole = bool(packet) and len(packet) == length
                kind = types.get(message_number(packet)) if whole else None
                time_us = int.from_bytes(buffer[at:start])
                if kind is not None and time_us < _MAX_TIME_US and kind.intact(packet):
                    self._damaged += noise > 0
                    noise = 0
                    self._packets += 1
                    if message_number(packet) in wanted:
                        yield time_us * 1_000, kind, packet
                    at = start + len(packet)
                elif whole and kind is None and not noise and _followed(buffer, start + len(packet)):
                    self._packets += 1
                    self._unknown += 1
                    at = start + len(packet)
                else:
                    magic = _MAGIC.search(buffer, start + 1)
                    skipped = (magic.start() if magic else len(buffer)) - start
                    noise += skipped
                    self._skipped_bytes += skipped
                    at += skipped
        self._skipped_bytes += len(buffer) - at
        self._broken_off = source.damaged or at < len(buffer) or noise > 0
        if not self._packets:
            raise TelemetryError(f"{self._path}: holds no MAVLink packet; is it a telemetry log?")


def _followed(buffer: bytes, end: int) -> bool:
    """Return whether a record or the end follows: all there is to check a packet of unknown kind by."""
    return end == len(buffer) or (end + _TIME_BYTES < len(buffer) and buffer[end + _TIME_BYTES] in MAGICS)


def read_tlog(path: str | os.PathLike[str], only: Container[str] | None = None) -> Iterator[Message]:
    """Return the messages of a telemetry log; see :class:`TlogReader`."""
    return iter(TlogReader(path, only))
