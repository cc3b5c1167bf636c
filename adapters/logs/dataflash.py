"""Onboard logs of ArduPilot (DataFlash .bin, plain or .xz / .gz): records in the order they were logged.

A record is two bytes that mark it, its kind, and fields by the format that the log itself defines for that kind. There
are no checksums: damage shows only where no record stands.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from adapters.errors import TelemetryError
from adapters.logs.log_bytes import LogStatistics, Window, text
from adapters.message import LATEST_NS, Message

SOURCE: Final = "dataflash"

# struct code, and by how much to divide: pymavlink's DFReader decodes the same, which the tests hold it against.
CODES: Final[dict[str, tuple[str, float | None]]] = {
    "a": ("64s", None),
    "b": ("b", None),
    "B": ("B", None),
    "g": ("e", None),
    "h": ("h", None),
    "H": ("H", None),
    "i": ("i", None),
    "I": ("I", None),
    "f": ("f", None),
    "n": ("4s", None),
    "N": ("16s", None),
    "Z": ("64s", None),
    "c": ("h", 100.0),
    "C": ("H", 100.0),
    "e": ("i", 100.0),
    "E": ("I", 100.0),
    "L": ("i", 1e7),
    "d": ("d", None),
    "M": ("b", None),
    "q": ("q", None),
    "Q": ("Q", None),
}
_MARK = b"\xa3\x95"
_HEAD_BYTES = 3
_FORMAT_KIND = 128
_ARRAY = struct.Struct("<32h")
_INSTANCE = "#"
_SEARCHED_AT_ONCE = 1 << 16
# Boards that log in blocks fill the last one up; pymavlink passes over as many.
_PADDING_BYTES = 528
_GPS_EPOCH_S = 315_964_800
_WEEK_S = 604_800
# Since 2017; GPS time knows no leap seconds, and what the log holds is GPS time.
_LEAP_S = 18
_FIX_3D = 3


@dataclass(slots=True)
class _Format:
    """One kind of record: its name, length, and what turns the values at some places into fields."""

    name: str
    length: int
    columns: list[str]
    unpack: Callable[[bytes], tuple[Any, ...]]
    wanted: bool = True
    instance: int | None = None
    conversions: list[tuple[int, Callable[[Any], Any]]] = field(default_factory=list)

    def decode(self, data: bytes) -> tuple[str, dict[str, Any]]:
        """Return name and fields of a record without its mark and kind."""
        values = list(self.unpack(data))
        for place, convert in self.conversions:
            values[place] = convert(values[place])
        instance = values[self.instance] if self.instance is not None else 0
        several = bool(instance) and isinstance(instance, int | str)
        return f"{self.name}/{instance}" if several else self.name, dict(zip(self.columns, values, strict=True))


class DataflashReader:
    """Reads an onboard log of ArduPilot in the order it was written, over damage if need be.

    Records come under their names, ``BARO/1`` being the second instance where the log says which field tells
    instances apart (unit ``#``). Values are decoded as pymavlink's DFReader does. Time of arrival is the record's own
    time since boot (``TimeUS``, in old logs ``TimeMS``) on the relation of boot to UTC in the first 3D fix of
    ``GPS``; without any, boot is the start of 1970. Records without a time have that of the one before. Iterate once;
    :meth:`statistics` tells what was found.

    Parameters
    ----------
    path : str | PathLike
        The log.
    only : Collection[str] | None
        Names of the messages wanted; None wants all.
    utc_minus_boot_ns : int | None
        Where that relation is known already; None looks for it in the log.
    """

    def __init__(
        self, path: str | os.PathLike[str], only: Collection[str] | None = None, utc_minus_boot_ns: int | None = None
    ) -> None:
        self._path = Path(path)
        self._only = only
        self._offset_ns = utc_minus_boot_ns
        self._newest_ns = 0
        formats = _format("FMT", 89, "BBnNZ", "Type,Length,Name,Format,Columns")
        formats.wanted = self._wanted("FMT")
        self._formats: dict[int, _Format] = {_FORMAT_KIND: formats}
        self._records = self._damaged = self._skipped_bytes = 0
        self._broken_off = False

    def statistics(self) -> LogStatistics:
        """Return the counts so far."""
        return LogStatistics(self._records, 0, self._damaged, self._skipped_bytes, self._broken_off)

    def __iter__(self) -> Iterator[Message]:
        """Return the wanted messages.

        Raises
        ------
        TelemetryError
            The file cannot be opened or is no such log.
        """
        if self._offset_ns is None:
            self._offset_ns = utc_minus_boot_ns(self._path) or 0
        window, formats, only = Window(self._path), self._formats, self._only
        if not window.fill(_HEAD_BYTES) or window.data[:_HEAD_BYTES] != _MARK + bytes([_FORMAT_KIND]):
            raise TelemetryError(
                f"{self._path}: not a DataFlash log although its name says so; check where it came from"
            )
        while window.fill(_HEAD_BYTES):
            form = formats.get(window.data[window.at + 2]) if window.data.startswith(_MARK, window.at) else None
            if form is None:
                if not self._resume(window):
                    break
                continue
            if not window.fill(form.length):
                if not self._resume(window, end=True):
                    break
                continue
            body = window.data[window.at + _HEAD_BYTES : window.at + form.length]
            if form is formats[_FORMAT_KIND] and not self._define(form, body):
                self._resume(window)
                continue
            if form.name == "FMTU":
                self._learn_instances(form, body)
            self._records += 1
            window.at += form.length
            if not form.wanted:
                continue
            name, fields = form.decode(body)
            if only is None or name in only:
                yield Message(SOURCE, name, self._time_ns(fields, self._offset_ns), fields)
        self._broken_off = window.cut or window.left > 0
        self._skipped_bytes += window.left

    def _time_ns(self, fields: dict[str, Any], offset_ns: int) -> int:
        """Return the time of a record, that of the one before where it has none or a damaged one."""
        stamp, unit_ns = fields.get("TimeUS"), 1_000
        if stamp is None:
            stamp, unit_ns = fields.get("TimeMS"), 1_000_000
        if type(stamp) is int and 0 <= stamp * unit_ns + offset_ns < LATEST_NS:
            self._newest_ns = stamp * unit_ns
        return self._newest_ns + offset_ns

    def _learn_instances(self, form: _Format, body: bytes) -> None:
        """Learn from a record of units which field tells instances apart."""
        fields = form.decode(body)[1]
        defined = self._formats.get(_whole(fields.get("FmtType")))
        place = str(fields.get("UnitIds", "")).find(_INSTANCE)
        if defined is not None and 0 <= place < len(defined.columns):
            defined.instance = place

    def _define(self, form: _Format, body: bytes) -> bool:
        """Learn a format; return whether the record is one."""
        fields = form.decode(body)[1]
        kind, length, name = fields["Type"], fields["Length"], fields["Name"]
        try:
            made = _format(name, length, fields["Format"], fields["Columns"])
        except ValueError:
            return False
        if kind == _FORMAT_KIND:
            return made.length == form.length
        before = self._formats.get(kind)
        if before is not None and before.columns == made.columns:
            made.instance = before.instance
        made.wanted = self._wanted(name)
        self._formats[kind] = made
        return True

    def _wanted(self, name: str) -> bool:
        """Return whether any instance of a kind is wanted."""
        return self._only is None or any(one.partition("/")[0] == name for one in self._only)

    def _stands(self, window: Window, ahead: int) -> bool:
        """Return whether a record of a known kind, or the end, stands so many bytes ahead."""
        if not window.fill(ahead + _HEAD_BYTES):
            return window.left == ahead
        at = window.at + ahead
        return window.data.startswith(_MARK, at) and window.data[at + 2] in self._formats

    def _standing(self, window: Window, searched: int) -> int | None:
        """Return how many bytes ahead a record with another behind it stands."""
        start, at = window.at, window.at
        while (at := window.data.find(_MARK, at + 1, start + searched)) >= 0:
            form = self._formats.get(window.data[at + 2]) if at + 2 < len(window.data) else None
            if form is not None and self._stands(window, at - start + form.length):
                return at - start
        return None

    def _resume(self, window: Window, *, end: bool = False) -> bool:
        """Move on to where records stand again; False where none do, and nothing is left but the end of the file."""
        while True:
            more = window.fill(_SEARCHED_AT_ONCE + 512)
            searched = _SEARCHED_AT_ONCE if more else window.left
            ahead = self._standing(window, searched)
            if ahead is not None or end or not more:
                break
            window.at += searched - 1
            self._skipped_bytes += searched - 1
        if ahead is None:
            padding = not end and window.left <= _PADDING_BYTES and not window.cut
            if not end:
                self._damaged += not padding
                self._skipped_bytes += 0 if padding else window.left
                window.at += window.left
            return False
        self._damaged += 1
        self._skipped_bytes += ahead
        window.at += ahead
        return True


def _format(name: str, length: int, codes: str, columns: str) -> _Format:
    """Return a format; ValueError where none is defined that way."""
    if not name.isascii() or not name.isprintable() or not name or "/" in name:
        raise ValueError("no name of a format")
    if any(code not in CODES for code in codes):
        raise ValueError(f"unknown code in {codes}")
    names = columns.split(",") if columns else []
    whole = struct.Struct("<" + "".join(CODES[code][0] for code in codes))
    if len(names) != len(codes) or len(set(names)) != len(names) or whole.size + _HEAD_BYTES != length:
        raise ValueError(f"format of {name} contradicts itself")
    conversions: list[tuple[int, Callable[[Any], Any]]] = []
    for place, code in enumerate(codes):
        divisor = CODES[code][1]
        if divisor is not None:
            conversions.append((place, divisor.__rtruediv__))
        elif code == "a":
            conversions.append((place, _array))
        elif code in "nNZ":
            # pieces of files may hold anything, zeros included
            conversions.append((place, _raw if name == "FILE" and code == "Z" else _text))
    return _Format(name, length, names, whole.unpack, conversions=conversions)


def _array(data: bytes) -> list[int]:
    return list(_ARRAY.unpack(data))


def _text(data: bytes) -> str:
    return text(data.split(b"\0", 1)[0])


def _raw(data: bytes) -> str:
    return data.decode("latin-1")


def utc_minus_boot_ns(path: str | os.PathLike[str]) -> int | None:
    """Return UTC minus time since boot in nanoseconds, from the first 3D fix in a log; None without one."""
    for message in DataflashReader(path, ("GPS",), 0):
        week, ms, boot_us, status = (_whole(message.fields.get(name)) for name in ("GWk", "GMS", "TimeUS", "Status"))
        if week > 0 and boot_us > 0 and status >= _FIX_3D:
            utc_ms = (_GPS_EPOCH_S + _WEEK_S * week - _LEAP_S) * 1_000 + ms
            found_ns = utc_ms * 1_000_000 - boot_us * 1_000
            if 0 <= found_ns < LATEST_NS:
                return found_ns
    return None


def _whole(value: Any) -> int:
    return value if type(value) is int else 0
