"""MAVLink packets as columns: those of a log by their places in one buffer of bytes, those of a link one by one.

Heads and checksums are those of :mod:`adapters.mavlink.mavlink_message`, from the same tables; the tests hold the two
together. Places are offsets into the buffer, which ends with :data:`PADDING` bytes that belong to no packet.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from adapters.batch import Batch, Columns, FieldPlace, RecordFields, field_places
from adapters.mavlink.mavlink_message import (
    MAGIC_1,
    MAX_PACKET_BYTES,
    PAYLOAD_START_1,
    PAYLOAD_START_2,
    MavlinkType,
    mavlink_types,
    packet_sender,
)
from adapters.message import Message
from adapters.source import MAVLINK

PADDING = 255
"""Bytes behind the buffer: the longest payload, so that a cut off packet is read whole."""

_CHECKSUM_BYTES = 2
"""CRC-16 of MAVLink."""
_LAST_BYTES = 16
"""128 bits: so far before the end a byte can be added to later ones (see :func:`intact`)."""
# Largest id of version 2, plus one.
_NUMBERS = 1 << 24


@dataclass(frozen=True, slots=True)
class Heads:
    """What n packets say of themselves.

    Parameters
    ----------
    place : NDArray[np.int64]
        Where each begins (n,).
    version_1 : NDArray[np.bool_]
        Whether it is of MAVLink 1 (n,).
    payload, length : NDArray[np.int64]
        Where the payload begins, and its bytes (n,).
    kind : NDArray[np.int16]
        The message as index into :func:`kinds`; -1 where it is unknown (n,).
    sender : NDArray[np.uint16]
        256 times the id of the system plus that of the component (n,).
    """

    place: NDArray[np.int64]
    version_1: NDArray[np.bool_]
    payload: NDArray[np.int64]
    length: NDArray[np.int64]
    kind: NDArray[np.int16]
    sender: NDArray[np.uint16]


@functools.cache
def kinds() -> tuple[MavlinkType, ...]:
    """Return the messages of the dialect in the order of their ids."""
    return tuple(kind for _, kind in sorted(mavlink_types().items()))


def heads(data: NDArray[np.uint8], place: NDArray[np.int64]) -> Heads:
    """Return the heads of the packets at n places (n,) of a buffer."""
    version_1 = data[place] == MAGIC_1
    payload = place + np.where(version_1, PAYLOAD_START_1, PAYLOAD_START_2)
    # Both versions end their heads alike, but for the number of bytes of the message's id.
    at = payload - np.where(version_1, 1, 3)
    high = (data[payload - 1].astype(np.int64) << 16) | (data[payload - 2].astype(np.int64) << 8)
    number = np.where(version_1, 0, high) | data[at]
    found = np.searchsorted(_numbers(), number).astype(np.int16)
    return Heads(
        place=place,
        version_1=version_1,
        payload=payload,
        length=data[place + 1].astype(np.int64),
        kind=np.where(_numbers()[found] == number, found, np.int16(-1)),
        sender=data[at - 2] * np.uint16(256) + data[at - 1],
    )


@functools.cache
def _numbers() -> NDArray[np.int64]:
    """Return the ids of :func:`kinds`, and one that no packet has."""
    return np.array([*sorted(mavlink_types()), _NUMBERS])


def intact(data: NDArray[np.uint8], packets: Heads) -> NDArray[np.bool_]:
    """Return which packets of known messages carry a right checksum (n,), as :meth:`MavlinkType.intact` does.

    The checksum is the remainder of the packet as a polynomial over GF(2), modulo P(x) = x^16 + x^12 + x^5 + 1.
    As squaring is linear there, P^8 = x^128 + x^96 + x^40 + 1: a byte 16 or more before the end can be added to
    those 4, 11 and 16 places behind it. That leaves 16 bytes of each packet to be divided one by one. The start
    value 0xFFFF is a summand that depends on the length alone.
    """
    # Behind the payload follow the byte that stands for the definition, and the checksum.
    size = packets.payload + packets.length - packets.place + _CHECKSUM_BYTES
    # Longest first: the packets that have a byte at a given distance from the end stand in front.
    order = np.argsort(-size.astype(np.int16), kind="stable")
    size, kind = size[order], packets.kind[order]
    last = packets.place[order] + size - 1
    extra = _definitions()[0][kind]
    having = len(size) - np.searchsorted(size[::-1], np.arange(int(size[0]) if len(size) else 0), side="right")
    rest = np.zeros((_LAST_BYTES, len(size)), np.uint8)
    at = np.empty_like(last)
    for distance in range(len(having) - 1, -1, -1):
        count = having[distance]
        if distance == _CHECKSUM_BYTES:
            byte = extra
        else:
            behind = distance - 1 if distance > _CHECKSUM_BYTES else distance
            byte = data.take(np.subtract(last[:count], behind, out=at[:count]), mode="clip")
        row = rest[distance % _LAST_BYTES, :count]
        row ^= byte
        if distance >= _LAST_BYTES:
            rest[(distance - 4) % _LAST_BYTES, :count] ^= row
            rest[(distance - 11) % _LAST_BYTES, :count] ^= row
    right = np.empty(len(size), np.bool_)
    right[order] = _remainder(rest) == _start_values()[size]
    too_long = packets.version_1 & (packets.length > _definitions()[1][packets.kind])
    return right & ~too_long & (packets.kind >= 0)


def _remainder(rows: NDArray[np.uint8]) -> NDArray[np.uint16]:
    """Return the remainders of n polynomials, given by their bytes (bytes, n), the last one first."""
    remainder = np.zeros(rows.shape[1], np.uint16)
    for row in rows[::-1]:
        low = remainder.astype(np.uint8) ^ row
        low ^= low << 4
        wide = low.astype(np.uint16)
        remainder >>= 8
        remainder ^= wide << 8
        remainder ^= wide << 3
        remainder ^= wide >> 4
    return remainder


@functools.cache
def _start_values() -> NDArray[np.uint16]:
    """Return what the start value leaves of 0, 1, ... zero bytes."""
    from pymavlink.generator.mavcrc import x25crc

    return np.array([x25crc(bytes(size)).crc for size in range(MAX_PACKET_BYTES)], np.uint16)


@functools.cache
def _definitions() -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """Return the byte behind each of :func:`kinds` in the checksum, and the bytes of its payload."""
    extra = np.array([kind.table.crc_extra for kind in kinds()], np.uint8)
    return extra, np.array([kind.size for kind in kinds()])


@functools.cache
def payload_layout(kind: MavlinkType) -> np.dtype[np.void] | None:
    """Return where pymavlink's table has the fields in a payload, in the order of their names; None with text."""
    table = kind.table
    if "char" in table.fieldtypes:
        return None
    types = table.native_format.decode()[1:]
    parts = zip(table.ordered_fieldnames, types, table.lengths, strict=True)
    packed = np.dtype([(name, f"<{type_}", (length,) if length > 1 else ()) for name, type_, length in parts])
    return packed[table.fieldnames]


@functools.cache
def _places(kind: MavlinkType) -> Mapping[str, FieldPlace]:
    layout = payload_layout(kind)
    return {} if layout is None else field_places(layout)


def payloads(
    data: NDArray[np.uint8], size: int, payload: NDArray[np.int64], length: NDArray[np.int64]
) -> NDArray[np.uint8]:
    """Return n payloads, each ``size`` bytes long as the definition has it, one after the other (n * size,).

    ``payload`` and ``length`` (n,) say where in the buffer they begin, and their bytes; what is cut off is zero.
    """
    # Every place of the buffer as the begin of a payload: taking from that copies payload by payload.
    content = np.ndarray((len(data) - size + 1,), f"V{size}", data, strides=(1,))[payload].view(np.uint8)
    if (length < size).any():
        content.reshape(-1, size)[:] *= np.arange(size) < length[:, None]
    return content


def columns(
    kind: MavlinkType,
    sender: tuple[int, int],
    position: NDArray[np.int64],
    received_ns: NDArray[np.int64],
    content: bytes | NDArray[np.uint8],
    offset: int = 0,
) -> Columns:
    """Decode n messages of one kind and sender (system, component), none of them with text.

    ``position`` and ``received_ns`` (n,) are indices in the batch and Unix times of arrival; ``content`` holds the
    payloads one after the other, each as long as the definition has it, from byte ``offset`` on.
    """
    record = np.frombuffer(content, payload_layout(kind), len(position), offset)
    return Columns(MAVLINK, kind.name, *sender, position, received_ns, RecordFields(record, _places(kind)))


def decoded(packets: Sequence[tuple[MavlinkType, bytes]], received_ns: Sequence[int]) -> Batch:
    """Decode intact packets, in the order of arrival, as a batch; ``received_ns`` are their Unix times of arrival.

    Use it for the few packets that a link brings at a time; a log gives its packets by place in one buffer.
    """
    groups: dict[tuple[MavlinkType, int, int], list[int]] = {}
    others: dict[int, Message] = {}
    for position, (kind, packet) in enumerate(packets):
        if payload_layout(kind) is None:
            others[position] = kind.decode(packet, received_ns[position])
        else:
            groups.setdefault((kind, *packet_sender(packet)), []).append(position)
    index = np.array([*chain.from_iterable(groups.values())], np.int64)
    times = np.array(received_ns, np.int64)[index]
    content = b"".join([packets[at][0].payload(packets[at][1]) for at in index.tolist()])
    found: list[Columns] = []
    first = offset = 0
    for (kind, system, component), positions in groups.items():
        rows = slice(first, first + len(positions))
        found.append(columns(kind, (system, component), index[rows], times[rows], content, offset))
        first, offset = rows.stop, offset + len(positions) * kind.size
    return Batch(len(packets), tuple(found), others)
