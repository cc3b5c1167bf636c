"""Onboard logs of ArduPilot (DataFlash .bin, plain or .xz / .gz): records in the order they were logged.

A record is two bytes that mark it, its kind, and fields by the format that the log itself defines for that kind. There
are no checksums: damage shows only where there is no record.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from adapters.batch import Batch
from adapters.errors import TelemetryError
from adapters.logs.onboard_log import (
    READ_AHEAD_BYTES,
    FieldValues,
    LayoutField,
    LogClock,
    OnboardLogStatistics,
    RecordKind,
    RecordLayout,
    Records,
    StartScan,
    Window,
    first_relation,
    layout,
    record_text,
)
from adapters.source import DATAFLASH

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
_ARRAY = "a"
_INSTANCE = "#"
_SEARCHED_AT_ONCE = 1 << 16
"""Bytes in which to look for the next record at a time. Chosen: little beside a batch, many beside a record."""
_LARGEST_RECORD = 256
_PADDING_BYTES = 528
"""Boards that log in blocks fill the last one up; pymavlink passes over as many bytes."""
_RELATION = ("GWk", "GMS", "Week", "TimeMS", "Status")
_SCANNED_BYTES = 1 << 20
"""Bytes of a log read at a time to find its clock. Measured: twenty thousand records have 1.1 MB."""
_GPS_EPOCH_S = 315_964_800
_WEEK_S = 604_800
# Since 2017; GPS time knows no leap seconds, and what the log holds is GPS time.
_LEAP_S = 18
_FIX_3D = 3


@dataclass(slots=True)
class _Format:
    """A kind of record as the log defines it."""

    kind: RecordKind  # its name and fields
    length: int  # its bytes with mark and number
    columns: tuple[str, ...]  # names of all fields
    defines: bool = False  # whether its records say what others look like


class DataflashReader:
    """Reads an onboard log of ArduPilot in the order it was written, over damage if need be, as batches.

    Records come under their names, ``BARO/1`` being the second instance where the log says which field tells
    instances apart (unit ``#``). Values are decoded as pymavlink's DFReader does. Time of arrival is the record's own
    time since boot (``TimeUS``, in old logs ``TimeMS``) on the relation of boot to UTC in the first 3D fix of
    ``GPS``; without any, boot is the start of 1970. Records without a time of the log's clock have that of the one
    before (:class:`LogClock`). Of records whose format contradicts itself, as some of ArduPilot's own do, the fields
    that fit are decoded. That a log ends within a record is no damage: it does wherever power is cut. Iterate once;
    :meth:`statistics` tells what was found.

    Parameters
    ----------
    path : str | PathLike
        The log.
    only : Collection[str] | None
        Names of the messages wanted; None wants all.
    utc_minus_boot_ns : int | None
        Where that relation is known already; None looks for it in the log.
    read_ahead_bytes : int
        Bytes of the log, decompressed, in a batch.
    clock : LogClock | None
        What gives the records their times; None finds it in the log.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        only: Collection[str] | None = None,
        utc_minus_boot_ns: int | None = None,
        read_ahead_bytes: int = READ_AHEAD_BYTES,
        clock: LogClock | None = None,
    ) -> None:
        self._path = Path(path)
        self._only = only
        self._offset_ns = utc_minus_boot_ns
        self._clock = clock
        self._read_ahead_bytes = read_ahead_bytes
        formats = self._format("FMT", 89, "BBnNZ", "Type,Length,Name,Format,Columns")
        formats.defines = True
        # by the bytes that records begin with
        self._heads = {_head(_FORMAT_KIND): formats}
        self._records = self._damaged = self._skipped_bytes = 0
        self._broken_off = False

    def statistics(self) -> OnboardLogStatistics:
        """Return the counts so far."""
        return OnboardLogStatistics(self._records, 0, self._damaged, self._skipped_bytes, self._broken_off)

    def __iter__(self) -> Iterator[Batch]:
        """Return the batches in which there are wanted messages.

        Raises
        ------
        TelemetryError
            The file cannot be opened or is no such log.
        """
        window = Window(self._path, self._read_ahead_bytes)
        if not window.fill(_HEAD_BYTES) or window.data[:_HEAD_BYTES] != _MARK + bytes([_FORMAT_KIND]):
            raise TelemetryError(
                f"{self._path}: not a DataFlash log although its name says so; check where it came from"
            )
        records = Records(DATAFLASH, self._clock or _log_clock(self._path, self._offset_ns), self._only)
        while window.fill(_HEAD_BYTES):
            if records.data is not window.data:
                if records.start:
                    yield records.batch()
                records.data = window.data
            self._chain(window, records)
            if window.fill(_HEAD_BYTES) and not self._single(window):
                break
        if records.start:
            yield records.batch()
        # bytes that are left are of the record that was being written when power was cut
        self._broken_off = window.cut
        self._skipped_bytes += window.left

    def _chain(self, window: Window, records: Records) -> None:
        """Take the records that follow one another among the bytes held."""
        data, at, heads = window.data, window.at, self._heads
        end = len(data)
        start, kind = records.start, records.kind
        count = 0
        while True:
            form = heads.get(data[at : at + _HEAD_BYTES])
            if form is None:
                break
            behind = at + form.length
            if behind > end or (form.defines and not self._learn(form, data[at + _HEAD_BYTES : behind])):
                break
            count += 1
            if form.kind.wanted:
                start.append(at + _HEAD_BYTES)
                kind.append(form.kind)
            at = behind
        self._records += count
        window.at = at

    def _single(self, window: Window) -> bool:
        """Go on from what ends a chain to where the next record is; return whether there may be any."""
        form = self._heads.get(window.data[window.at : window.at + _HEAD_BYTES])
        if form is None:
            return self._resume(window)
        if not window.fill(form.length):
            return self._resume(window, end=True)
        # a record that defines nothing after all is damage; before any other one the chain only ran out of bytes
        body = window.data[window.at + _HEAD_BYTES : window.at + form.length]
        return not form.defines or self._learn(form, body) or self._resume(window)

    def _learn(self, form: _Format, body: bytes) -> bool:
        """Learn from a record what others look like; return whether it is one."""
        fields = form.kind.layout.rows(np.frombuffer(body, form.kind.layout.dtype))[0]
        if form is self._heads[_head(_FORMAT_KIND)]:
            return self._define(form, fields)
        defined = self._heads.get(_head(_whole(fields.get("FmtType"))))
        place = str(fields.get("UnitIds", "")).find(_INSTANCE)
        if defined is not None and 0 <= place < len(defined.columns):
            instance = defined.columns[place]
            if instance != defined.kind.instance:
                # records that came before keep their names
                defined.kind = replace(defined.kind, instance=instance)
        return True

    def _define(self, form: _Format, fields: Mapping[str, Any]) -> bool:
        """Learn a format; return whether the record is one."""
        try:
            made = self._format(fields["Name"], fields["Length"], fields["Format"], fields["Columns"])
        except ValueError:
            return False
        number = fields["Type"]
        if number == _FORMAT_KIND:
            return made.length == form.length
        before = self._heads.get(_head(number))
        if before is not None and before.columns == made.columns:
            made.kind.instance = before.kind.instance
        made.defines = made.kind.name == "FMTU"
        self._heads[_head(number)] = made
        return True

    def _format(self, name: str, length: int, codes: str, columns: str) -> _Format:
        """Return a format; ValueError where none is defined that way."""
        if not name.isascii() or not name.isprintable() or not name or "/" in name or length < _HEAD_BYTES:
            raise ValueError("no format")
        names = columns.split(",") if columns else []
        kind = _layout(name, codes, names, length - _HEAD_BYTES)
        # any instance of the kind may be wanted
        wanted = self._only is None or any(wanted_name.partition("/")[0] == name for wanted_name in self._only)
        return _Format(RecordKind(name, kind, wanted), length, tuple(names))

    def _stands(self, window: Window, ahead: int) -> bool:
        """Return whether a record of a known kind, or the end, is so many bytes ahead."""
        if not window.fill(ahead + _HEAD_BYTES):
            return window.left == ahead
        at = window.at + ahead
        return window.data[at : at + _HEAD_BYTES] in self._heads

    def _standing(self, window: Window, searched: int) -> int | None:
        """Return how many bytes ahead the next record with another behind it begins."""
        start, at = window.at, window.at
        while (at := window.data.find(_MARK, at + 1, start + searched)) >= 0:
            form = self._heads.get(window.data[at : at + _HEAD_BYTES])
            if form is not None and self._stands(window, at - start + form.length):
                return at - start
        return None

    def _resume(self, window: Window, *, end: bool = False) -> bool:
        """Move on to the next records; return False where there are none up to the end of the file."""
        while True:
            more = window.fill(_SEARCHED_AT_ONCE + 2 * _LARGEST_RECORD)
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


def _head(number: int) -> bytes:
    """Return what the records of a kind begin with."""
    return _MARK + bytes([number]) if 0 <= number < 256 else b""


def _layout(name: str, codes: str, columns: Sequence[str], size: int) -> RecordLayout:
    """Return where the fields of a format lie, as far as they have a name, a known code and room in the record."""
    fields: list[tuple[LayoutField, Any, int]] = []
    at = 0
    for column, code in zip(columns, codes, strict=False):
        if code not in CODES:
            break
        shape, divisor = CODES[code]
        width = struct.calcsize(f"<{shape}")
        if at + width > size:
            break
        if divisor is not None:
            fields.append((LayoutField(column, partial(_divided, divisor)), f"<{shape}", at))
        elif code == _ARRAY:
            fields.append((LayoutField(column), ("<i2", (width // 2,)), at))
        elif shape.endswith("s"):
            # pieces of files may hold anything, zeros included
            read = _raw if name == "FILE" and code == "Z" else _texts
            fields.append((LayoutField(column, read, numbers=False), f"V{width}", at))
        else:
            fields.append((LayoutField(column), f"<{shape}", at))
        at += width
    return layout(fields, size)


def _divided(divisor: float, values: NDArray[Any]) -> FieldValues:
    return np.asarray(values / divisor)


def _texts(values: NDArray[np.void]) -> FieldValues:
    return [record_text(bytes(value).split(b"\0", 1)[0]) for value in values.tolist()]


def _raw(values: NDArray[np.void]) -> FieldValues:
    return [bytes(value).decode("latin-1") for value in values.tolist()]


def _log_clock(path: Path, utc_minus_boot_ns: int | None) -> LogClock:
    """Return the clock of a log; UTC minus time since boot from its first 3D fix where that is not known."""
    scan = StartScan()
    start = scan.found(DataflashReader(path, read_ahead_bytes=_SCANNED_BYTES, clock=scan))
    if utc_minus_boot_ns is not None:
        return LogClock(utc_minus_boot_ns, start)
    fixes = DataflashReader(path, ("GPS",), clock=LogClock(0, start))
    return LogClock(first_relation(fixes, _RELATION, _relation) or 0, start)


def _relation(
    boot_ns: NDArray[np.int64],
    week: NDArray[np.int64],
    ms: NDArray[np.int64],
    old_week: NDArray[np.int64],
    old_ms: NDArray[np.int64],
    status: NDArray[np.int64],
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    old = week <= 0
    week, ms = np.where(old, old_week, week), np.where(old, old_ms, ms)
    # weeks have 16 bits, milliseconds of a week 32: what damage makes of them fits
    utc_ms = (_GPS_EPOCH_S + _WEEK_S * week - _LEAP_S) * 1_000 + ms
    return utc_ms * 1_000_000 - boot_ns, (week > 0) & (status >= _FIX_3D)


def _whole(value: Any) -> int:
    """Return a whole number; 0 where there is none."""
    return value if type(value) is int else 0
