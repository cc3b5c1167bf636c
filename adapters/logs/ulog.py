"""Onboard logs of PX4 (.ulg, plain or .xz / .gz): topics in the order they were logged, over damage if need be.

https://docs.px4.io/main/en/dev_log/ulog_file_format. The format has no checksums: damage shows only where a record is
none of its kind.
"""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from adapters.errors import TelemetryError
from adapters.logs.log_bytes import LogStatistics, Window, text
from adapters.logs.ulog_format import UlogField, UlogType, compile_type, decode_keyed, parse_format
from adapters.message import LATEST_NS, Message

SOURCE: Final = "ulog"
# Records that are no topics, under names that no topic has.
INFORMATION, PARAMETER, PARAMETER_DEFAULT = "log/information", "log/parameter", "log/parameter_default"
TEXT, DROPOUT = "log/text", "log/dropout"
GPS_TOPICS: Final = ("vehicle_gps_position", "sensor_gps")

_MAGIC = b"\x55\x4c\x6f\x67\x01\x12\x35"
_FILE_HEAD = struct.Struct("<7sBQ")
_HEAD = struct.Struct("<HB")
_ID = struct.Struct("<H")
_SYNC = b"\x2f\x73\x13\x20\x25\x0c\xbb\x12"
_FLAGS = struct.Struct("<8s8s3Q")
_APPENDED = 1
_DATA, _SUBSCRIPTION = ord("D"), ord("A")
_KINDS = frozenset(b"ABCDFILMOPQRS")
_LARGEST_UNKNOWN = 10_000
_CHAINED = 3
_LEVELS = range(ord("0"), ord("8"))
# Where reading may go on after damage: a topic's record or a mark for this very purpose.
_RESUMES = re.compile(rb"[DS]")
_SEARCHED_AT_ONCE = 1 << 16
_LARGEST_RECORD = 2 * _HEAD.size + _ID.size + (1 << 16)
_RELATION = ("time_utc_usec", "timestamp", "fix_type", "timestamp_time_relative")
_FIX_3D = 3
_YEAR_2001_US = 1_000_000_000_000_000


class UlogReader:
    """Reads an onboard log of PX4 in the order it was written.

    Topics come under their names, ``sensor_baro/1`` being the second instance of one; information, parameters, text
    and dropouts under ``log/...``. Time of arrival is the record's own ``timestamp``, microseconds since boot, on the
    relation of boot to UTC in the first position fix in the log (:data:`GPS_TOPICS`); without any, boot is the start
    of 1970. Iterate once; :meth:`statistics` tells what was found.

    Parameters
    ----------
    path : str | PathLike
        The log.
    only : Collection[str] | None
        Names of the messages wanted; None wants all.
    utc_minus_boot_us : int | None
        Where that relation is known already; None looks for it in the log.
    """

    def __init__(
        self, path: str | os.PathLike[str], only: Collection[str] | None = None, utc_minus_boot_us: int | None = None
    ) -> None:
        self._path = Path(path)
        self._only = only
        self._offset_us = utc_minus_boot_us
        self._newest_us = 0
        self._formats: dict[str, tuple[UlogField, ...]] = {}
        self._topics: dict[int, tuple[str, UlogType, bool]] = {}
        self._appended: list[int] = []
        self._records = self._unknown = self._damaged = self._skipped_bytes = 0
        self._broken_off = False
        self._take: Mapping[int, Callable[[bytes], tuple[str, dict[str, Any]] | None]] = {
            ord("A"): self._subscribe,
            ord("B"): self._flag,
            ord("C"): self._tagged_text,
            ord("F"): self._define,
            ord("I"): _information,
            ord("L"): self._text,
            ord("M"): _long_information,
            ord("O"): _dropout,
            ord("P"): _parameter,
            ord("Q"): _parameter_default,
            ord("R"): self._unsubscribe,
            ord("S"): _sync,
        }

    def statistics(self) -> LogStatistics:
        """Return the counts so far."""
        return LogStatistics(self._records, self._unknown, self._damaged, self._skipped_bytes, self._broken_off)

    def __iter__(self) -> Iterator[Message]:
        """Return the wanted messages.

        Raises
        ------
        TelemetryError
            The file cannot be opened, is no such log, or needs a newer reader.
        """
        if self._offset_us is None:
            self._offset_us = utc_minus_boot_us(self._path) or 0
        window = Window(self._path)
        self._open(window)
        while window.fill(_HEAD.size):
            size, kind = _HEAD.unpack_from(window.data, window.at)
            length = _HEAD.size + size
            if self._appended and window.offset >= self._appended[0]:
                self._appended.pop(0)
            if self._appended and window.offset + length > self._appended[0]:
                # the logger was stopped within a record; what was appended begins where it says
                self._skip(window, self._appended[0] - window.offset)
                continue
            if not window.fill(length):
                if not self._resume(window, end=True):
                    break
                continue
            start = window.at + _HEAD.size
            body = window.data[start : start + size]
            if kind == _DATA:
                topic = self._topics.get(_ID.unpack_from(body)[0]) if size > _ID.size else None
                if topic is None or not topic[1].smallest <= size - _ID.size <= topic[1].size:
                    self._resume(window)
                    continue
                self._records += 1
                window.at += length
                if topic[2]:
                    yield self._message(topic[0], topic[1].decode(body[_ID.size :]))
                continue
            if kind not in self._take:
                if size == 0 or size > _LARGEST_UNKNOWN or not self._stands(window, length, _CHAINED):
                    self._resume(window)
                    continue
                self._unknown += 1
                window.at += length
                continue
            try:
                found = self._take[kind](body)
            except TelemetryError:
                raise
            except (ValueError, struct.error):
                self._resume(window)
                continue
            self._records += 1
            window.at += length
            if found is not None and (self._only is None or found[0] in self._only):
                yield self._message(*found)
        self._broken_off |= window.cut or window.left > 0
        self._skipped_bytes += window.left

    def _open(self, window: Window) -> None:
        """Step over the head of the file."""
        if not window.fill(_FILE_HEAD.size) or not window.data.startswith(_MAGIC):
            raise TelemetryError(f"{self._path}: not a ULog file although its name says so; check where it came from")
        self._note_time(_FILE_HEAD.unpack_from(window.data)[2])
        window.at = _FILE_HEAD.size

    def _message(self, name: str, fields: dict[str, Any]) -> Message:
        self._note_time(fields.get("timestamp"))
        return Message(SOURCE, name, (self._newest_us + (self._offset_us or 0)) * 1_000, fields)

    def _note_time(self, stamp_us: Any) -> None:
        """Take the time of a record, unless it is none or damaged."""
        if type(stamp_us) is int and 0 <= stamp_us + (self._offset_us or 0) < LATEST_NS // 1_000:
            self._newest_us = stamp_us

    def _skip(self, window: Window, count: int) -> None:
        taken = count if window.fill(count) else window.left
        window.at += taken
        self._skipped_bytes += taken

    def _stands(self, window: Window, ahead: int, behind: int = 0) -> bool:
        """Return whether a topic's record, or the end, stands so many bytes ahead.

        A record of another known kind will do too, with so many such ``behind`` it: hardly more than one byte tells
        those from garbage.
        """
        if not window.fill(ahead + _HEAD.size):
            return window.left == ahead
        size, kind = _HEAD.unpack_from(window.data, window.at + ahead)
        if kind != _DATA:
            known = kind in _KINDS and size > 0
            return known and (behind == 0 or self._stands(window, ahead + _HEAD.size + size, behind - 1))
        if not window.fill(ahead + _HEAD.size + _ID.size):
            return False
        topic = self._topics.get(_ID.unpack_from(window.data, window.at + ahead + _HEAD.size)[0])
        return topic is not None and topic[1].smallest <= size - _ID.size <= topic[1].size

    def _resume(self, window: Window, *, end: bool = False) -> bool:
        """Move on to where records stand again, and return whether they do; ``end``: stay where none do."""
        while True:
            more = window.fill(_SEARCHED_AT_ONCE + _LARGEST_RECORD)
            searched = _SEARCHED_AT_ONCE if more else window.left
            ahead = self._standing(window, searched)
            if ahead is not None or end or not more:
                break
            self._skip(window, searched - 1)
        if ahead is None and end:
            return False
        self._damaged += 1
        self._skip(window, window.left if ahead is None else ahead)
        return ahead is not None

    def _standing(self, window: Window, searched: int) -> int | None:
        """Return how many bytes ahead a topic's record with another behind it, or a mark, stands."""
        start = window.at
        for found in _RESUMES.finditer(window.data, start + _HEAD.size, start + searched):
            ahead = found.start() - (_HEAD.size - 1) - start
            size, kind = _HEAD.unpack_from(window.data, start + ahead)
            if kind == _DATA:
                if self._stands(window, ahead) and self._stands(window, ahead + _HEAD.size + size):
                    return ahead
            elif window.data.startswith(_SYNC, start + ahead + _HEAD.size) and size == len(_SYNC):
                return ahead
        return None

    def _subscribe(self, body: bytes) -> None:
        instance, number = struct.unpack_from("<BH", body)
        topic = body[3:].decode("ascii")
        name = f"{topic}/{instance}" if instance else topic
        compiled = compile_type(topic, self._formats)
        self._topics[number] = (name, compiled, self._only is None or name in self._only)

    def _unsubscribe(self, body: bytes) -> None:
        self._topics.pop(_ID.unpack(body)[0], None)

    def _define(self, body: bytes) -> None:
        name, fields = parse_format(body)
        self._formats[name] = fields

    def _flag(self, body: bytes) -> None:
        _, needed, *places = _FLAGS.unpack_from(body)
        if self._records:
            raise ValueError("flags stand first")
        if any(needed[1:]) or needed[0] & ~_APPENDED:
            raise TelemetryError(f"{self._path}: is a ULog file of a newer kind than this program reads; update it")
        if needed[0]:
            self._appended = sorted(place for place in places if place)

    def _text(self, body: bytes) -> tuple[str, dict[str, Any]]:
        level, stamp_us = struct.unpack_from("<BQ", body)
        if level not in _LEVELS:
            raise ValueError("no level of a text")
        return TEXT, {"timestamp": stamp_us, "level": level - _LEVELS.start, "tag": 0, "text": text(body[9:])}

    def _tagged_text(self, body: bytes) -> tuple[str, dict[str, Any]]:
        level, tag, stamp_us = struct.unpack_from("<BHQ", body)
        if level not in _LEVELS:
            raise ValueError("no level of a text")
        return TEXT, {"timestamp": stamp_us, "level": level - _LEVELS.start, "tag": tag, "text": text(body[11:])}


def _information(body: bytes) -> tuple[str, dict[str, Any]]:
    name, kind, value = decode_keyed(body)
    return INFORMATION, {"key": name, "type": kind, "value": str(value), "continued": False}


def _long_information(body: bytes) -> tuple[str, dict[str, Any]]:
    name, kind, value = decode_keyed(body[1:])
    return INFORMATION, {"key": name, "type": kind, "value": str(value), "continued": bool(body[0])}


def _parameter(body: bytes) -> tuple[str, dict[str, Any]]:
    name, kind, value = decode_keyed(body)
    if kind not in ("int32_t", "float"):
        raise ValueError("parameters are int32_t or float")
    return PARAMETER, {"key": name, "type": kind, "value": float(value)}


def _parameter_default(body: bytes) -> tuple[str, dict[str, Any]]:
    _, fields = _parameter(body[1:])
    return PARAMETER_DEFAULT, {**fields, "sets": body[0]}


def _dropout(body: bytes) -> tuple[str, dict[str, Any]]:
    return DROPOUT, {"duration_ms": _ID.unpack(body)[0]}


def _sync(body: bytes) -> None:
    if body != _SYNC:
        raise ValueError("no mark")


def utc_minus_boot_us(path: str | os.PathLike[str]) -> int | None:
    """Return UTC minus time since boot in microseconds, from the first position fix in a log; None without one."""
    for message in UlogReader(path, GPS_TOPICS, 0):
        utc_us, boot_us, fix, relative_us = (_whole(message.fields.get(name)) for name in _RELATION)
        found_us = utc_us - boot_us - relative_us
        if fix >= _FIX_3D and utc_us > _YEAR_2001_US and 0 <= found_us < LATEST_NS // 1_000:
            return found_us
    return None


def _whole(value: Any) -> int:
    """Return a whole number; 0, which stands for unknown, where there is none."""
    return value if type(value) is int else 0
