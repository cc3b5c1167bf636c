"""MAVLink packets under another sender, sequence number or signature, their checksum made right again."""

from __future__ import annotations

from adapters.errors import TelemetryError
from adapters.mavlink.mavlink_message import MAGIC_2, mavlink_types, message_number
from adapters.mavlink.signing import SigningKey

_HEAD_1, _HEAD_2 = 6, 10
"""Bytes of the header in MAVLink 1 and 2."""
_SIGNED = 1
"""MAVLINK_IFLAG_SIGNED."""


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
