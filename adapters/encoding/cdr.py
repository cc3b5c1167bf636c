"""CDR, the encoding of ROS 2 and PX4 messages in transit: bytes -> nested fields, by the message's definition.

Every length is checked against the bytes that are left before anything is allocated, so a damaged or hostile payload
costs no more than a valid one of its size. XTypes 1.3, section 7.4 (plain CDR, version 1).
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from typing import Any

from adapters.encoding.message_definition import Definitions, MessageField, canonical_type, parse_definitions
from adapters.errors import PayloadError, TelemetryError

MAX_NESTING = 32
"""Most levels of nested messages. Chosen: far more than interfaces of ROS 2 nest, far below the limit of the
interpreter."""

_BYTE_ORDERS = {b"\x00\x00": ">", b"\x00\x01": "<"}
_CODES = {
    **{"bool": "?", "byte": "B", "char": "B", "int8": "b", "uint8": "B", "int16": "h", "uint16": "H"},
    **{"int32": "i", "uint32": "I", "int64": "q", "uint64": "Q", "float32": "f", "float64": "d"},
}
# Serializers pad to four bytes; PX4 sends its whole buffer, which is larger than the message.
_TRAILING_BYTES = 3
_TRAILING_BYTES_PX4 = 128

# (bytes after the header, position) -> (value, position after it); positions count from the header's end
_Read = Callable[[bytes, int], tuple[Any, int]]


class CdrDecoder:
    """Decodes messages of one type by its definition (:func:`adapters.encoding.message_definition.parse_definitions`).

    Raises
    ------
    TelemetryError
        The definition is not valid, lacks a type it uses, or needs an unsupported type (wstring).
    """

    def __init__(self, definition_name: str, definition_text: str) -> None:
        self._name = canonical_type(definition_name)
        definitions = parse_definitions(definition_name, definition_text)
        self._trailing = _TRAILING_BYTES_PX4 if self._name.startswith("px4_msgs/") else _TRAILING_BYTES
        self._readers = {
            head: _Compiler(order, definitions).message(self._name) for head, order in _BYTE_ORDERS.items()
        }

    def decode(self, payload: bytes) -> dict[str, Any]:
        """Return a message's fields: numbers, truth values, texts, lists of these and nested fields.

        Raises
        ------
        PayloadError
            The payload is cut off, too long, not plain CDR, or has an impossible length.
        """
        head = self._readers.get(payload[:2])
        if head is None or len(payload) < 4:
            raise PayloadError(f"{self._name}: not plain CDR: begins with {payload[:4].hex(' ') or 'nothing'}")
        read, least = head
        body = payload[4:]
        if least > len(body):
            raise PayloadError(f"{self._name}: cut off")
        try:
            fields, end = read(body, 0)
        except struct.error as error:
            raise PayloadError(f"{self._name}: cut off") from error
        except PayloadError as error:
            raise PayloadError(f"{self._name}: {error}") from error
        if not 0 <= len(body) - end <= self._trailing:
            size = f"{len(body)} bytes where the definition has {end}"
            raise PayloadError(f"{self._name}: {size}; is it of another version?")
        return dict(fields)


class _Compiler:
    """Turns definitions into functions that read; each with the least number of bytes that it reads."""

    def __init__(self, order: str, definitions: Definitions) -> None:
        self._order = order
        self._definitions = definitions
        self._messages: dict[str, tuple[_Read, int]] = {}
        self._open: list[str] = []
        self._length, _ = _number(order, "I")

    def message(self, kind: str) -> tuple[_Read, int]:
        """Return the reader of a message type."""
        if kind in self._messages:
            return self._messages[kind]
        if kind not in self._definitions:
            raise TelemetryError(f"definition of {self._open[-1] if self._open else kind}: {kind} is not defined")
        if kind in self._open or len(self._open) >= MAX_NESTING:
            raise TelemetryError(f"definition of {self._open[0]}: {kind} is inside itself or nested too deeply")
        self._open.append(kind)
        made = self._fields(self._definitions[kind])
        self._open.pop()
        self._messages[kind] = made
        return made

    def _fields(self, fields: Sequence[MessageField]) -> tuple[_Read, int]:
        named = bool(fields)
        # IDL knows no empty structure: one byte takes its place
        fields = fields or (MessageField("structure_needs_at_least_one_member", "uint8"),)
        readers = [(field.name, *self._field(field)) for field in fields]

        def read_fields(data: bytes, position: int) -> tuple[dict[str, Any], int]:
            values: dict[str, Any] = {}
            for name, read, _ in readers:
                values[name], position = read(data, position)
            return (values if named else {}), position

        return read_fields, sum(least for _, _, least in readers)

    def _field(self, field: MessageField) -> tuple[_Read, int]:
        if field.type == "wstring":
            raise TelemetryError(f"definition of {self._open[-1]}: wstring ('{field.name}') is not supported")
        if field.type in _CODES:
            return self._numbers(field) if _many(field) else _number(self._order, _CODES[field.type])
        element, least = (self._text, 4) if field.type == "string" else self.message(field.type)
        if not _many(field):
            return element, least
        length = self._length

        def read_elements(data: bytes, position: int) -> tuple[list[Any], int]:
            count, position = (field.size, position) if field.size is not None else length(data, position)
            _check(field, count, least, len(data) - position)
            elements = []
            for _ in range(count):
                value, position = element(data, position)
                elements.append(value)
            return elements, position

        return read_elements, 4 if field.size is None else least * field.size

    def _numbers(self, field: MessageField) -> tuple[_Read, int]:
        order, code, length = self._order, _CODES[field.type], self._length
        size = struct.calcsize("=" + code)

        def read_numbers(data: bytes, position: int) -> tuple[list[Any], int]:
            count, position = (field.size, position) if field.size is not None else length(data, position)
            if count:
                position += -position % size
            _check(field, count, size, len(data) - position)
            return list(struct.unpack_from(f"{order}{count}{code}", data, position)), position + count * size

        return read_numbers, 4 if field.size is None else size * field.size

    def _text(self, data: bytes, position: int) -> tuple[str, int]:
        """Read a text: its length including the closing zero (some leave both out), then UTF-8, wrong bytes marked."""
        count, position = self._length(data, position)
        end = position + count
        if end > len(data) or (count and data[end - 1]):
            raise PayloadError("a text is cut off or does not end")
        return data[position : max(position, end - 1)].decode(errors="replace"), end


def _number(order: str, code: str) -> tuple[Callable[[bytes, int], tuple[Any, int]], int]:
    """Return the function that reads a number, and the number's bytes."""
    shape = struct.Struct(order + code)
    size = shape.size

    def read_number(data: bytes, position: int) -> tuple[Any, int]:
        position += -position % size
        return shape.unpack_from(data, position)[0], position + size

    return read_number, size


def _many(field: MessageField) -> bool:
    return field.sequence or field.size is not None


def _check(field: MessageField, count: int, least: int, left: int) -> None:
    """Reject a number of elements that the remaining bytes cannot hold."""
    if count * least > left or (field.at_most is not None and count > field.at_most):
        raise PayloadError(f"'{field.name}' claims {count} elements, more than there can be")
