"""Many protobuf messages of one type at once as columns of numbers.

Read as protobuf itself reads them, message by message; messages in another form than serializers write (fields in
another order, unknown fields, lists of different lengths) are refused, and protobuf has to read them. The wire format:
https://protobuf.dev/programming-guides/encoding
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

# Bytes behind the last message that may be read, and are ignored: a number takes at most 10.
_PADDING = 16

_VARINT, _FIXED_64, _LENGTH, _FIXED_32 = 0, 1, 2, 5
"""Wire types of the Protocol Buffers encoding."""
_LONGEST_VARINT = 10
"""64 bits in groups of seven."""


class _Number(NamedTuple):
    """Type of a kind of number in arrays, and its wire type."""

    dtype: np.dtype[np.generic]
    wire: int


@dataclass(frozen=True, slots=True)
class _Field:
    name: str
    tag: bytes
    number: _Number
    repeated: bool


class RowDecoder:
    """Decodes many messages of one protobuf class (proto3) at once.

    :class:`monitor.core.protobuf_rows.RowEncoder` encodes them.

    Raises
    ------
    ValueError
        The type has fields that are no numbers, or fields that distinguish absence from zero.
    """

    def __init__(self, pb_class: Any) -> None:
        self._fields = _fields(pb_class.DESCRIPTOR)
        self._declared = tuple(field.name for field in pb_class.DESCRIPTOR.fields)

    def decode(self, messages: Sequence[bytes]) -> dict[str, NDArray[np.generic]] | None:
        """Return the columns in the order of their definition, None where protobuf has to read the messages.

        Numbers have the type of their field; repeated ones shape (n, their length).
        """
        size = np.fromiter(map(len, messages), np.int64, len(messages))
        end = np.cumsum(size)
        data = np.frombuffer(b"".join(messages) + bytes(_PADDING), np.uint8)
        cursor = _Cursor(data, end - size, end)
        columns: dict[str, NDArray[np.generic]] = {}
        for field in self._fields:
            values = cursor.repeated(field) if field.repeated else cursor.single(field)
            if values is None:
                return None
            columns[field.name] = values
        if not cursor.sound or (cursor.at != end).any():
            return None
        return {name: columns[name] for name in self._declared}


class _Cursor:
    """Positions (n,) in n messages, which lie one behind the other in a padded buffer, up to which they are read."""

    def __init__(self, data: NDArray[np.uint8], at: NDArray[np.int64], end: NDArray[np.int64]) -> None:
        self._data = data
        self._last = len(data) - _PADDING
        self._end = end
        self.at = at
        self.sound = True

    def single(self, field: _Field) -> NDArray[np.generic]:
        """Return a field's values (n,), zero where a message has none."""
        present = self._tagged(field)
        rows = slice(None) if present.all() else np.flatnonzero(present)
        values = np.zeros(len(self.at), field.number.dtype)
        values[rows], self.at[rows] = self._numbers(field.number, self.at[rows] + len(field.tag))
        return values

    def repeated(self, field: _Field) -> NDArray[np.generic] | None:
        """Return a packed field's values (n, length), None where the lengths differ."""
        present = self._tagged(field)
        if not present.any():
            return np.zeros((len(self.at), 0), field.number.dtype)
        if not present.all():
            return None
        size, at = self._numbers(_UINT64, self.at + len(field.tag))
        stop = at + size.astype(np.int64)
        if (stop < at).any() or (stop > self._end).any():
            return None
        columns = []
        while (at < stop).all():
            values, at = self._numbers(field.number, at)
            columns.append(values)
        if (at != stop).any():
            return None
        self.at = at
        return np.stack(columns, axis=1) if columns else np.zeros((len(at), 0), field.number.dtype)

    def _tagged(self, field: _Field) -> NDArray[np.bool_]:
        """Return which messages continue with a field (n,)."""
        is_next = self.at < self._end
        for k, byte in enumerate(field.tag):
            is_next &= self._data.take(self.at + k, mode="clip") == byte
        return is_next

    def _numbers(self, number: _Number, at: NDArray[np.int64]) -> tuple[NDArray[np.generic], NDArray[np.int64]]:
        """Return the numbers at positions, and the positions behind them."""
        if number.wire != _VARINT:
            width = number.dtype.itemsize
            everywhere = np.ndarray((len(self._data) - width + 1,), number.dtype, self._data, strides=(1,))
            return everywhere[np.minimum(at, self._last)], at + width
        low = self._data.take(at, mode="clip")
        value = (low & 0x7F).astype(np.uint64)
        length = np.ones(len(at), np.int64)
        rows = np.flatnonzero(low >= 0x80)
        for k in range(1, _LONGEST_VARINT):
            if not len(rows):
                break
            byte = self._data.take(at[rows] + k, mode="clip")
            value[rows] |= (byte & 0x7F).astype(np.uint64) << np.uint64(7 * k)
            length[rows] += 1
            rows = rows[byte >= 0x80]
        self.sound &= not len(rows)
        return value.astype(number.dtype) if number.dtype.kind != "b" else value != 0, at + length


_UINT64 = _Number(np.dtype(np.uint64), _VARINT)
# By type of field, as numbered in google/protobuf/descriptor.proto.
_NUMBERS = {
    1: _Number(np.dtype("<f8"), _FIXED_64),
    2: _Number(np.dtype("<f4"), _FIXED_32),
    3: _Number(np.dtype(np.int64), _VARINT),
    4: _UINT64,
    5: _Number(np.dtype(np.int32), _VARINT),
    8: _Number(np.dtype(np.bool_), _VARINT),
    13: _Number(np.dtype(np.uint32), _VARINT),
}


def _fields(descriptor: Any) -> tuple[_Field, ...]:
    fields = []
    for field in sorted(descriptor.fields, key=lambda entry: int(entry.number)):
        number = _NUMBERS.get(field.type)
        if number is None or field.has_presence:
            raise ValueError(f"{field.full_name} is no plain number")
        tag = field.number << 3 | (_LENGTH if field.is_repeated else number.wire)
        fields.append(_Field(field.name, _varint(tag), number, bool(field.is_repeated)))
    return tuple(fields)


def _varint(number: int) -> bytes:
    """Return a number seven bits a byte, the lowest first; all but the last byte have the highest bit set."""
    data = bytearray()
    while number > 0x7F:
        data.append(number & 0x7F | 0x80)
        number >>= 7
    return bytes((*data, number))
