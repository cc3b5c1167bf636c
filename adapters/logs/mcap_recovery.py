"""Finishes MCAP files that were not closed: what is whole stays where it is, the summary is put behind it."""

from __future__ import annotations

import contextlib
import fcntl
import os
import struct
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, ChunkIndex, Metadata
from mcap.writer import MCAP0_MAGIC

from adapters.errors import StorageError
from adapters.logs.mcap_log import MessageLogWriter, encoded
from adapters.logs.mcap_records import CHUNK_HEAD, RECORD_HEAD, UNREADABLE, McapRecords, records_in

# of a message: channel, sequence, log time, publish time
_MESSAGE = struct.Struct("<HIQQ")


@dataclass(frozen=True, slots=True)
class Recovery:
    """What finishing a file did."""

    path: Path
    messages: int  # in the file now
    cut_bytes: int  # of the end: the beginning of a record, without a whole message


@dataclass(slots=True)
class _Chunk:
    """A chunk, its index as far as it is there, and its messages: channel, times and payload of each."""

    index: ChunkIndex
    is_whole: bool
    messages: list[tuple[int, int, int, bytes]] = field(default_factory=list)

    @property
    def counts(self) -> dict[int, int]:
        """Messages by channel."""
        counts: dict[int, int] = {}
        for channel, *_ in self.messages:
            counts[channel] = counts.get(channel, 0) + 1
        return counts

    @property
    def is_indexed(self) -> bool:
        """Whether it and the index of its messages are there."""
        return self.is_whole and self.counts.keys() == self.index.message_index_offsets.keys()


def is_unfinished(path: Path) -> bool:
    """Return whether a file begins as MCAP and does not end so; raises OSError where it cannot be read."""
    with path.open("rb") as file:
        begins = file.read(len(MCAP0_MAGIC)) == MCAP0_MAGIC
        file.seek(-min(len(MCAP0_MAGIC), file.seek(0, os.SEEK_END)), os.SEEK_END)
        return begins and file.read() != MCAP0_MAGIC


def finish(path: Path) -> Recovery | None:
    """Give an unfinished file its index; of a message that was cut off, and what is damaged, nothing changes.

    None is returned where the file is finished already.

    Raises
    ------
    StorageError
        The file cannot be written, or is being written.
    TelemetryError
        It is no MCAP file, or needs a compression that is not installed.
    """
    try:
        with path.open("r+b", buffering=0) as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                raise StorageError(f"{path}: is being written; it is finished when that ends") from None
            return _Finisher(path, file).run() if is_unfinished(path) else None
    except OSError as error:
        raise StorageError(f"{path}: cannot be finished: {error.strerror}") from error


class _Finisher(MessageLogWriter):
    """Takes in what a file holds as if it had written it, and goes on behind it."""

    def __init__(self, path: Path, file: BinaryIO) -> None:
        super().__init__(BytesIO())
        self._path, self._file = path, file
        self._defined: dict[tuple[int, int], bytes] = {}

    def run(self) -> Recovery:
        """Finish the file."""
        scan, last, end = McapRecords(self._path), None, len(MCAP0_MAGIC)
        size = self._file.seek(0, os.SEEK_END)
        for opcode, body in scan:
            at = scan.stopped_at or 0
            self._file.seek(at)
            stop = at + RECORD_HEAD.size + RECORD_HEAD.unpack(self._file.read(RECORD_HEAD.size))[1]
            if opcode == Opcode.DATA_END:
                size = end
                break
            if opcode == Opcode.MESSAGE_INDEX and last is not None:
                last.index.message_index_offsets[struct.unpack_from("<H", body)[0]] = at
                last.index.message_index_length += stop - at
            else:
                self._keep(last)
                last = self._chunk(at, stop, body) if opcode == Opcode.CHUNK else None
                self._take(opcode, body, at, stop)
            if stop <= size and (last is None or last.is_whole):
                end = stop
        # The last chunk is written once more where it, or its index, was cut off.
        again = None if last is None or last.is_indexed else last
        if again is not None:
            end = again.index.chunk_start_offset
        else:
            self._keep(last)
        self._schemas = self._records_of(Opcode.SCHEMA)
        self._channels = self._records_of(Opcode.CHANNEL)
        self._file.truncate(end)
        self._file.seek(end)
        self._stream, self._at = self._file, end
        if again is not None:
            self._definitions += self._schemas + self._channels
            for channel, time_ns, publish_ns, data in again.messages:
                self.add_all([channel], [data], [time_ns], publish_ns)
        self.close()
        os.fsync(self._file.fileno())
        return Recovery(self._path, self.written, 0 if again else size - end)

    def _chunk(self, at: int, stop: int, body: bytes) -> _Chunk:
        """Return a chunk; learn the definitions in it."""
        self._file.seek(at + RECORD_HEAD.size)
        first, last, size, _, named = CHUNK_HEAD.unpack(self._file.read(CHUNK_HEAD.size))
        compression = self._file.read(named).decode("latin-1")
        packed = stop - at - RECORD_HEAD.size - CHUNK_HEAD.size - named - 8
        chunk = _Chunk(ChunkIndex(stop - at, at, compression, packed, last, 0, {}, first, size), len(body) == size)
        for opcode, record in records_in(body):
            if opcode == Opcode.MESSAGE and len(record) >= _MESSAGE.size:
                channel, _, time_ns, publish_ns = _MESSAGE.unpack_from(record)
                chunk.messages.append((channel, time_ns, publish_ns, record[_MESSAGE.size :]))
            else:
                self._define(opcode, record)
        return chunk

    def _take(self, opcode: int, body: bytes, at: int, stop: int) -> None:
        """Learn a record outside of chunks; one that cannot be read gets no index."""
        with contextlib.suppress(McapError, *UNREADABLE):
            stream = ReadDataStream(BytesIO(body))
            if opcode == Opcode.ATTACHMENT:
                self._index_attachment(Attachment.read(stream), at, stop - at)
            elif opcode == Opcode.METADATA:
                self._index_metadata(Metadata.read(stream).name, at, stop - at)
            elif opcode == Opcode.MESSAGE:
                channel, _, time_ns, _ = _MESSAGE.unpack_from(body)
                self._count(time_ns, time_ns, {channel: 1})
                self._totals.chunk_count -= 1
            else:
                self._define(opcode, body)

    def _define(self, opcode: int, body: bytes) -> None:
        """Keep a schema or a channel."""
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            self._defined[opcode, struct.unpack_from("<H", body)[0]] = RECORD_HEAD.pack(opcode, len(body)) + body

    def _records_of(self, opcode: int) -> bytearray:
        records = [record for (kind, _), record in self._defined.items() if kind == opcode]
        if opcode == Opcode.SCHEMA:
            self._totals.schema_count = len(records)
        else:
            self._totals.channel_count = len(records)
        return bytearray().join(records)

    def _keep(self, chunk: _Chunk | None) -> None:
        """Index a whole chunk."""
        if chunk is not None and chunk.is_whole:
            self._chunk_indexes += encoded(chunk.index)
            self._count(chunk.index.message_start_time, chunk.index.message_end_time, chunk.counts)
