"""CDR, the encoding of ROS 2 and PX4 messages in transit: bytes -> nested fields, by the message's definition."""

import struct
from typing import Any

from adapters.encoding.message_definition import canonical_type
from adapters.errors import PayloadError, TelemetryError, printable

_LONGEST_DEFINITION = 1 << 20
"""Longest definition, characters. Chosen: definitions of ROS 2, including all types they use, have some thousands."""
_PLAIN = (b"\x00\x00", b"\x00\x01")
"""What plain CDR begins with, in either byte order (XTypes 1.3, section 7.4); other encapsulations are not decoded."""
_SCALARS = frozenset((bool, int, float, str))


class CdrDecoder:
    """Decodes messages of one type by its definition, the text of .msg files as ROS 2 writes it into MCAP files.

    Raises
    ------
    TelemetryError
        The text is no definition.
    """

    def __init__(self, definition_name: str, definition_text: str) -> None:
        from mcap.records import Schema
        from mcap_ros2.decoder import DecoderFactory

        self._name = canonical_type(definition_name)
        if len(definition_text) > _LONGEST_DEFINITION:
            raise TelemetryError(f"definition of {self._name}: longer than {_LONGEST_DEFINITION} characters")
        # without comments, which the parser searches for units, and without control characters, as it prints mistakes
        lines = (printable(line.partition("#")[0].expandtabs().strip()) for line in definition_text.splitlines())
        schema = Schema(id=0, name=self._name, encoding="ros2msg", data="\n".join(lines).encode(errors="replace"))
        try:
            self._read: Any = DecoderFactory().decoder_for("cdr", schema)
        except Exception as error:
            # the parser of ROS 2 has a dozen errors of its own
            raise TelemetryError(f"definition of {self._name}: {error}") from error

    def decode(self, payload: bytes) -> dict[str, Any]:
        """Return a message's fields: numbers, truth values, texts, lists of these and nested fields.

        Raises
        ------
        PayloadError
            The payload is no plain CDR, ends before its last number, or the definition lacks a type it uses.
        """
        if payload[:2] not in _PLAIN or len(payload) < 4:
            raise PayloadError(f"{self._name}: not plain CDR: begins with {payload[:4].hex(' ') or 'nothing'}")
        try:
            return dict(_fields(self._read(payload)))
        except struct.error as error:
            raise PayloadError(f"{self._name}: cut off") from error
        except (ValueError, NotImplementedError, RecursionError) as error:
            # NotImplementedError: the library does not read wide strings (wstring)
            raise PayloadError(f"{self._name}: {error}") from error


def _fields(value: Any) -> Any:
    """Return a decoded message as a mapping, bytes as a list of numbers, other values as they are."""
    kind = type(value)
    if kind in _SCALARS:
        return value
    if kind is bytes or kind is list:
        return list(map(_fields, value))
    return {name: _fields(getattr(value, name)) for name in value.__slots__}
