"""MAVLink packets (versions 1 and 2) -> messages by pymavlink's tables, the same for links and recordings.

The tables of message definitions are pymavlink's and so are the values: the tests hold every message of the
dialect against pymavlink's own decoder. Signatures are skipped here; :mod:`adapters.mavlink.signing` verifies them.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable
from typing import Any

from adapters.message import Message
from adapters.source import MAVLINK

MAGIC_1 = 0xFE
"""First byte of a packet of MAVLink 1."""
MAGIC_2 = 0xFD
"""First byte of a packet of MAVLink 2."""
MAGICS = (MAGIC_1, MAGIC_2)
MAX_PACKET_BYTES = 280
"""MAVLink 2: ten bytes of header, 255 of payload, two of checksum, 13 of signature."""
# Bytes of a packet that say how long it is: magic, payload length, incompatibility flags.
HEAD_BYTES = 3

PAYLOAD_START_1, PAYLOAD_START_2 = 6, 10
"""Bytes of the header in MAVLink 1 and 2."""
SIGNATURE_BYTES = 13
"""Of MAVLink 2: link id, six bytes of time, six of hash."""
_SIGNED = 1
"""MAVLINK_IFLAG_SIGNED, the one incompatibility flag there is."""
# Where a packet may begin; of version 2 only with flags that are understood, as far as the bytes are there.
_MAGIC = re.compile(rb"\xfe|\xfd(?=.[\x00\x01]|.?\Z)", re.DOTALL)


class MavlinkType:
    """What is needed of one message definition, pymavlink's class, to check and decode its packets.

    ``size`` are the bytes of a payload from which nothing is cut off.
    """

    def __init__(self, table: Any) -> None:
        from pymavlink.generator.mavcrc import x25crc

        self.table = table
        self.name: str = table.msgname
        self._checksum = x25crc
        self._extra = bytes([table.crc_extra])
        self._unpack: Callable[[bytes], tuple[Any, ...]] = table.unpacker.unpack
        self.size: int = table.unpacker.size
        starts = [sum(table.lengths[:order]) for order in table.orders]
        self._places = [
            (name, slice(start, start + table.lengths[order]))
            for name, start, order in zip(table.fieldnames, starts, table.orders, strict=True)
        ]

    def intact(self, packet: bytes) -> bool:
        """Return whether the packet's checksum is right.

        Version 1 knows no fields beyond the definition, so a payload longer than that is none and costs no checksum:
        junk in which every byte could begin a packet stays cheap. Version 2 may carry fields of a newer definition.
        """
        if packet[1] > self.size and packet[0] == MAGIC_1:
            return False
        end = _payload_start(packet) + packet[1]
        return self.checksum(packet[:end]) == packet[end] | packet[end + 1] << 8

    def checksum(self, packet: bytes) -> int:
        """Return the checksum that belongs behind a packet's head and payload."""
        return int(self._checksum(packet[1:] + self._extra).crc)

    def payload(self, packet: bytes) -> bytes:
        """Return the payload of an intact packet as long as the definition has it: cut, or zeros at its end."""
        start = _payload_start(packet)
        payload = packet[start : start + packet[1]]
        return payload if len(payload) == self.size else payload[: self.size].ljust(self.size, b"\0")

    def decode(self, packet: bytes, received_ns: int) -> Message:
        """Return the message in an intact packet.

        Use it for single messages and those with text; :mod:`adapters.mavlink.mavlink_columns` decodes all others.
        Numbers are int or float, arrays lists, text ends at its first zero byte. Zeros that version 2 cuts
        off at the end of the payload, and fields that version 1 does not send, are zero.
        """
        values = self._unpack(self.payload(packet))
        fields = {name: _field(values[place]) for name, place in self._places}
        return Message(MAVLINK, self.name, received_ns, fields, *packet_sender(packet))


def _field(values: tuple[Any, ...]) -> Any:
    if len(values) > 1:
        return list(values)
    if isinstance(values[0], bytes):
        return values[0].split(b"\0", 1)[0].decode("ascii", errors="replace")
    return values[0]


def _payload_start(packet: bytes) -> int:
    return PAYLOAD_START_2 if packet[0] == MAGIC_2 else PAYLOAD_START_1


def message_number(packet: bytes) -> int:
    """Return the id of the message in a packet."""
    if packet[0] == MAGIC_2:
        return packet[7] | packet[8] << 8 | packet[9] << 16
    return packet[5]


def packet_sender(packet: bytes) -> tuple[int, int]:
    """Return system and component id of a packet's sender."""
    first = 5 if packet[0] == MAGIC_2 else 3
    return packet[first], packet[first + 1]


def packet_sequence(packet: bytes) -> int:
    """Return the sequence number of a packet, which its sender counts modulo 256."""
    return packet[4 if packet[0] == MAGIC_2 else 2]


def packet_signed(packet: bytes) -> bool:
    """Return whether a packet says that it is signed."""
    return packet[0] == MAGIC_2 and bool(packet[2] & _SIGNED)


def packet_size(buffer: bytes, start: int) -> int | None:
    """Return the length of the packet that starts in a buffer, None where none of a known kind starts.

    The buffer has to hold at least :data:`HEAD_BYTES` from there on.
    """
    magic, length, flags = buffer[start], buffer[start + 1], buffer[start + 2]
    if magic == MAGIC_1:
        return length + 8
    if magic != MAGIC_2 or flags & ~_SIGNED:
        return None
    return length + (12 + SIGNATURE_BYTES if flags else 12)


@functools.cache
def mavlink_types() -> dict[int, MavlinkType]:
    """Return the messages of the ardupilotmega dialect (common included) by id."""
    from pymavlink.dialects.v20 import ardupilotmega

    return {number: MavlinkType(table) for number, table in ardupilotmega.mavlink_map.items()}


class PacketParser:
    """Finds the intact packets in a stream of bytes that may be cut anywhere and hold anything.

    After a wrong checksum the search goes on at the next byte, so damage costs no intact packet.

    Attributes
    ----------
    unknown : int
        Packets of unknown messages: they cannot be checked, and are left out.
    damaged : int
        Places where bytes that belong to no intact packet were skipped.
    skipped_bytes : int
        Those bytes.
    """

    def __init__(self) -> None:
        self.unknown = 0
        self.damaged = 0
        self.skipped_bytes = 0
        self._unfinished = b""
        self._in_noise = False

    def feed(self, data: bytes) -> list[tuple[MavlinkType, bytes]]:
        """Take the next bytes; return the packets they complete, each with its message type."""
        buffer = self._unfinished + data if self._unfinished else data
        types = mavlink_types()
        packets: list[tuple[MavlinkType, bytes]] = []
        start, size = 0, len(buffer)
        while start < size:
            if size - start < HEAD_BYTES and buffer[start] in MAGICS:
                break
            length = packet_size(buffer, start) if size - start >= HEAD_BYTES else None
            if length is None:
                magic = _MAGIC.search(buffer, start + 1)
                start = self._skip(start, magic.start() if magic else size)
                continue
            end = start + length
            if end > size:
                break
            packet = buffer[start:end]
            kind = types.get(message_number(packet))
            if kind is not None and kind.intact(packet):
                packets.append((kind, packet))
            elif kind is None and (end == size or buffer[end] in MAGICS):
                self.unknown += 1
            else:
                start = self._skip(start, start + 1)
                continue
            self._in_noise = False
            start = end
        self._unfinished = buffer[start:]
        return packets

    def _skip(self, start: int, end: int) -> int:
        self.damaged += not self._in_noise
        self._in_noise = True
        self.skipped_bytes += end - start
        return end
