"""Writes ULog files as PX4's logger does; https://docs.px4.io/main/en/dev_log/ulog_file_format."""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping, Sequence
from itertools import takewhile
from pathlib import Path
from typing import Any

SYNC = b"\x2f\x73\x13\x20\x25\x0c\xbb\x12"
_CODES = {
    **{"int8_t": "b", "uint8_t": "B", "int16_t": "h", "uint16_t": "H", "int32_t": "i", "uint32_t": "I"},
    **{"int64_t": "q", "uint64_t": "Q", "float": "f", "double": "d", "bool": "?"},
}


class UlogWriter:
    """Collects the bytes of a log; topics are defined by ``type[count] name`` lines joined by semicolons."""

    def __init__(self, start_us: int = 0, appended: Sequence[int] = (), incompatible: int = 0) -> None:
        flags = incompatible | (1 if appended else 0)
        offsets = [*appended, 0, 0, 0][:3]
        self.data = bytearray(struct.pack("<7sBQ", b"ULog\x01\x12\x35", 1, start_us))
        self.formats: dict[str, list[tuple[str, int | None, str]]] = {}
        self._padding: dict[str, int] = {}
        self._packing: dict[str, struct.Struct] = {}
        self.ends: list[int] = []
        self._ids = 0
        self.record("B", struct.pack("<8s8s3Q", bytes(8), bytes([flags]) + bytes(7), *offsets))

    def record(self, kind: str, body: bytes) -> None:
        self.data += struct.pack("<HB", len(body), ord(kind)) + body
        self.ends.append(len(self.data))

    def define(self, name: str, fields: str) -> None:
        found = re.findall(r"(\w+)(?:\[(\d+)\])? (\w+)", fields)
        self.formats[name] = [(kind, int(count) if count else None, field) for kind, count, field in found]
        # padding at the end of a record is not written
        ending = list(takewhile(lambda one: one[2].startswith("_padding"), reversed(self.formats[name])))
        self._padding[name] = sum(struct.calcsize(_CODES[kind]) * (count or 1) for kind, count, _ in ending)
        self.record("F", f"{name}:{fields};".encode())

    def subscribe(self, name: str, instance: int = 0) -> int:
        self._ids += 1
        self.record("A", struct.pack("<BH", instance, self._ids) + name.encode())
        return self._ids

    def add(self, number: int, name: str, values: Mapping[str, Any]) -> None:
        if name not in self._packing:
            self._packing[name] = struct.Struct(f"<H{self._codes(name)}")
        body = self._packing[name].pack(number, *self._flat(name, values))
        self.record("D", body[: len(body) - self._padding[name]])

    def information(self, key: str, value: str) -> None:
        self.keyed("I", f"char[{len(value)}] {key}", value.encode())

    def parameter(self, name: str, value: float) -> None:
        kind = "int32_t" if isinstance(value, int) else "float"
        self.keyed("P", f"{kind} {name}", struct.pack("<" + _CODES[kind], value))

    def keyed(self, kind: str, key: str, value: bytes, ahead: bytes = b"") -> None:
        self.record(kind, ahead + bytes([len(key)]) + key.encode() + value)

    def text(self, time_us: int, text: str, level: int = 6) -> None:
        self.record("L", struct.pack("<BQ", ord("0") + level, time_us) + text.encode())

    def dropout(self, ms: int) -> None:
        self.record("O", struct.pack("<H", ms))

    def sync(self) -> None:
        self.record("S", SYNC)

    def write(self, path: Path) -> Path:
        path.write_bytes(self.data)
        return path

    def _codes(self, name: str) -> str:
        """Return the codes of all fields for :mod:`struct`."""
        codes = []
        for kind, count, _ in self.formats[name]:
            one = _CODES.get(kind) or ("" if kind == "char" else self._codes(kind))
            codes.append(f"{count or 1}s" if kind == "char" else one * (count or 1))
        return "".join(codes)

    def _flat(self, name: str, values: Mapping[str, Any]) -> list[Any]:
        """Return the values of all fields."""
        flat: list[Any] = []
        for kind, count, field in self.formats[name]:
            value = values.get(field, 0)
            if kind == "char":
                flat.append(str(value).encode())
            elif kind not in _CODES:
                for one in value if count else [value]:
                    flat += self._flat(kind, one)
            elif count:
                flat += value or [0] * count
            else:
                flat.append(value)
        return flat
