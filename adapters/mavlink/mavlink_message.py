"""MAVLink messages by pymavlink's tables, and the header fields of a single packet.

The tables of message definitions are pymavlink's and so are the values: the tests compare every message of the dialect
with pymavlink's own decoder. Packets are found in bytes by :mod:`adapters.mavlink.packets`; signatures are verified by
:mod:`adapters.mavlink.signing`.
"""

import functools
import struct
from collections.abc import Callable
from types import SimpleNamespace
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
"""MAVLINK_IFLAG_SIGNED, the only incompatibility flag."""


class MavlinkType:
    """The parts of one message definition, pymavlink's class, that are needed to decode its packets.

    ``size`` is the length of a payload without truncation, bytes; ``extra`` is the definition's extra byte in
    checksums.
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
        """Positions of the fields in a payload, in the order of their names; None for a message with text."""
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
        """Return the checksum for a packet's header and payload."""
        return checksum(packet, self.extra)

    def decode(self, payload: bytes, received_ns: int, system: int, component: int) -> Message:
        """Return the message of a payload of full length.

        Use it for messages with text; :func:`adapters.mavlink.mavlink_columns.decoded` decodes all others. Numbers are
        int or float, arrays are lists, text ends at its first zero byte.
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
    """Return whether a packet's header marks it as signed."""
    return packet[0] == MAGIC_2 and bool(packet[2] & _SIGNED)


_ESC_STATUS = SimpleNamespace(
    msgname="ESC_STATUS",
    fieldnames=["index", "time_usec", "rpm", "voltage", "current"],
    fieldtypes=["uint8_t", "uint64_t", "int32_t", "float", "float"],
    ordered_fieldnames=["time_usec", "rpm", "voltage", "current", "index"],
    array_lengths=[0, 4, 4, 4, 0],
    lengths=[1, 4, 4, 4, 1],
    orders=[4, 0, 1, 2, 3],
    native_format=b"<QiffB",
    unpacker=struct.Struct("<Q4i4f4fB"),
    crc_extra=10,
)
"""A message of MAVLink's common dialect, sent by PX4, that pymavlink's dialects lack because it is marked as work in
progress; with the attributes of pymavlink's classes."""


@functools.cache
def mavlink_types() -> dict[int, MavlinkType]:
    """Return the messages of the ardupilotmega dialect (including common) by id, and ESC_STATUS."""
    from pymavlink.dialects.v20 import ardupilotmega

    return {number: MavlinkType(table) for number, table in ({291: _ESC_STATUS} | ardupilotmega.mavlink_map).items()}


@functools.cache
def message_tables() -> dict[str, Any]:
    """Return the definitions of the same messages, pymavlink's classes, by name."""
    return {kind.name: kind.table for kind in mavlink_types().values()}
