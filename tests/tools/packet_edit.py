"""MAVLink packets with another sender, sequence number, signature, time or values, their checksum made right again."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega

from adapters.errors import TelemetryError
from adapters.mavlink.mavlink_message import MAGIC_2, mavlink_types, message_number
from adapters.mavlink.signing import SigningKey

_HEAD_1, _HEAD_2 = 6, 10
"""Bytes of the header in MAVLink 1 and 2."""
_SIGNED = 1
"""MAVLINK_IFLAG_SIGNED."""
_STAMPS_NS = {"time_boot_ms": 1_000_000, "time_usec": 1_000}


def readdressed(packet: bytes, system: int, sequence: int) -> bytes:
    """Return a packet as another system would have sent it; a signature, which would be wrong then, is left out.

    Parameters
    ----------
    packet : bytes
        One whole packet of MAVLink 1 or 2.
    system, sequence : int
        Its new system id and sequence number, one byte each.

    Raises
    ------
    TelemetryError
        The message is not in the dialect, so its checksum is not known.
    """
    data = bytearray(packet)
    if packet[0] == MAGIC_2:
        data[2] &= ~_SIGNED
        data[4], data[5] = sequence, system
    else:
        data[2], data[3] = sequence, system
    return checksummed(bytes(data))


def checksummed(packet: bytes) -> bytes:
    """Return a packet with the checksum that belongs to the rest of it, and nothing behind that.

    Raises
    ------
    TelemetryError
        The message is not in the dialect.
    """
    kind = mavlink_types().get(message_number(packet))
    if kind is None:
        raise TelemetryError(f"MAVLink message {message_number(packet)} is not in the dialect; leave it out")
    body = packet[: (_HEAD_2 if packet[0] == MAGIC_2 else _HEAD_1) + packet[1]]
    return body + kind.checksum(body).to_bytes(2, "little")


def signed(packet: bytes, key: SigningKey, stamp: int, link: int = 0) -> bytes:
    """Return an unsigned MAVLink 2 packet with a signature.

    Parameters
    ----------
    packet : bytes
        The packet.
    key : SigningKey
        What to sign it with.
    stamp : int
        Time stamp, 10 microseconds since 2015 (:func:`adapters.mavlink.signing.unix_stamp`).
    link : int
        Number of the link that the time stamps count on, one byte.

    Raises
    ------
    TelemetryError
        The packet is of version 1, which knows no signatures.
    """
    if packet[0] != MAGIC_2:
        raise TelemetryError("a packet of MAVLink 1 cannot be signed")
    body = checksummed(packet[:2] + bytes([packet[2] | _SIGNED]) + packet[3:])
    body += bytes([link]) + stamp.to_bytes(6, "little")
    return body + key.signature(body)


def stamp_ns_of(packet: bytes) -> int | None:
    """Return the measurement's time in a packet on the vehicle's clock, nanoseconds; None where there is none."""
    fields = packet_fields(packet)
    return next((fields[name] * unit for name, unit in _STAMPS_NS.items() if fields.get(name)), None)


def packet_fields(packet: bytes) -> dict[str, Any]:
    """Return the values of a packet of MAVLink 2 by name; none where some are arrays, or pymavlink does not know it."""
    table = ardupilotmega.mavlink_map.get(message_number(packet))
    if table is None or any(length > 1 for length in table.array_lengths):
        return {}
    payload = packet[_HEAD_2 : _HEAD_2 + packet[1]].ljust(table.unpacker.size, b"\0")
    return dict(zip(table.ordered_fieldnames, table.unpacker.unpack(payload), strict=True))


def with_fields(packet: bytes, changes: Mapping[str, Any]) -> bytes:
    """Return a packet of MAVLink 2 with other values, zeros at its end cut off as the protocol demands."""
    if not changes:
        return packet
    table = ardupilotmega.mavlink_map[message_number(packet)]
    values = packet_fields(packet) | changes
    payload = table.unpacker.pack(*(values[name] for name in table.ordered_fieldnames))
    payload = payload.rstrip(b"\0") or b"\0"
    return checksummed(packet[:1] + bytes([len(payload)]) + packet[2:_HEAD_2] + payload + b"\0\0")


def set_back(packet: bytes, back_ns: int) -> bytes:
    """Return a packet with its stamps on the vehicle's clock set back, zero at the least."""
    fields = packet_fields(packet)
    return with_fields(
        packet,
        {name: max(0, fields[name] - back_ns // unit_ns) for name, unit_ns in _STAMPS_NS.items() if fields.get(name)},
    )
