"""Telemetry logs (.tlog, plain or .xz / .gz): MAVLink packets, each after its time of arrival.

A record is the Unix time in microseconds, eight bytes, big-endian, and one packet as it came from the link.
"""

import os
from collections.abc import Container, Iterator
from itertools import chain
from pathlib import Path

from adapters.batch import Batch
from adapters.errors import TelemetryError
from adapters.logs.compressed import CompressedFile
from adapters.logs.damage import ScanStatistics
from adapters.mavlink.mavlink_columns import SequenceFindings, dialect, wanted_kinds
from adapters.mavlink.packets import PacketList, PacketScanner

READ_AHEAD_BYTES = 1 << 20
"""Bytes of a log in a batch: half a minute of a flight."""


class TlogReader:
    """Reads a telemetry log in the order it was written, also across damage, as batches.

    Iterate over it, or over :meth:`packets`, once; :meth:`statistics` returns the counts. Messages with text are not in
    columns. ``only`` names the messages wanted, None wants all; a batch is of ``read_ahead_bytes`` of the log,
    decompressed.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        only: Container[str] | None = None,
        read_ahead_bytes: int = READ_AHEAD_BYTES,
    ) -> None:
        self._path = Path(path)
        self._read_ahead_bytes = read_ahead_bytes
        self._scanner = PacketScanner(dialect(), stamped=True)
        self._wanted = wanted_kinds(only)
        self._broken_off: bool | None = None

    def statistics(self) -> ScanStatistics:
        """Return the counts so far."""
        counts = self._scanner
        return ScanStatistics(
            records=counts.intact + counts.unknown,
            unknown=counts.unknown,
            # Damage up to the end counts as broken off.
            damaged=counts.damaged - (counts.in_damage and self._broken_off is not None),
            skipped_bytes=counts.skipped_bytes + (counts.waiting if self._broken_off is not None else 0),
            broken_off=bool(self._broken_off),
        )

    def __iter__(self) -> Iterator[Batch]:
        """Return the batches in which there are wanted messages.

        Raises
        ------
        TelemetryError
            The file cannot be opened or holds no MAVLink packet.
        """
        found = SequenceFindings()
        batches = (found.decoded(packets, self._wanted) for packets in self._packets(self._read_ahead_bytes))
        return (batch for batch in batches if batch.count)

    def packets(self) -> Iterator[tuple[int, bytes]]:
        """Return time of arrival, nanoseconds, and bytes of the wanted packets; it raises the errors of iteration."""
        return chain.from_iterable(packets.items(wanted=self._wanted) for packets in self._packets(1))

    def _packets(self, least_bytes: int) -> Iterator[PacketList]:
        """Yield the packets of so many bytes of the log at a time."""
        source = CompressedFile(self._path)
        scanner, packets, size = self._scanner, PacketList(dialect()), 0
        for piece in source:
            scanner.scan(piece, packets)
            size += len(piece)
            if size >= least_bytes:
                yield packets
                packets, size = PacketList(dialect()), 0
        scanner.scan(b"", packets, is_end=True)
        self._broken_off = source.damaged or scanner.waiting > 0 or scanner.in_damage
        yield packets
        if not scanner.intact + scanner.unknown:
            if self._path.stat().st_size == 0:
                raise TelemetryError(f"{self._path}: is empty; was the recording started, or the copy finished?")
            raise TelemetryError(f"{self._path}: holds no MAVLink 1 or 2 packet; is it a telemetry log?")
