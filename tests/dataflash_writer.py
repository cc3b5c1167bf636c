"""Writes DataFlash logs as ArduPilot does: FMT first, then UNIT, MULT and FMTU, then records."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

_CODES = {
    **{"a": "64s", "b": "b", "B": "B", "g": "e", "h": "h", "H": "H", "i": "i", "I": "I", "f": "f", "n": "4s"},
    **{
        "N": "16s",
        "Z": "64s",
        "c": "h",
        "C": "H",
        "e": "i",
        "E": "I",
        "L": "i",
        "d": "d",
        "M": "b",
        "q": "q",
        "Q": "Q",
    },
}
_TIMES = {"c": 100.0, "C": 100.0, "e": 100.0, "E": 100.0, "L": 1e7}
_UNITS = (("-", ""), ("s", "s"), ("#", "instance"), ("m", "m"), ("D", "deglatitude"), ("U", "deglongitude"))


class DataflashWriter:
    """Collects the bytes of a log."""

    def __init__(self, start_us: int = 1) -> None:
        self.data = bytearray()
        self.ends: list[int] = []
        self._kinds = {"FMT": 128}
        self._codes = {"FMT": "BBnNZ"}
        self._format(128, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns")
        self.define("UNIT", "QbZ", "TimeUS,Id,Label")
        self.define("MULT", "Qbd", "TimeUS,Id,Mult")
        self.define("FMTU", "QBNN", "TimeUS,FmtType,UnitIds,MultIds")
        for code, unit in _UNITS:
            self.add("UNIT", start_us, ord(code), unit)
        for code, mult in (("-", 0.0), ("F", 1e-6), ("0", 1.0)):
            self.add("MULT", start_us, ord(code), mult)

    def define(self, name: str, codes: str, columns: str, units: str = "") -> None:
        kind = 129 + len(self._kinds)
        self._kinds[name], self._codes[name] = kind, codes
        self._format(kind, name, codes, columns)
        if units:
            self.add("FMTU", 1, kind, units, "F" + "-" * (len(codes) - 1))

    def add(self, name: str, *values: Any) -> None:
        body = b""
        for code, value in zip(self._codes[name], values, strict=True):
            if code == "a":
                body += struct.pack("<32h", *value)
            elif isinstance(value, str):
                body += struct.pack(_CODES[code], value.encode())
            elif code in _TIMES:
                body += struct.pack("<" + _CODES[code], round(value * _TIMES[code]))
            else:
                body += struct.pack("<" + _CODES[code], value)
        self._record(self._kinds[name], body)

    def write(self, path: Path) -> Path:
        path.write_bytes(self.data)
        return path

    def _format(self, kind: int, name: str, codes: str, columns: str) -> None:
        length = 3 + struct.calcsize("<" + "".join(_CODES[code] for code in codes))
        self._record(128, struct.pack("<BB4s16s64s", kind, length, name.encode(), codes.encode(), columns.encode()))

    def _record(self, kind: int, body: bytes) -> None:
        self.data += b"\xa3\x95" + bytes([kind]) + body
        self.ends.append(len(self.data))
