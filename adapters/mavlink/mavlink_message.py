"""MAVLink messages by pymavlink's tables, and what the head of a single packet says.

The tables of message definitions are pymavlink's and so are the values: the tests hold every message of the
dialect against pymavlink's own decoder. Packets are found in bytes by :mod:`adapters.mavlink.packets`; signatures are
verified by :mod:`adapters.mavlink.signing`.
"""

from __future__ import annotations

import functools
import re
import struct
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from adapters.batch import FieldPlace, field_places
from adapters.mavlink.packets import checksum
from adapters.message import Message
from adapters.source import MAVLINK

MAGIC_1 = 0xFE
"""First byte of a packet of MAVLink 1."""
MAGIC_2 = 0xFD
"""First byte of a packet of MAVLink 2."""
_SIGNED = 1
"""MAVLINK_IFLAG_SIGNED, the one incompatibility flag there is."""


class MavlinkType:
    """What is needed of one message definition, pymavlink's class, to decode its packets.

    ``size`` are the bytes of a payload from which nothing is cut off, ``extra`` stands for the definition in checksums.
    """

    def __init__(self, table: Any) -> None:
        self.table = table
        self.name: str = table.msgname
        self.extra: int = table.crc_extra
        self._unpack: Callable[[bytes], tuple[Any, ...]] = table.unpacker.unpack
        self.size: int = table.unpacker.size
        starts = [sum(table.lengths[:order]) for order in table.orders]
        self._places = [
            (name, slice(start, start + table.lengths[order]))
            for name, start, order in zip(table.fieldnames, starts, table.orders, strict=True)
        ]

    @functools.cached_property
    def layout(self) -> np.dtype[np.void] | None:
        """Where the fields are in a payload, in the order of their names; None with text."""
        table = self.table
        if "char" in table.fieldtypes:
            return None
        types = table.native_format.decode()[1:]
        parts = zip(table.ordered_fieldnames, types, table.lengths, strict=True)
        packed = np.dtype([(name, f"<{type_}", (length,) if length > 1 else ()) for name, type_, length in parts])
        return packed[table.fieldnames]

    @functools.cached_property
    def places(self) -> dict[str, FieldPlace]:
        """The same for :class:`adapters.batch.RecordFields`."""
        return {} if self.layout is None else field_places(self.layout)

    def checksum(self, packet: bytes) -> int:
        """Return the checksum that belongs behind a packet's head and payload."""
        return checksum(packet, self.extra)

    def decode(self, payload: bytes, received_ns: int, system: int, component: int) -> Message:
        """Return the message of a payload that is as long as the definition has it.

        Use it for messages with text; :func:`adapters.mavlink.mavlink_columns.decoded` decodes all others. Numbers are
        int or float, arrays lists, text ends at its first zero byte.
        """
        values = self._unpack(payload)
        fields = {name: _field(values[place]) for name, place in self._places}
        return Message(MAVLINK, self.name, received_ns, fields, system, component)


def _field(values: tuple[Any, ...]) -> Any:
    if len(values) > 1:
        return list(values)
    if isinstance(values[0], bytes):
        return values[0].split(b"\0", 1)[0].decode("ascii", errors="replace")
    return values[0]


def message_number(packet: bytes) -> int:
    """Return the id of the message in a packet."""
    if packet[0] == MAGIC_2:
        return packet[7] | packet[8] << 8 | packet[9] << 16
    return packet[5]


def packet_sender(packet: bytes) -> tuple[int, int]:
    """Return system and component id of a packet's sender."""
    first = 5 if packet[0] == MAGIC_2 else 3
    return packet[first], packet[first + 1]


def packet_signed(packet: bytes) -> bool:
    """Return whether a packet says that it is signed."""
    return packet[0] == MAGIC_2 and bool(packet[2] & _SIGNED)


class Definition:
    """A message definition with the attributes of pymavlink's classes, of one that pymavlink's dialects lack.

    Its ``fields`` are written as a MAVLink header has them, in the order of the definition: ``uint8_t index, int32_t[4]
    rpm``.
    """

    def __init__(self, name: str, fields: str) -> None:
        places = _TYPE.findall(fields)
        # larger types go first, those of one size in the order of the definition
        wire = sorted(places, key=lambda place: -_SIZES[place[0]])
        self.msgname = name
        self.fieldnames, self.fieldtypes = [place[2] for place in places], [place[0] for place in places]
        self.ordered_fieldnames = [place[2] for place in wire]
        self.array_lengths = [int(place[1] or 0) for place in wire]
        self.lengths = [length or 1 for length in self.array_lengths]
        self.orders = [self.ordered_fieldnames.index(name) for name in self.fieldnames]
        codes = [_CODES[place[0]] for place in wire]
        self.native_format = ("<" + "".join(codes)).encode()
        parts = (f"{length}{code}" for length, code in zip(self.lengths, codes, strict=True))
        self.unpacker = struct.Struct("<" + "".join(parts))
        self.crc_extra = _extra(name, wire)


def _extra(name: str, wire: Sequence[tuple[str, str, str]]) -> int:
    """Return the byte that stands for a definition in checksums (MAVLink's serialization, CRC_EXTRA)."""
    from pymavlink.generator.mavcrc import x25crc

    fields = (f"{kind} {field} ".encode() + bytes([int(length)] if length else []) for kind, length, field in wire)
    crc = x25crc(f"{name} ".encode() + b"".join(fields))
    return int((crc.crc & 0xFF) ^ (crc.crc >> 8))


_TYPE = re.compile(r"(\w+)(?:\[(\d+)\])? (\w+)")
_CODES = {
    "uint8_t": "B",
    "uint16_t": "H",
    "uint32_t": "I",
    "uint64_t": "Q",
    "int16_t": "h",
    "int32_t": "i",
    "float": "f",
}
_SIZES = {kind: struct.calcsize("<" + code) for kind, code in _CODES.items()}
_LACKING = {
    291: ("ESC_STATUS", "uint8_t index, uint64_t time_usec, int32_t[4] rpm, float[4] voltage, float[4] current"),
}
"""Messages of MAVLink's common dialect, sent by PX4, that pymavlink's dialects lack: they are marked as work in
progress."""


@functools.cache
def mavlink_types() -> dict[int, MavlinkType]:
    """Return the messages of the ardupilotmega dialect (common included) by id, and those that pymavlink lacks."""
    from pymavlink.dialects.v20 import ardupilotmega

    lacking = {number: Definition(*fields) for number, fields in _LACKING.items()}
    return {number: MavlinkType(table) for number, table in (lacking | ardupilotmega.mavlink_map).items()}


@functools.cache
def message_tables() -> dict[str, Any]:
    """Return the definitions of the same messages, pymavlink's classes, by name."""
    return {kind.name: kind.table for kind in mavlink_types().values()}
