"""Many protobuf messages of one flat or nested type at once: columns of numbers to bytes, and back.

Byte for byte what protobuf's own serializer writes message by message, as the tests hold it to; what does not fit here
(texts, values out of range, fields in another order) is refused, and the serializer has to do it. The wire format:
https://protobuf.dev/programming-guides/encoding
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Columns: TypeAlias = "Mapping[str, NDArray[np.generic] | Columns]"

# Bytes that are read, and put aside, behind a message's end.
PADDING = 16

_VARINT, _FIXED_64, _LENGTH, _FIXED_32 = 0, 1, 2, 5
_LONGEST_VARINT = 10


@dataclass(frozen=True, slots=True)
class _Strings:
    """n byte strings: those bytes of each row (n, width) that are kept."""

    bytes: NDArray[np.uint8]
    kept: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class _Number:
    """How one kind of number is written: its type in arrays and its wire type."""

    dtype: np.dtype[np.generic]
    wire: int


@dataclass(frozen=True, slots=True)
class _Field:
    name: str
    tag: NDArray[np.uint8]
    number: _Number | None
    repeated: bool
    nested: tuple[_Field, ...] | None


class ProtobufRows:
    """The messages of one type as rows of columns.

    Parameters
    ----------
    pb_class : Any
        Protobuf class (proto3).

    Raises
    ------
    ValueError
        The type has fields that are no numbers, or some that tell absence from zero.
    """

    def __init__(self, pb_class: Any) -> None:
        self._fields = _fields(pb_class.DESCRIPTOR)
        self._declared = tuple(field.name for field in pb_class.DESCRIPTOR.fields)

    def encode(self, columns: Columns, count: int) -> list[bytes]:
        """Return ``count`` messages.

        Parameters
        ----------
        columns : Mapping
            Values (count,) by field; of a repeated field (count, its length), of a nested message again a mapping.

        Raises
        ------
        ValueError
            The columns are not those of the type, or a value is of another kind than its field's or out of its range.
        """
        found = _encoded(self._fields, columns, count)
        data = found.bytes[found.kept].tobytes()
        ends = np.cumsum(found.kept.sum(axis=1)).tolist()
        return [data[start:end] for start, end in zip([0, *ends], ends, strict=False)]

    def decode(self, messages: Sequence[bytes]) -> dict[str, NDArray[np.generic]] | None:
        """Return the columns of flat messages in the order of their definition, None where it takes protobuf to say.

        Numbers have the type of their field; repeated ones shape (n, their length).
        """
        size = np.fromiter(map(len, messages), np.int64, len(messages))
        end = np.cumsum(size)
        data = np.frombuffer(b"".join(messages) + bytes(PADDING), np.uint8)
        cursor = _Cursor(data, end - size, end)
        found: dict[str, NDArray[np.generic]] = {}
        for field in self._fields:
            if field.number is None:
                return None
            values = cursor.repeated(field, field.number) if field.repeated else cursor.single(field, field.number)
            if values is None:
                return None
            found[field.name] = values
        if not cursor.sound or (cursor.at != end).any():
            return None
        return {name: found[name] for name in self._declared}


class _Cursor:
    """Where n messages, one behind the other in a buffer, are read on.

    Parameters
    ----------
    data : NDArray[np.uint8]
        The buffer, with padding behind it.
    at, end : NDArray[np.int64]
        Where each begins and ends (n,).
    """

    def __init__(self, data: NDArray[np.uint8], at: NDArray[np.int64], end: NDArray[np.int64]) -> None:
        self._data = data
        self._last = len(data) - PADDING
        self._end = end
        self.at = at
        self.sound = True

    def single(self, field: _Field, number: _Number) -> NDArray[np.generic]:
        """Return a field's values (n,), zero where a message has none."""
        present = self._tagged(field)
        rows = slice(None) if present.all() else np.flatnonzero(present)
        values = np.zeros(len(self.at), number.dtype)
        values[rows], self.at[rows] = self._numbers(number, self.at[rows] + len(field.tag))
        return values

    def repeated(self, field: _Field, number: _Number) -> NDArray[np.generic] | None:
        """Return a packed field's values (n, length), None where the lengths differ."""
        present = self._tagged(field)
        if not present.any():
            return np.zeros((len(self.at), 0), number.dtype)
        if not present.all():
            return None
        size, at = self._numbers(_UINT64, self.at + len(field.tag))
        stop = at + size.astype(np.int64)
        if (stop < at).any() or (stop > self._end).any():
            return None
        columns = []
        while (at < stop).all():
            values, at = self._numbers(number, at)
            columns.append(values)
        if (at != stop).any():
            return None
        self.at = at
        return np.stack(columns, axis=1) if columns else np.zeros((len(at), 0), number.dtype)

    def _tagged(self, field: _Field) -> NDArray[np.bool_]:
        """Return which messages go on with a field (n,)."""
        found = self.at < self._end
        for k, byte in enumerate(field.tag):
            found &= self._data.take(self.at + k, mode="clip") == byte
        return found

    def _numbers(self, number: _Number, at: NDArray[np.int64]) -> tuple[NDArray[np.generic], NDArray[np.int64]]:
        """Return the numbers at places, and the places behind them."""
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


def _fields(descriptor: Any) -> tuple[_Field, ...]:
    numbers = {
        descriptor_type: _Number(np.dtype(dtype), wire)
        for descriptor_type, dtype, wire in (
            (1, "<f8", _FIXED_64),
            (2, "<f4", _FIXED_32),
            (3, np.int64, _VARINT),
            (4, np.uint64, _VARINT),
            (5, np.int32, _VARINT),
            (8, np.bool_, _VARINT),
            (13, np.uint32, _VARINT),
        )
    }
    found = []
    for field in sorted(descriptor.fields, key=lambda one: int(one.number)):
        nested = field.message_type
        number = numbers.get(field.type)
        if (number is None and nested is None) or (field.has_presence and nested is None):
            raise ValueError(f"{field.full_name} is no plain number")
        if nested is not None and field.is_repeated:
            raise ValueError(f"{field.full_name} is repeated")
        wire = _LENGTH if nested is not None or field.is_repeated else number.wire if number else _LENGTH
        tag = _varints(np.array([field.number << 3 | wire], np.uint64))
        found.append(
            _Field(
                name=field.name,
                tag=tag.bytes[tag.kept],
                number=number,
                repeated=bool(field.is_repeated),
                nested=None if nested is None else _fields(nested),
            )
        )
    return tuple(found)


def _encoded(fields: Sequence[_Field], columns: Columns, count: int) -> _Strings:
    if columns.keys() != {field.name for field in fields}:
        raise ValueError("the columns are not those of the type")
    parts: list[_Strings] = []
    for field in fields:
        values = columns[field.name]
        if isinstance(values, Mapping):
            body, present = _encoded(field.nested or (), values, count), np.full(count, True)
        elif field.number is None or values.ndim != 1 + field.repeated:
            raise ValueError(f"{field.name} is of another shape than its field")
        else:
            plain = _fitting(values, field)
            present = np.full(count, plain.shape[1] > 0) if field.repeated else _nonzero(plain)
            body = _packed(field.number, plain) if field.repeated else _numbers(field.number, plain)
        parts.append(_only(_every(field.tag, count), present))
        if field.number is None or field.repeated:
            parts.append(_only(_varints(body.kept.sum(axis=1, dtype=np.uint64)), present))
        parts.append(_only(body, present))
    return _joined(parts, count)


def _joined(parts: Sequence[_Strings], count: int) -> _Strings:
    return _Strings(
        np.concatenate([np.empty((count, 0), np.uint8), *(one.bytes for one in parts)], axis=1),
        np.concatenate([np.empty((count, 0), np.bool_), *(one.kept for one in parts)], axis=1),
    )


def _every(data: NDArray[np.uint8], count: int) -> _Strings:
    """Return the same bytes ``count`` times."""
    shape = count, len(data)
    return _Strings(np.broadcast_to(data, shape), np.broadcast_to(np.True_, shape))


def _only(strings: _Strings, present: NDArray[np.bool_]) -> _Strings:
    return _Strings(strings.bytes, strings.kept & present[:, None])


def _numbers(number: _Number, values: NDArray[np.generic]) -> _Strings:
    if number.wire == _VARINT:
        whole = values.astype(np.uint64 if values.dtype.kind == "u" else np.int64)
        return _varints(whole.view(np.uint64))
    data = np.ascontiguousarray(values).view(np.uint8).reshape(len(values), number.dtype.itemsize)
    return _Strings(data, np.broadcast_to(np.True_, data.shape))


def _packed(number: _Number, values: NDArray[np.generic]) -> _Strings:
    return _joined([_numbers(number, values[:, k]) for k in range(values.shape[1])], len(values))


def _varints(values: NDArray[np.uint64]) -> _Strings:
    """Return numbers seven bits a byte, the lowest first; all but the last byte have the highest bit set."""
    most = int(values.max()) if len(values) else 0
    width = max(1, -(-most.bit_length() // 7))
    rest = values[:, None] >> (np.arange(width, dtype=np.uint64) * np.uint64(7))
    kept = rest != 0
    kept[:, 0] = True
    data = (rest & np.uint64(0x7F)).astype(np.uint8)
    data[:, :-1] |= kept[:, 1:].view(np.uint8) << 7
    return _Strings(data, kept)


def _nonzero(values: NDArray[np.generic]) -> NDArray[np.bool_]:
    """Return which values (n,) are written; minus zero is."""
    bits = np.ascontiguousarray(values).view(f"u{values.dtype.itemsize}")
    return np.asarray(bits != 0)


def _fitting(values: NDArray[np.generic], field: _Field) -> NDArray[np.generic]:
    """Return values in the type of their field."""
    dtype = field.number.dtype if field.number else values.dtype
    if _kind(values.dtype) != _kind(dtype):
        raise ValueError(f"{field.name} is of another kind than its field")
    if dtype.kind in "iu" and values.dtype != dtype and values.size:
        limits: np.iinfo[Any] = np.iinfo(str(dtype))
        if int(values.min()) < limits.min or int(values.max()) > limits.max:
            raise ValueError(f"{field.name} is out of its field's range")
    with np.errstate(over="ignore", invalid="ignore"):
        return values.astype(dtype, copy=False)


def _kind(dtype: np.dtype[np.generic]) -> str:
    return "i" if dtype.kind in "iu" else dtype.kind
