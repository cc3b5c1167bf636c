"""Payloads of Zenoh telemetry -> named fields: JSON objects, and CDR if the message's type is known."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from adapters.encoding.cdr import CdrDecoder
from adapters.encoding.foreign_record import json_object
from adapters.encoding.message_definition import canonical_type, find_definition
from adapters.errors import PayloadError, TelemetryError, UndefinedTypeError

_CDR = "application/cdr"
# The type is checked afterwards: the regular expression would backtrack with two open ends in one chunk.
_RMW_KEY = re.compile(r"\d+/(.+)/([^/]+)/RIHS\d+_[^/]+")
_MAX_KEYS = 4096


class PayloadDecoder:
    """Decodes samples by key and encoding.

    The type of a CDR payload is the first of these that is given: the type for its key in ``types``; the schema of its
    encoding (``application/cdr;sensor_msgs/msg/Imu``); the type in a key of rmw_zenoh (``<domain>/<topic>/<type>/<type
    hash>``). Everything else is JSON. From a key of rmw_zenoh, messages get the name of the topic, so that profiles
    contain neither domain nor type hash, which change with the installation; other keys are names as they are.

    Of ``types`` by key expression the first that matches is used; ``definitions`` are folders of .msg files, see
    :func:`adapters.encoding.message_definition.find_definition`.

    Raises
    ------
    TelemetryError
        A key expression or a type is not valid, or a type has no definition.
    """

    def __init__(self, types: Mapping[str, str] | None = None, definitions: Sequence[Path] = ()) -> None:
        import zenoh

        self._folders = tuple(definitions)
        for folder in self._folders:
            if not folder.is_dir():
                raise TelemetryError(f"{folder}: no such folder of message definitions")
        self._decoders: dict[str, CdrDecoder | None] = {}
        self._keys: dict[tuple[str, str], tuple[str, str | None]] = {}
        self._types: list[tuple[zenoh.KeyExpr, str]] = []
        for key, type_name in (types or {}).items():
            try:
                self._types.append((zenoh.KeyExpr(key), canonical_type(type_name)))
            except zenoh.ZError as error:
                raise TelemetryError(f"'{key}' is not a Zenoh key expression") from error
            except TelemetryError as error:
                raise TelemetryError(f"type of '{key}': {error}") from error
            self._add(type_name)

    def decode(self, key: str, encoding: str, payload: bytes) -> tuple[str, dict[str, Any]]:
        """Return the message's name and its fields.

        Raises
        ------
        UndefinedTypeError
            The payload is CDR, and its type or the type's definition is unknown.
        PayloadError
            The payload does not have the expected form.
        """
        name, kind = self._look_up(key, encoding)
        if kind is None:
            return name, _fields(payload)
        decoder = self._decoders.get(kind)
        if decoder is None:
            raise UndefinedTypeError(f"CDR, and no definition of {kind}" if kind else "CDR of an unknown type")
        return name, decoder.decode(payload)

    def _look_up(self, key: str, encoding: str) -> tuple[str, str | None]:
        """Return the message name and type of a key: None for JSON, empty for CDR of an unknown type."""
        known = self._keys.get((key, encoding))
        if known is None:
            if len(self._keys) >= _MAX_KEYS:
                self._keys.clear()
            known = self._keys[key, encoding] = self._classify(key, encoding)
        return known

    def _classify(self, key: str, encoding: str) -> tuple[str, str | None]:
        ros = _RMW_KEY.fullmatch(key)
        if ros and "::" not in ros[2]:
            ros = None
        name = ros[1] if ros else key
        for expression, type_name in self._types:
            if expression.includes(key):
                return name, type_name
        media, _, schema = encoding.partition(";")
        said = schema if media == _CDR and schema else ros[2] if ros else ""
        try:
            kind = canonical_type(said)
        except TelemetryError:
            return name, "" if ros or media == _CDR else None
        if kind not in self._decoders and len(self._decoders) < _MAX_KEYS:
            try:
                self._add(kind)
            except TelemetryError:
                self._decoders[kind] = None
        return name, kind

    def _add(self, type_name: str) -> None:
        self._decoders[canonical_type(type_name)] = CdrDecoder(type_name, find_definition(type_name, self._folders))


def _fields(payload: bytes) -> dict[str, Any]:
    try:
        return json_object(payload)
    except ValueError as error:
        # the first byte of CDR, with which no JSON begins
        cdr = "; if it is CDR, name its type in [zenoh_types]" if payload[:1] == b"\0" else ""
        raise PayloadError(f"{error}{cdr}") from error
