"""A flight repeated into a telemetry log of any length: every clock in it moves on from one copy to the next.

The packets are those of the flight; time stamps, the last bits of floats and, with them, checksums are others. With the
same floats the flight would be a recording that is sent again, of which fauio warns.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from adapters.logs.tlog import TlogReader
from adapters.mavlink.mavlink_message import MAGIC_1, mavlink_types, message_number

# Fields of the vehicle's clock and of Unix time, and their units in a microsecond.
_CLOCKS = {"time_boot_ms": 1_000, "time_usec": 1, "time_unix_usec": 1}
PAUSE_US = 2_000_000
"""Between two copies, so that observers restart: where one begins is not where the other ended."""
TIME_BYTES = 8


def shaken(floats: NDArray[np.uint32], seed: int) -> NDArray[np.uint32]:
    """Return the bits of floats with other last three bits: 1e-6 of a value, less than the noise of any sensor."""
    return floats ^ np.random.default_rng(seed).integers(0, 8, floats.shape, np.uint32)


@dataclass(frozen=True, slots=True)
class _Clock:
    """Where one clock field stands in the packets of one kind."""

    at: NDArray[np.int64]
    kind: np.dtype[np.unsignedinteger[np.generic]]
    unit_us: int


class LongLog:
    """A flight and its copies, each later than the one before by the flight's length and two seconds.

    Parameters
    ----------
    path : Path
        A healthy telemetry log, plain or compressed.
    """

    def __init__(self, path: Path) -> None:
        records = [(time_ns // 1_000).to_bytes(TIME_BYTES) + packet for time_ns, packet in TlogReader(path).packets()]
        self._data = np.frombuffer(b"".join(records), np.uint8)
        self._starts = np.cumsum([0, *map(len, records[:-1])])
        self._numbers = np.array([message_number(record[TIME_BYTES:]) for record in records])
        stamps = self._stamps(self._data)
        self.duration_s = float(stamps[-1] - stamps[0]) / 1e6
        # whole milliseconds: all of the vehicle's clocks move by the same time
        self._period_us = -(-int(stamps[-1] - stamps[0]) // 1_000) * 1_000 + PAUSE_US
        self._find_clocks()

    @property
    def messages(self) -> int:
        """Packets in one copy."""
        return len(self._starts)

    @property
    def period_s(self) -> float:
        """From the begin of one copy to that of the next."""
        return self._period_us / 1e6

    def copies(self, count: int) -> Iterator[bytes]:
        """Yield the flight and its copies, ``count`` in all."""
        for number in range(count):
            yield self._moved(number * self._period_us)

    def write(self, path: Path, count: int) -> None:
        """Write the flight and its copies to a file."""
        with path.open("wb") as stream:
            stream.writelines(self.copies(count))

    def _stamps(self, data: NDArray[np.uint8]) -> NDArray[np.uint64]:
        rows = self._starts[:, None] + np.arange(TIME_BYTES)
        return data[rows].view(">u8")[:, 0].astype(np.uint64)

    def _find_clocks(self) -> None:
        at = self._starts + TIME_BYTES
        payloads = at + np.where(self._data[at] == MAGIC_1, 6, 10)
        lengths = self._data[at + 1].astype(np.int64)
        self._clocks: list[_Clock] = []
        floats = []
        changed = np.zeros(len(self._starts), np.bool_)
        for number in np.unique(self._numbers).tolist():
            table = mavlink_types()[number].table
            types = dict(zip(table.fieldnames, table.fieldtypes, strict=True))
            offset = 0
            codes = table.native_format.decode()[1:]
            for name, code, length in zip(table.ordered_fieldnames, codes, table.lengths, strict=True):
                width = np.dtype(code).itemsize
                if name in _CLOCKS and types[name] in ("uint32_t", "uint64_t"):
                    # zeros at a packet's end are not sent
                    rows = (self._numbers == number) & (lengths >= offset + width)
                    self._clocks.append(_Clock(payloads[rows] + offset, np.dtype(f"<{code}"), _CLOCKS[name]))
                    changed |= rows
                for at_byte in range(offset, offset + width * length, width) if code == "f" else ():
                    rows = (self._numbers == number) & (lengths >= at_byte + width)
                    floats.append(payloads[rows] + at_byte)
                    changed |= rows
                offset += width * length
        self._floats = np.concatenate(floats)[:, None] + np.arange(4)
        extra = np.array([mavlink_types()[number].extra for number in self._numbers.tolist()], np.uint8)
        size = payloads + lengths - at - 1
        self._checked = [
            (self._starts[rows] + TIME_BYTES + 1, int(one), extra[rows])
            for one in np.unique(size[changed])
            if (rows := changed & (size == one)).any()
        ]

    def _moved(self, later_us: int) -> bytes:
        if later_us == 0:
            return self._data.tobytes()
        data = self._data.copy()
        stamps = (self._stamps(data) + np.uint64(later_us)).astype(">u8")
        data[self._starts[:, None] + np.arange(TIME_BYTES)] = stamps[:, None].view(np.uint8)
        for clock in self._clocks:
            places = clock.at[:, None] + np.arange(clock.kind.itemsize)
            values = data[places].view(clock.kind)
            # microseconds of 32 bits begin anew after 72 minutes, in the autopilot too
            later = clock.kind.type(later_us // clock.unit_us % (1 << 8 * clock.kind.itemsize))
            data[places] = (values + later).astype(clock.kind).view(np.uint8)
        data[self._floats] = shaken(data[self._floats].view(np.uint32), later_us).view(np.uint8)
        for starts, size, extra in self._checked:
            crc = np.full(len(starts), 0xFFFF, np.uint16)
            for k in range(size):
                crc = _accumulated(crc, data[starts + k])
            crc = _accumulated(crc, extra)
            data[starts + size] = crc & 0xFF
            data[starts + size + 1] = crc >> 8
        return data.tobytes()


def _accumulated(crc: NDArray[np.uint16], byte: NDArray[np.uint8]) -> NDArray[np.uint16]:
    """Return the X.25 checksums with one byte more each."""
    low = byte ^ crc.astype(np.uint8)
    low ^= low << 4
    wide = low.astype(np.uint16)
    return (crc >> 8) ^ (wide << 8) ^ (wide << 3) ^ (wide >> 4)
