"""Onboard logs of ArduPilot (DataFlash .bin, plain or .xz / .gz): records in the order they were logged.

A record consists of two bytes that mark it, its kind, and fields in the format that the log itself defines for that
kind. There are no checksums: damage shows only where no record begins.
"""

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from adapters.errors import TelemetryError
from adapters.logs.compressed import Window
from adapters.logs.onboard_log import (
    FieldValues,
    LayoutField,
    OnboardLogReader,
    RecordKind,
    RecordLayout,
    Records,
    layout,
    record_text,
)
from adapters.source import DATAFLASH

# struct code, and divisor: pymavlink's DFReader decodes the same, and the tests compare with it.
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
_LARGEST_RECORD = 256
_PADDING_BYTES = 528
"""Boards that log in blocks pad the last one; pymavlink skips as many bytes."""
_GPS_EPOCH_S = 315_964_800
_WEEK_S = 604_800
# Since 2017; GPS time has no leap seconds, and the log holds GPS time.
_LEAP_S = 18
_FIX_3D = 3


@dataclass(slots=True)
class _Format:
    """A kind of record as defined in the log."""

    kind: RecordKind  # its name and fields
    length: int  # its bytes including mark and number
    columns: tuple[str, ...]  # names of all fields
    defines: bool = False  # whether its records define the format of others


class DataflashReader(OnboardLogReader):
    """Reads an onboard log of ArduPilot.

    Records have the names of the log, ``BARO/1`` being the second instance if the log marks a field that tells
    instances apart (unit ``#``). Values are decoded as by pymavlink's DFReader. Time since boot is ``TimeUS``, in old
    logs ``TimeMS``; fixes are those of ``GPS`` in 3D. If a record's format contradicts itself, as some of ArduPilot's
    own do, the fields that fit are decoded. A log that ends within a record is not damaged: this happens whenever power
    is cut.

    See :class:`OnboardLogReader`, whose parameters it takes.
    """

    source = DATAFLASH
    begins = _MARK + bytes([_FORMAT_KIND, _FORMAT_KIND, 89]) + b"FMT\0"
    head_bytes = fields_at = _HEAD_BYTES
    largest_bytes = 2 * _LARGEST_RECORD
    padding_bytes = _PADDING_BYTES
    ends_anywhere = True
    fixes = ("GPS",)
    fix_fields = ("GWk", "GMS", "Week", "TimeMS", "Status")

    def _begin(self) -> None:
        formats = self._format("FMT", 89, "BBnNZ", "Type,Length,Name,Format,Columns")
        formats.defines = True
        # by the first bytes of records
        self._formats = {_head(_FORMAT_KIND): formats}

    def _open(self, window: Window) -> None:
        if not window.fill(_HEAD_BYTES) or window.data[:_HEAD_BYTES] != _MARK + bytes([_FORMAT_KIND]):
            raise TelemetryError(
                f"{self._path}: not a DataFlash log although its name says so; check where it came from"
            )

    def _known(self, head: bytes) -> tuple[int, RecordKind | None] | None:
        form = self._formats.get(head)
        # definitions are read before the next record is processed
        if form is None or form.defines:
            return None
        return form.length, form.kind if form.kind.wanted else None

    def _single(self, window: Window, records: Records) -> bool:
        form = self._formats.get(window.data[window.at : window.at + _HEAD_BYTES])
        if form is None:
            return self._resume(window)
        if not window.fill(form.length):
            return self._resume(window, end=True)
        if not form.defines:
            # the chain only reached the end of the bytes
            return True
        body = window.data[window.at + _HEAD_BYTES : window.at + form.length]
        fields = form.kind.layout.rows(np.frombuffer(body, form.kind.layout.dtype))[0]
        if not self._learn(form, fields):
            # a record that should define a format and does not is damage
            return self._resume(window)
        self._heads.clear()
        self._records += 1
        window.at += form.length
        if self._only is None or form.kind.name in self._only:
            records.add_decoded(form.kind.name, fields)
        return True

    def _learn(self, form: _Format, fields: Mapping[str, Any]) -> bool:
        """Read a definition from a record; return whether it is one."""
        if form is self._formats[_head(_FORMAT_KIND)]:
            return self._define(form, fields)
        number = fields.get("FmtType")
        defined = self._formats.get(_head(number)) if type(number) is int else None
        place = str(fields.get("UnitIds", "")).find(_INSTANCE)
        if defined is not None and 0 <= place < len(defined.columns):
            instance = defined.columns[place]
            if instance != defined.kind.instance:
                # earlier records keep their names
                defined.kind = replace(defined.kind, instance=instance)
        return True

    def _define(self, form: _Format, fields: Mapping[str, Any]) -> bool:
        """Read a format; return whether the record is one."""
        try:
            made = self._format(fields["Name"], fields["Length"], fields["Format"], fields["Columns"])
        except ValueError:
            return False
        if made.kind.name == "TIME" and made.columns == ("StartTime",):
            raise TelemetryError(
                f"{self._path}: a log of PX4's sdlog2 (.px4log), whose records have no time of their own; give a .ulg"
            )
        number = fields["Type"]
        if number == _FORMAT_KIND:
            return made.length == form.length
        before = self._formats.get(_head(number))
        if before is not None and before.columns == made.columns:
            made.kind.instance = before.kind.instance
        made.defines = made.kind.name == "FMTU"
        self._formats[_head(number)] = made
        return True

    def _format(self, name: str, length: int, codes: str, columns: str) -> _Format:
        """Return a format; raise ValueError if the definition is invalid."""
        if not name.isascii() or not name.isprintable() or not name or "/" in name or length < _HEAD_BYTES:
            raise ValueError("no format")
        names = columns.split(",") if columns else []
        kind = _layout(name, codes, names, length - _HEAD_BYTES)
        # any instance of the kind may be wanted
        wanted = self._only is None or any(wanted_name.partition("/")[0] == name for wanted_name in self._only)
        return _Format(RecordKind(name, kind, wanted), length, tuple(names))

    def _stands(self, window: Window, ahead: int) -> bool:
        """Return whether a record of a known kind, or the end, is ``ahead`` bytes ahead."""
        if not window.fill(ahead + _HEAD_BYTES):
            return window.left == ahead
        at = window.at + ahead
        return window.data[at : at + _HEAD_BYTES] in self._formats

    def _standing(self, window: Window, searched: int) -> int | None:
        # a record that is followed by another
        start, at = window.at, window.at
        while (at := window.data.find(_MARK, at + 1, start + searched)) >= 0:
            form = self._formats.get(window.data[at : at + _HEAD_BYTES])
            if form is not None and self._stands(window, at - start + form.length):
                return at - start
        return None

    @staticmethod
    def relation(boot_ns: int, *fields: int) -> int | None:
        """Return UTC minus time since boot from a GPS record that had a fix."""
        week, ms, old_week, old_ms, status = fields
        if week <= 0:
            week, ms = old_week, old_ms
        utc_ms = (_GPS_EPOCH_S + _WEEK_S * week - _LEAP_S) * 1_000 + ms
        return utc_ms * 1_000_000 - boot_ns if week > 0 and status >= _FIX_3D else None


def _head(number: int) -> bytes:
    """Return the first bytes of the records of a kind."""
    return _MARK + bytes([number]) if 0 <= number < 256 else b""


def _layout(name: str, codes: str, columns: Sequence[str], size: int) -> RecordLayout:
    """Return the layout of a format's fields that have a name, a known code and room in the record."""
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
            # damaged files may hold any bytes here, including zeros
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
