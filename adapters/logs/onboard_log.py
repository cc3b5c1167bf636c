"""Common parts of the readers of onboard logs: records of many kinds as columns.

An onboard log is a chain of records, each with its kind and length. A reader goes from one to the next and notes only
where they begin; :class:`Records` then decodes all records of a kind at once.
"""

import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from adapters.batch import Batch, Columns, gathered, messages
from adapters.errors import TelemetryError
from adapters.logs.compressed import Window
from adapters.logs.damage import ScanStatistics
from adapters.logs.record_chain import follow
from adapters.message import LATEST_NS, Message
from adapters.source import Source

READ_AHEAD_BYTES: Final = 1 << 22
"""Bytes of a log in a batch, some 70,000 records. Measured on a log of PX4 of 105 MB: read in 2.7 s with 64 kB, 0.88
s with 1 MB, 0.74 s with 4 MB and with 16 MB.
"""

_SCANNED_BYTES = 1 << 20
"""Bytes of a log read at a time to find its clock. Measured: twenty thousand records have 1.1 MB (ArduPilot) and 1.2 MB
(PX4)."""
_SEARCHED_AT_ONCE = 1 << 16
"""Bytes in which the next record is searched for at a time. Chosen: as many as the largest record of PX4 has."""

FieldValues: TypeAlias = "NDArray[np.generic] | list[Any]"


@dataclass(frozen=True, slots=True)
class LayoutField:
    """One field of a layout."""

    name: str  # its name
    # converts the field's values as in the log, one row per record, to numbers (an array of as many rows) or other
    # values (a list); None leaves numbers as they are
    convert: Callable[[NDArray[Any]], FieldValues] | None = None
    numbers: bool = True  # whether the values are numbers, or lists of numbers of equal length


@dataclass(frozen=True, slots=True)
class RecordLayout:
    """Positions of the fields in the records of one kind."""

    dtype: np.dtype[np.void]  # structured type of a record; padding is in no field
    fields: tuple[LayoutField, ...]  # the fields in their order

    @property
    def numbers(self) -> bool:
        """Whether all fields are numbers or lists of numbers, so that the records can be columns."""
        return all(field.numbers for field in self.fields)

    def take(self, data: bytes, start: NDArray[np.int64]) -> NDArray[np.void]:
        """Return the records (n,) that begin at n places of ``data``."""
        size = self.dtype.itemsize
        if not size:
            return np.zeros(len(start), self.dtype)
        # a view with a record at each byte of the data: indexing it copies record by record
        everywhere = np.ndarray((len(data) - size + 1,), f"V{size}", data, strides=(1,))
        return everywhere[start].view(self.dtype)

    def columns(self, records: NDArray[np.void]) -> dict[str, FieldValues]:
        """Return the fields of n records by name: an array of n rows, or a list of n values that are not numbers."""
        columns: dict[str, FieldValues] = {}
        for part in self.fields:
            values = np.ascontiguousarray(records[part.name])
            columns[part.name] = values if part.convert is None else part.convert(values)
        return columns

    def rows(self, records: NDArray[np.void]) -> list[dict[str, Any]]:
        """Return the fields of n records, one mapping per record."""
        columns = self.columns(records)
        values = [column if isinstance(column, list) else column.tolist() for column in columns.values()]
        return [dict(zip(columns, (column[row] for column in values), strict=True)) for row in range(len(records))]


@dataclass(eq=False, slots=True)
class RecordKind:
    """One kind of record of a log."""

    name: str  # name of its messages
    layout: RecordLayout  # where the fields lie
    wanted: bool = True  # whether the records are wanted
    # field that tells instances apart: messages of the second are ``name/1``; None if there is only one
    instance: str | None = None

    def named(self, columns: Mapping[str, FieldValues]) -> list[tuple[str, NDArray[np.int64] | slice]]:
        """Return the names of the messages, and the rows of each."""
        values = None if self.instance is None else columns[self.instance]
        if isinstance(values, np.ndarray) and (values.dtype.kind not in "iu" or values.ndim > 1):
            values = None
        if values is None or not len(values):
            return [(self.name, slice(None))]
        rows: dict[str, list[int]] = {}
        for row, value in enumerate(values if isinstance(values, list) else values.tolist()):
            rows.setdefault(f"{self.name}/{value}" if value else self.name, []).append(row)
        return [(name, np.array(places, np.int64)) for name, places in rows.items()]


_SCANNED = 20_000
"""Records with a stamp from whose times a log's clock is found. Chosen: some seconds of any log, read in 30 ms."""
_APART_NS = 60_000_000_000
"""Least distance of stamps from different clocks, or of stamps from before the log. Chosen: no log pauses for a minute
within its first seconds, and clocks of other origins (boot, GPS week, Unix) are further apart."""
_LONGEST_NS = 30 * 86_400 * 1_000_000_000
"""Longest log, 30 days: a stamp later than that after its start is of another clock, or damaged."""


@dataclass(frozen=True, slots=True)
class LogStart:
    """The begin of a log's clock, and the records that are not stamped by it."""

    time_ns: int = 0  # time since boot of the begin of the log
    foreign: frozenset[str] = frozenset()  # names of records with stamps of another clock: GPS time of week, Unix time


class LogClock:
    """Times of arrival of a log's records: their own stamps, with a known relation of boot to UTC.

    A record without a stamp of the log's clock has the time of the previous record. Such a record has no stamp, the
    stamp 0, the stamp of another clock, or one from before the log began, as the last value of a topic that seldom
    changes.

    ``newest_ns`` is the time since boot of the newest record with a valid stamp.
    """

    def __init__(self, utc_minus_boot_ns: int, start: LogStart) -> None:
        self.utc_minus_boot_ns = utc_minus_boot_ns
        self.newest_ns = start.time_ns
        self._start = start
        self._least_ns = max(start.time_ns, 1, -utc_minus_boot_ns)
        self._end_ns = min(LATEST_NS - utc_minus_boot_ns, LATEST_NS, start.time_ns + _LONGEST_NS)

    def stamps_ns(self, name: str, fields: Mapping[str, Any], count: int) -> NDArray[np.int64]:
        """Return the times since boot of ``count`` records, NO_TIME for those without a valid one.

        ``fields`` are the records' fields by name, arrays or lists of values.
        """
        stamps_ns = own_stamps_ns(fields, count)
        if name in self._start.foreign:
            stamps_ns[:] = NO_TIME
        stamps_ns[(stamps_ns < self._least_ns) | (stamps_ns >= self._end_ns)] = NO_TIME
        return stamps_ns

    def received_ns(self, stamps_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the times of arrival of n records in order (n,); without a stamp, that of the previous record."""
        known = np.concatenate([[self.newest_ns], stamps_ns])
        last = np.maximum.accumulate(np.where(known != NO_TIME, np.arange(len(known)), 0))
        filled = known[last]
        self.newest_ns = int(filled[-1])
        return np.asarray(filled[1:] + self.utc_minus_boot_ns, np.int64)


NO_TIME: Final = np.iinfo(np.int64).min
"""Replaces a missing stamp."""

# Fields that hold a stamp since boot, and the nanoseconds of a count. In old logs of ArduPilot a GPS record's TimeMS is
# the receiver's time of week, and T the time since boot.
_STAMPS = (("timestamp", 1_000), ("TimeUS", 1_000), ("T", 1_000_000), ("TimeMS", 1_000_000))


def own_stamps_ns(fields: Mapping[str, Any], count: int) -> NDArray[np.int64]:
    """Return the stamps of n records of an onboard log since boot, nanoseconds, NO_TIME if missing (n,)."""
    for name, unit_ns in _STAMPS:
        if name in fields:
            values = np.asarray(fields[name])
            if values.dtype.kind in "iu" and values.ndim == 1:
                good = (values >= 0) & (values < LATEST_NS // unit_ns)
                return np.where(good, np.where(good, values, 0).astype(np.int64) * unit_ns, NO_TIME)
    return np.full(count, NO_TIME)


class StartScan(LogClock):
    """A clock that accepts every stamp, and finds the begin of a log's clock from the stamps of its first records."""

    def __init__(self) -> None:
        super().__init__(0, LogStart())
        self._end_ns = LATEST_NS
        self._stamps: dict[str, list[NDArray[np.int64]]] = {}
        self._count = 0

    def stamps_ns(self, name: str, fields: Mapping[str, Any], count: int) -> NDArray[np.int64]:
        """Return the times since boot of ``count`` records, and keep them."""
        stamps_ns = super().stamps_ns(name, fields, count)
        self._stamps.setdefault(name, []).append(stamps_ns[stamps_ns != NO_TIME])
        return stamps_ns

    def found(self, batches: Iterable[Batch], head_ns: int | None = None) -> LogStart:
        """Return the begin of the clock of a log that is read with this clock.

        Stamps that are close together are of one clock and one flight. The log's are the stamps that most names have,
        and those that more than half as many names have.

        Only the log's first records are read. ``head_ns`` is the time in the file's header.
        """
        for _ in batches:
            if sum(len(times_ns) for parts in self._stamps.values() for times_ns in parts) >= _SCANNED:
                break
        stamps = {name: np.unique(np.concatenate(ones)) for name, ones in self._stamps.items()}
        every = np.unique(np.concatenate([np.empty(0, np.int64), *stamps.values()]))
        if not len(every):
            return LogStart(0 if head_ns is None or not 0 <= head_ns < LATEST_NS else head_ns)
        breaks = np.flatnonzero(np.diff(every) > _APART_NS)
        begins, ends = every[np.concatenate([[0], breaks + 1])], every[np.concatenate([breaks, [-1]])]
        names = sum(
            np.isin(np.arange(len(begins)), np.searchsorted(ends, stamp)).astype(int) for stamp in stamps.values()
        )
        own = np.flatnonzero(2 * names > np.max(names))
        first, last = int(begins[own[0]]), int(ends[own[-1]])
        if head_ns is not None and first - _APART_NS <= head_ns <= int(ends[own[0]]):
            first = head_ns
        foreign = {name for name, times in stamps.items() if len(later := times[times >= first]) and later[0] > last}
        return LogStart(first, frozenset(foreign))


@dataclass(slots=True)
class Records:
    """Consecutive records of a log, in their order, until they become a batch."""

    source: Source  # source of the messages
    clock: LogClock  # gives the records their times
    only: Collection[str] | None  # names of the messages wanted; None wants all
    data: bytes = b""  # bytes that contain the records
    start: list[int] = field(default_factory=list)  # where the fields of each record begin in these bytes
    kind: list[RecordKind | None] = field(default_factory=list)  # kind of each record; None if it was decoded by itself
    # names and fields of those records, by their index
    decoded: dict[int, tuple[str, dict[str, Any]]] = field(default_factory=dict)

    def add_decoded(self, name: str, fields: dict[str, Any]) -> None:
        """Add a record that is decoded already."""
        self.decoded[len(self.start)] = name, fields
        self.start.append(0)
        self.kind.append(None)

    def batch(self) -> Batch:
        """Return the records as a batch, and clear them."""
        start = np.array(self.start, np.int64)
        codes = {kind: code for code, kind in enumerate(dict.fromkeys(self.kind))}
        code = np.fromiter(map(codes.__getitem__, self.kind), np.uint16, len(self.kind))
        order = np.argsort(code, kind="stable")
        groups = np.split(order, np.searchsorted(code[order], np.arange(1, len(codes))))
        stamps_ns = np.full(len(start), NO_TIME)
        columns: list[tuple[str, NDArray[np.int64], dict[str, FieldValues]]] = []
        rows: list[tuple[str, int, dict[str, Any]]] = []
        for kind, index in zip(codes, groups, strict=True):
            if kind is None:
                for at in index.tolist():
                    name, fields = self.decoded[at]
                    rows.append((name, at, fields))
                    single = {key: [value] for key, value in fields.items()}
                    stamps_ns[at] = self.clock.stamps_ns(name, single, 1)[0]
                continue
            records = kind.layout.take(self.data, start[index])
            found = kind.layout.columns(records)
            stamps_ns[index] = self.clock.stamps_ns(kind.name, found, len(index))
            for name, part in kind.named(found):
                if self.only is not None and name not in self.only:
                    continue
                if kind.layout.numbers:
                    columns.append((name, index[part], {key: values[part] for key, values in found.items()}))
                else:
                    chosen = zip(index[part].tolist(), kind.layout.rows(records[part]), strict=True)
                    rows += ((name, at, fields) for at, fields in chosen)
        self.start, self.kind, self.decoded = [], [], {}
        return self._batch(stamps_ns, columns, rows)

    def _batch(
        self,
        stamps_ns: NDArray[np.int64],
        columns: Sequence[tuple[str, NDArray[np.int64], dict[str, Any]]],
        rows: Sequence[tuple[str, int, dict[str, Any]]],
    ) -> Batch:
        kept = np.sort(np.concatenate([np.array([at for _, at, _ in rows], np.int64), *(at for _, at, _ in columns)]))
        # unwanted instances do not set the time of later records either
        times_ns = np.zeros(len(stamps_ns), np.int64)
        times_ns[kept] = self.clock.received_ns(stamps_ns[kept])
        return gathered(
            (Columns(self.source, name, 0, 0, at, times_ns[at], fields) for name, at, fields in columns),
            {at: Message(self.source, name, int(times_ns[at]), fields) for name, at, fields in rows},
        )


class OnboardLogReader(ABC):
    """Reads an onboard log in the order it was written, also across damage, as batches.

    Time of arrival is the record's own time since boot, with the relation of boot to UTC from the first position fix in
    the log; without any, boot is the start of 1970. Records without a time of the log's clock have that of the previous
    one (:class:`LogClock`). Iterate once; :meth:`statistics` returns the counts. Each kind of log defines how its
    records follow one another.

    ``only`` names the messages wanted, None wants all. If the clock that gives records their times is known already, it
    is not searched for in the log. A batch is of ``read_ahead_bytes`` of the log, decompressed.
    """

    source: ClassVar[Source]
    begins: ClassVar[bytes]  # first bytes of every log of its kind, which occur nowhere else
    head_bytes: ClassVar[int]  # least bytes of a record
    fields_at: ClassVar[int]  # bytes that identify the kind of a record, followed by its fields
    largest_bytes: ClassVar[int]  # most bytes of a record and of the header of the next one
    padding_bytes: ClassVar[int] = -1  # bytes that may be left at the end without damage
    ends_anywhere: ClassVar[bool] = False  # whether a log that ends within a record is undamaged
    fixes: ClassVar[Collection[str]]  # names of the records of satellite receivers
    fix_fields: ClassVar[Sequence[str]]  # names of their fields that :meth:`relation` needs

    def __init__(
        self,
        path: str | os.PathLike[str],
        only: Collection[str] | None = None,
        read_ahead_bytes: int = READ_AHEAD_BYTES,
        clock: LogClock | None = None,
    ) -> None:
        self._path = Path(path)
        self._only = only
        self._read_ahead_bytes = read_ahead_bytes
        self._clock = clock
        self._head_ns: int | None = None
        # bytes of a record by its first bytes, and its kind if it is wanted
        self._heads: dict[bytes, tuple[int, RecordKind | None]] = {}
        self._records = self._unknown = self._damaged = self._skipped_bytes = 0
        self._broken_off = False
        self._begin()

    def statistics(self) -> ScanStatistics:
        """Return the counts so far."""
        return ScanStatistics(self._records, self._unknown, self._damaged, self._skipped_bytes, self._broken_off)

    def __iter__(self) -> Iterator[Batch]:
        """Return the batches in which there are wanted messages.

        Raises
        ------
        TelemetryError
            The file cannot be opened, is not such a log, holds several of them, or needs a newer reader.
        """
        window = Window(self._path, self._read_ahead_bytes)
        self._open(window)
        records = Records(self.source, self._clock or self._log_clock(), self._only)
        while window.fill(self.head_bytes):
            if records.data is not window.data:
                if records.start:
                    yield records.batch()
                self._check_single(window)
                records.data = window.data
            chain = window.data, window.at, self._chain_end(window), self.fields_at
            window.at, count = follow(*chain, self._heads, self._known, records.start, records.kind)
            self._records += count
            if window.fill(self.head_bytes) and not self._single(window, records):
                break
        if records.start:
            yield records.batch()
        self._broken_off = window.cut or (window.left > 0 and not self.ends_anywhere)
        self._skipped_bytes += window.left

    def _check_single(self, window: Window) -> None:
        """Reject a file in which another log begins: their clocks and formats are not the same."""
        found = window.data.find(self.begins, max(window.index(1), 0))
        if found >= 0:
            at = window.offset + found - window.at
            raise TelemetryError(
                f"{self._path}: contains several logs in a row, the second from byte {at} on: split it there "
                f"(head -c {at}; tail -c +{at + 1}), and give each as a file of its own"
            )

    def _log_clock(self) -> LogClock:
        """Return the clock of the log; UTC minus time since boot is taken from its first fix if it is not known."""
        scan = StartScan()
        start = scan.found(type(self)(self._path, read_ahead_bytes=_SCANNED_BYTES, clock=scan), self._head_ns)
        fixes = type(self)(self._path, self.fixes, clock=LogClock(0, start))
        return LogClock(first_relation(fixes, self.fix_fields, self.relation) or 0, start)

    def _chain_end(self, window: Window) -> int:
        """Return the end of the bytes held in which records may follow one another, as an index of them."""
        return len(window.data)

    @abstractmethod
    def _begin(self) -> None:
        """Set up what is known of the kinds of records before the first."""

    @abstractmethod
    def _open(self, window: Window) -> None:
        """Skip the file's header; raise TelemetryError if the file is not such a log."""

    @abstractmethod
    def _known(self, head: bytes) -> tuple[int, RecordKind | None] | None:
        """Return the bytes of a record by its first bytes, and its kind if it is wanted; None ends a chain.

        The result is kept until ``_heads`` is cleared.
        """

    @abstractmethod
    def _single(self, window: Window, records: Records) -> bool:
        """Continue from the end of a chain to the next record; return whether there may be any."""

    @abstractmethod
    def _standing(self, window: Window, searched: int) -> int | None:
        """Return how many bytes ahead the next certain record begins."""

    @staticmethod
    @abstractmethod
    def relation(boot_ns: int, *fields: int) -> int | None:
        """Return UTC minus time since boot from a fix, or None if it does not tell: see :func:`first_relation`."""

    def _skip(self, window: Window, count: int) -> None:
        taken = count if window.fill(count) else window.left
        window.at += taken
        self._skipped_bytes += taken

    def _resume(self, window: Window, *, end: bool = False) -> bool:
        """Go to the next records and return whether there are any; with ``end``, stay if there are none."""
        while True:
            more = window.fill(_SEARCHED_AT_ONCE + self.largest_bytes)
            searched = _SEARCHED_AT_ONCE if more else window.left
            ahead = self._standing(window, searched)
            if ahead is not None or end or not more:
                break
            self._skip(window, searched - 1)
        if ahead is None and end:
            return False
        if ahead is None and window.left <= self.padding_bytes and not window.cut:
            window.at += window.left
            return False
        self._damaged += 1
        self._skip(window, window.left if ahead is None else ahead)
        return ahead is not None


def first_relation(batches: Iterable[Batch], fields: Sequence[str], relation: Callable[..., int | None]) -> int | None:
    """Return UTC minus time since boot from the first record that tells it, or None if none does.

    The batches are records of satellite receivers, with their times since boot as times of arrival. ``relation`` gets
    that time and the named ``fields``, whole numbers, zero for a missing one.
    """
    for batch in batches:
        for message in messages(batch):
            values = (message.fields.get(name) for name in fields)
            offset_ns = relation(message.received_ns, *(value if type(value) is int else 0 for value in values))
            if offset_ns is not None and message.received_ns > 0 and 0 <= offset_ns < LATEST_NS:
                return offset_ns
    return None


def layout(fields: Sequence[tuple[LayoutField, Any, int]], size: int) -> RecordLayout:
    """Return a layout of fields, from the numpy type and position of each, and the bytes of a record.

    Of fields of the same name the last one is used.
    """
    by_name = {entry.name: (entry, kind, at) for entry, kind, at in fields}
    dtype = np.dtype(
        {
            "names": list(by_name),
            "formats": [kind for _, kind, _ in by_name.values()],
            "offsets": [at for _, _, at in by_name.values()],
            "itemsize": size,
        }
    )
    return RecordLayout(dtype, tuple(entry for entry, _, _ in by_name.values()))


def truth(values: NDArray[Any]) -> NDArray[np.bool_]:
    """Return bytes as truth values: every byte except zero is true."""
    return np.asarray(values != 0)


def record_text(data: bytes) -> str:
    """Return bytes as text, as UTF-8 if they are valid, otherwise one character per byte: nothing is lost."""
    try:
        return data.decode()
    except UnicodeDecodeError:
        return data.decode("latin-1")


def texts(values: NDArray[np.bytes_]) -> list[str]:
    """Return byte strings of fixed length as texts, without the zeros that pad them."""
    return [record_text(value) for value in values.tolist()]
