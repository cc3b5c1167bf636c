"""The records of an MCAP file in the order of the file, from unfinished and damaged files too.

A record is trusted if its length leads to another record, a chunk if its own lengths agree and its checksum is right.
After damage the next chunk is searched for by its shape (in files without chunks: two consecutive records), so that
only the damaged part is lost. If the file's end or a run of zeros cuts off a chunk, as much is read as can be
decompressed. The format: https://mcap.dev/spec
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import zstandard
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

from adapters.errors import TelemetryError
from adapters.logs.compressed import Window

MAX_RECORD_BYTES = 512 * 1024 * 1024
"""Largest record, bytes. Chosen: many times the largest chunk that recorders write; a greater length is damage, and
nothing is allocated for it."""
RECORD_HEAD = struct.Struct("<BQ")
MESSAGE_HEAD = struct.Struct("<HIQQ")
"""Channel, sequence, log time, publish time."""
_CHUNK_HEAD = struct.Struct("<QQQII")
"""Start and end time, size of the records, their checksum, length of the compression's name."""
UNREADABLE = (struct.error, ValueError, KeyError, OverflowError, EOFError, RuntimeError, zstandard.ZstdError)
"""Errors from decompressing and decoding damaged bytes."""

_LENGTH = struct.Struct("<Q")
# Chosen: compressions are called lz4 and zstd; a much longer name is damage
_LONGEST_NAME = 16
# least bytes of each kind of record: those with empty texts and lists
_LEAST_BYTES: dict[int, int] = {
    Opcode.HEADER: 8,
    Opcode.FOOTER: 20,
    Opcode.SCHEMA: 14,
    Opcode.CHANNEL: 16,
    Opcode.MESSAGE: 22,
    Opcode.CHUNK: 40,
    Opcode.MESSAGE_INDEX: 6,
    Opcode.CHUNK_INDEX: 60,
    Opcode.ATTACHMENT: 36,
    Opcode.ATTACHMENT_INDEX: 48,
    Opcode.STATISTICS: 46,
    Opcode.METADATA: 8,
    Opcode.METADATA_INDEX: 20,
    Opcode.SUMMARY_OFFSET: 17,
    Opcode.DATA_END: 4,
}
_FIXED = (Opcode.FOOTER, Opcode.SUMMARY_OFFSET, Opcode.DATA_END)
_PRIVATE = 0x80
# longest record without a checksum that is believed because another record follows, and that is searched for
_MAX_SEARCHED_BYTES = 1 << 24
_ZEROS = bytes(16)

_CHUNKS = re.compile(
    rb"\x06.{4}\0{4}.{28}(?:\0{4}|\x03\0{3}lz4|\x04\0{3}zstd).{4}\0{4}|\x0f\x04\0{7}.{4}[\x02-\x0e].{4}\0{4}", re.DOTALL
)
_RECORDS = re.compile(rb"[\x01-\x0f].{4}\0{4}", re.DOTALL)
# no match is longer, so none is missed between two pieces of a file
_LONGEST_MATCH = 64


class McapRecords:
    """Iterates once over (opcode, body) of a file's records; the body of a chunk is its records, decompressed.

    ``damaged_chunks`` counts blocks of records that were lost because their checksum or compression is wrong,
    ``lost_ways`` how often the next record had to be searched for. ``stopped_at`` is the byte from which an unfinished
    or broken file could not be read, None after a proper end; ``broken_off`` says whether there are unreadable bytes:
    an unfinished file may end between two records.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._window = Window(path, 0)
        self.damaged_chunks = self.lost_ways = 0
        self.stopped_at: int | None = 0
        self.broken_off = self._chunked = False

    def __iter__(self) -> Iterator[tuple[int, bytes]]:
        """Return the records, or raise what a :class:`adapters.logs.mcap_reader.MessageLogReader` raises."""
        window = self._window
        if self._peek(0, len(MCAP0_MAGIC)) == MCAP0_MAGIC:
            window.at += len(MCAP0_MAGIC)
        elif not self._search(0):
            raise TelemetryError(f"{self._path}: not an MCAP file although its name says so; check where it came from")
        while True:
            self.stopped_at = window.offset
            head = self._peek(0, RECORD_HEAD.size)
            if len(head) < RECORD_HEAD.size:
                self.broken_off |= bool(head)
                return
            opcode, length = RECORD_HEAD.unpack(head)
            size = RECORD_HEAD.size + length
            if not _plausible(opcode, length):
                body, size = None, 0
            elif opcode == Opcode.CHUNK:
                body, size = self._chunk(size)
            else:
                body, size = self._record(opcode, size)
            if body is not None:
                yield opcode, body
            if opcode == Opcode.FOOTER and body is not None:
                self.stopped_at = None
                return
            if size:
                window.at += size
            elif not self._search(1):
                self.broken_off = True
                return

    def flat(self) -> Iterator[tuple[int, bytes]]:
        """Return the records, with each chunk replaced by its records; it raises the errors of iteration."""
        for opcode, body in self:
            if opcode == Opcode.CHUNK:
                yield from records_in(body)
            else:
                yield opcode, body

    def _record(self, opcode: int, size: int) -> tuple[bytes | None, int]:
        """Return a record's body, None if the file ends within it, and its size, 0 if no record follows."""
        body = self._peek(RECORD_HEAD.size, size)
        if len(body) < size - RECORD_HEAD.size:
            return None, 0
        # if none follows, either length may be wrong: the body may be used, the next record has to be searched for
        return body, size if opcode == Opcode.FOOTER else self._way_on(size)

    def _way_on(self, size: int) -> int:
        """Return how far ahead the record after one of this size is, or 0 if it has to be searched for."""
        if not self._followed(size):
            return 0
        if len(self._peek(size, size + RECORD_HEAD.size)) < RECORD_HEAD.size or self._believable(size):
            return size
        # the next record is damaged, or the length is wrong and leads by chance to bytes like a record
        at = 1
        while (candidate := self._find(at)) is not None and candidate < size:
            if self._believable(candidate):
                self.lost_ways += 1
                return candidate
            at = candidate + 1
        return size

    def _chunk(self, size: int) -> tuple[bytes | None, int]:
        """Return a chunk's records as far as they can be read, and its size, or 0 if the size cannot be trusted."""
        shape = self._shape(0)
        if shape is None:
            return None, 0
        self._chunked = True
        data = self._peek(shape.start, size)
        cut = len(data) < size - shape.start
        if not cut:
            try:
                return _decompressed(shape, data), size
            except ImportError as error:
                raise TelemetryError(f"{self._path}: needs {shape.compression}, which is not installed") from error
            except UNREADABLE:
                self.damaged_chunks += 1
        behind = self._peek(size, size + RECORD_HEAD.size)
        if cut or (data.endswith(_ZEROS) and not behind.strip(b"\0")):
            try:
                return _expand(shape, data.rstrip(b"\0") if not cut else data), 0
            except (ImportError, *UNREADABLE):
                return None, 0
        # the damage may have moved the next record: its check is stricter than after an intact record
        return None, size if len(behind) < RECORD_HEAD.size or self._believable(size) else 0

    def _shape(self, at: int) -> _Shape | None:
        """Return the header data of a chunk ``at`` bytes ahead, or None if its lengths contradict each other."""
        at += RECORD_HEAD.size
        head = self._peek(at, at + _CHUNK_HEAD.size)
        if len(head) < _CHUNK_HEAD.size:
            return None
        *_, size, crc, named = _CHUNK_HEAD.unpack(head)
        start = at + _CHUNK_HEAD.size + named + _LENGTH.size
        name = self._peek(at + _CHUNK_HEAD.size, start) if named <= _LONGEST_NAME else b""
        _, length = RECORD_HEAD.unpack(self._peek(at - RECORD_HEAD.size, at))
        if len(name) < named + _LENGTH.size or size > MAX_RECORD_BYTES:
            return None
        if _LENGTH.unpack_from(name, named)[0] != length - (start - at):
            return None
        return _Shape(name[:named].decode("latin-1"), size, crc, start)

    def _followed(self, size: int) -> bool:
        """Return whether another record, or the end of the file, comes ``size`` bytes ahead."""
        head = self._peek(size, size + RECORD_HEAD.size)
        return len(head) < RECORD_HEAD.size or _plausible(*RECORD_HEAD.unpack(head))

    def _peek(self, start: int, stop: int) -> bytes:
        """Return the bytes from ``start`` to ``stop`` ahead, fewer at the end of the file."""
        window = self._window
        window.fill(stop)
        return window.data[window.at + start : window.at + stop]

    def _find(self, start: int) -> int | None:
        """Return how far ahead the next bytes like a record begin in the window, at least ``start``, or None.

        In a file of chunks, only records are searched for that cannot be found inside a chunk.
        """
        window = self._window
        match = (_CHUNKS if self._chunked else _RECORDS).search(window.data, window.at + start)
        return None if match is None else match.start() - window.at

    def _search(self, start: int) -> bool:
        """Go to the next record at least ``start`` bytes ahead; return whether there is one."""
        window = self._window
        self.lost_ways += 1
        at = start
        while True:
            candidate = self._find(at)
            if candidate is None:
                window.at += min(max(at, window.left - _LONGEST_MATCH), window.left)
                at = 0
                if not window.fill(window.left + 1):
                    return False
            elif self._believable(candidate):
                window.at += candidate
                return True
            else:
                at = candidate + 1

    def _believable(self, at: int) -> bool:
        """Return whether the bytes ``at`` bytes ahead, which look like a record, are one."""
        head = self._peek(at, at + RECORD_HEAD.size)
        if len(head) < RECORD_HEAD.size:
            return False
        opcode, length = RECORD_HEAD.unpack(head)
        if opcode == Opcode.CHUNK:
            return self._shape(at) is not None
        if not _plausible(opcode, length) or length > _MAX_SEARCHED_BYTES:
            return False
        end = at + RECORD_HEAD.size + length
        return len(self._peek(end - 1, end)) == 1 and self._followed(end)


def records_in(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield opcode and body of the whole consecutive records in a chunk or a summary."""
    at = 0
    while at + RECORD_HEAD.size <= len(data):
        opcode, length = RECORD_HEAD.unpack_from(data, at)
        start, at = at + RECORD_HEAD.size, at + RECORD_HEAD.size + length
        if at <= len(data):
            yield opcode, data[start:at]


class _Shape(NamedTuple):
    compression: str
    size: int
    crc: int
    start: int


def _plausible(opcode: int, length: int) -> bool:
    """Return whether records of this kind can have this length."""
    if opcode >= _PRIVATE:
        return length <= MAX_RECORD_BYTES
    least = _LEAST_BYTES.get(opcode)
    if least is None or length > MAX_RECORD_BYTES:
        return False
    return length == least if opcode in _FIXED else length >= least


def _decompressed(shape: _Shape, data: bytes) -> bytes:
    """Return a chunk's records; raise one of :data:`UNREADABLE` if checksum, size or compression is wrong."""
    records = _expand(shape, data)
    if len(records) != shape.size or (shape.crc and zlib.crc32(records) != shape.crc):
        raise ValueError("the chunk is damaged")
    return records


def _expand(shape: _Shape, data: bytes) -> bytes:
    """Decompress the available data, at most the size in the chunk's header."""
    if not shape.compression:
        return data
    if shape.compression == "zstd":
        return zstandard.ZstdDecompressor().stream_reader(data).read(shape.size)
    if shape.compression == "lz4":
        import lz4.frame

        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=shape.size))
    raise ValueError(f"unknown compression {shape.compression}")
