"""Writes message logs in MCAP, so that a crash loses nothing flushed; :mod:`adapters.logs.mcap_reader` reads them.

The mcap package's writer keeps an object with a dictionary for each chunk, some 9 MB an hour where records are
flushed twice a second, and is left with half a record when a write fails. Here a chunk is written at once with its
index, of which only the bytes stay, a write that fails is taken back, and the file still gets its summary where there
is room for one.
"""

import contextlib
import fcntl
import io
import os
import struct
import zlib
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from itertools import accumulate
from pathlib import Path
from typing import Any, BinaryIO, Self, cast

import numpy as np
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Statistics,
    SummaryOffset,
)
from mcap.records import Schema as McapSchema
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray

from adapters.encoding.message_record import encode
from adapters.encoding.record import Record, Schema
from adapters.errors import StorageError
from adapters.logs.mcap_records import RECORD_HEAD
from adapters.message import Message

MAX_CHANNELS = 4096
"""Most channels of a file. Topics come from the network: the memory for them, and for their schemas, has to be
bounded."""
CHUNK_BYTES = 128 * 1024
"""Bytes of messages in a chunk, before compression. Chosen: the loss from damage to one byte, some seconds of
telemetry; larger chunks compress a few per cent better."""

_COMPRESSION = b"zstd"
# opcode, length of the rest, then the record's own fields
_MESSAGE = np.dtype(
    [("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"), ("log", "<u8"), ("publish", "<u8")]
)
_CHUNK = struct.Struct("<BQQQQII4sQ")
_MESSAGE_INDEX = struct.Struct("<BQHI")
_INDEX_ENTRY = np.dtype([("time", "<u8"), ("offset", "<u8")])
_FOOTER = struct.Struct("<BQQQ")
_FOOTER_BYTES = 20
_MESSAGE_BYTES = _MESSAGE.itemsize
# footer, statistics and summary offsets, without the channels' counts
_SUMMARY_BYTES = 1024


class MessageLogWriter:
    """Writes telemetry, and records of other topics beside it, into one MCAP file with chunks, indexes and a summary.

    MAVLink messages go to ``/mavlink/<NAME>`` as protobuf (as JSON if the fields are not those of pymavlink's
    definition), Zenoh JSON to ``/zenoh/<key>`` as JSON. Log time and publish time are the time of arrival; the order in
    the file is the order of the calls. A writer is not safe for several threads.

    ``target`` is a file to create, or a stream to write to from its beginning (left open at the end). In an unbuffered
    file (``io.FileIO``) the bytes of a failed write are cut off again.

    ``records`` counts the accepted records, ``unrecordable`` the messages left out because no record can hold them:
    values that JSON lacks, a time before 1970, or more topics than :data:`MAX_CHANNELS`.

    Raises
    ------
    StorageError
        The file cannot be created.
    OSError
        A write failed, in any method. The file is whole up to the last chunk; only :meth:`close` and :meth:`resume` can
        be called then.
    """

    def __init__(self, target: str | os.PathLike[str] | BinaryIO) -> None:
        self._owned: BinaryIO | None = None
        if isinstance(target, str | os.PathLike):
            try:
                # unbuffered: a buffer would keep bytes that could not be written, and write them again on closing
                target = self._owned = cast(BinaryIO, Path(target).open("wb", buffering=0))  # noqa: SIM115 - close()
                # so that nobody finishes a file that is being written; without a lock it is written all the same
                with contextlib.suppress(OSError):
                    fcntl.flock(target, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                raise StorageError(
                    f"{target}: cannot be written: {error.strerror}; its folder has to exist and be writable"
                ) from error
        self._stream = target
        self._failed: OSError | None = None
        self._closed = False
        self._at = 0
        self.records = self.unrecordable = 0
        self._compressor = zstandard.ZstdCompressor()
        self._begin_chunk()
        self._channel_ids: dict[tuple[str, str, Schema | None], int] = {}
        self._schemas = bytearray()
        self._channels = bytearray()
        self._chunk_indexes = bytearray()
        self._attachment_indexes = bytearray()
        self._metadata_indexes = bytearray()
        self._metadata_offsets: dict[tuple[str, int], int] = {}
        self._totals = Statistics(
            attachment_count=0,
            channel_count=0,
            channel_message_counts={},
            chunk_count=0,
            message_count=0,
            metadata_count=0,
            message_start_time=0,
            message_end_time=0,
            schema_count=0,
        )
        try:
            self._write(MCAP0_MAGIC + _encoded(Header(profile="", library="fauio")))
        except OSError:
            self._closed = True
            if self._owned is not None:
                self._owned.close()
            raise

    @property
    def size(self) -> int:
        """Largest size that the file would have if it were closed now, bytes."""
        return (
            self._at
            + len(self._definitions)
            + self._message_bytes
            + len(self._channel_of) * _INDEX_ENTRY.itemsize
            + min(len(self._channel_of), self._totals.channel_count) * 2 * _MESSAGE_INDEX.size
            + len(self._schemas)
            + 2 * len(self._channels)
            + len(self._chunk_indexes)
            + len(self._attachment_indexes)
            + len(self._metadata_indexes)
            + _SUMMARY_BYTES
        )

    @property
    def written(self) -> int:
        """Records handed to the operating system."""
        return self._totals.message_count

    @property
    def failed(self) -> bool:
        """Whether a write has failed since the begin or the last :meth:`resume`."""
        return self._failed is not None

    def write(self, message: Message) -> None:
        """Record a telemetry message; one that cannot be recorded is counted and left out."""
        try:
            record = encode(message)
        except ValueError:
            self.unrecordable += 1
            return
        self.write_record(record)

    def write_record(self, record: Record) -> None:
        """Record an encoded message; a schema is written with the topic's first record of that kind."""
        channel = self.channel(record.topic, record.encoding, record.schema)
        if channel is None or not 0 <= record.time_ns < 1 << 64:
            self.unrecordable += 1
            return
        self.add_all([channel], [record.data], [record.time_ns], record.publish_ns)

    def channel(self, topic: str, encoding: str, schema: Schema | None) -> int | None:
        """Return a channel's id for :meth:`add_all`, or None if it would be new and the file has too many already."""
        known = self._channel_ids.get((topic, encoding, schema))
        if known is not None or len(self._channel_ids) >= MAX_CHANNELS:
            return known
        schema_id = 0
        if schema is not None:
            schema_id = self._totals.schema_count = self._totals.schema_count + 1
            record = _encoded(McapSchema(id=schema_id, name=schema.name, encoding=schema.encoding, data=schema.data))
            self._schemas += record
            self._definitions += record
        number = self._totals.channel_count = self._totals.channel_count + 1
        record = _encoded(Channel(id=number, topic=topic, message_encoding=encoding, metadata={}, schema_id=schema_id))
        self._channels += record
        self._definitions += record
        self._channel_ids[topic, encoding, schema] = number
        return number

    def add_all(
        self, channels: Sequence[int], data: Sequence[bytes], times_ns: Sequence[int], publish_ns: int | None = None
    ) -> None:
        """Record encoded data, each on its channel, in their order.

        Times are Unix nanoseconds, not negative and of at most 64 bits. Without a publish time the log time is used for
        it.
        """
        if self._closed:
            raise RuntimeError("the log is closed; open another one")
        self.records += len(data)
        if self._failed is not None:
            raise _again(self._failed)
        # the parts of a chunk are only collected here; they are joined for all its messages at once
        ends = [0, *accumulate(map(_MESSAGE_BYTES.__add__, map(len, data)))]
        start = 0
        while start < len(data):
            room = CHUNK_BYTES - self._message_bytes
            stop = min(len(data), bisect_right(ends, ends[start] + room, start + 1))
            self._channel_of += channels[start:stop]
            self._log_ns += times_ns[start:stop]
            self._data += data[start:stop]
            if publish_ns is not None:
                self._publish_ns[len(self._data) - 1] = publish_ns
            self._message_bytes += ends[stop] - ends[start]
            if self._message_bytes > CHUNK_BYTES:
                self._end_chunk()
            start = stop

    def add_metadata(self, name: str, entries: Mapping[str, str]) -> None:
        """Write a metadata record."""
        record = _encoded(Metadata(name=name, metadata=dict(entries)))
        at = self._metadata_offsets[name, len(record)] = self._at
        self._write(record)
        self._metadata_indexes += _encoded(MetadataIndex(at, len(record), name))
        self._totals.metadata_count += 1

    def amend_metadata(self, name: str, entries: Mapping[str, str]) -> None:
        """Replace a metadata record, which is written early for readers that stop at the first message.

        Its length has to stay the same: values that are unknown at first are blanks. In a stream that cannot seek, the
        record stays unchanged.

        Raises
        ------
        ValueError
            There is no record of that name and length.
        """
        record = _encoded(Metadata(name=name, metadata=dict(entries)))
        offset = self._metadata_offsets.get((name, len(record)))
        if offset is None:
            raise ValueError(f"no metadata record '{name}' of {len(record)} bytes")
        if self._stream.seekable():
            self._stream.seek(offset)
            self._stream.write(record)
            self._stream.seek(self._at)

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        """Attach a file; its times are zero, which MCAP reads as unknown."""
        record, at = _encoded(Attachment(0, 0, name, media_type, data)), self._at
        self._write(record)
        self._attachment_indexes += _encoded(AttachmentIndex(at, len(record), 0, 0, len(data), name, media_type))
        self._totals.attachment_count += 1

    def flush(self) -> None:
        """Pass everything written so far to the operating system: it then survives ``kill -9``."""
        if not self._closed:
            self._end_chunk()
            self._stream.flush()

    def resume(self) -> None:
        """Continue after the last whole chunk when a write has failed; messages added since are lost.

        Raises
        ------
        OSError
            The bytes of the failed write cannot be cut off.
        """
        if self._failed is None:
            return
        self._stream.truncate(self._at)
        self._stream.seek(self._at)
        self._failed = None
        self._begin_chunk()
        # again, since the first definitions may be among the lost bytes
        self._definitions += self._schemas + self._channels

    def close(self) -> None:
        """Write the remaining messages (not after a failure) and the summary; then refuse writes."""
        if self._closed:
            return
        self._closed = True
        try:
            if self._failed is None:
                self._end_chunk()
            self._failed = None
            self._begin_chunk()
            self._write(_encoded(DataEnd(data_section_crc=0)) + self._summary(self._at + RECORD_HEAD.size + 4))
            self._stream.flush()
        finally:
            if self._owned is not None:
                self._owned.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _end_chunk(self) -> None:
        if not self._channel_of:
            return
        channel, times_ns = np.array(self._channel_of, np.uint16), np.array(self._log_ns, np.uint64)
        chunk, offsets = self._records(channel, times_ns)
        first, last = int(times_ns.min()), int(times_ns.max())
        packed = self._compressor.compress(chunk)
        head = _CHUNK.pack(
            Opcode.CHUNK,
            _CHUNK.size - RECORD_HEAD.size + len(packed),
            first,
            last,
            len(chunk),
            zlib.crc32(chunk),
            len(_COMPRESSION),
            _COMPRESSION,
            len(packed),
        )
        parts = [head, packed]
        chunk_bytes = at = len(head) + len(packed)
        order = np.argsort(channel, kind="stable")
        entries = np.empty(len(order), _INDEX_ENTRY)
        entries["time"], entries["offset"] = times_ns[order], offsets[order]
        numbers, starts = np.unique(channel[order], return_index=True)
        counts = np.diff(starts, append=len(order))
        places = {}
        for number, start, count in zip(numbers.tolist(), starts.tolist(), counts.tolist(), strict=True):
            places[number] = self._at + at
            size = count * _INDEX_ENTRY.itemsize
            parts += (
                _MESSAGE_INDEX.pack(Opcode.MESSAGE_INDEX, 6 + size, number, size),
                entries[start : start + count].tobytes(),
            )
            at += _MESSAGE_INDEX.size + size
        index = ChunkIndex(
            chunk_length=chunk_bytes,
            chunk_start_offset=self._at,
            compression=_COMPRESSION.decode(),
            compressed_size=len(packed),
            message_end_time=last,
            message_index_length=at - chunk_bytes,
            message_index_offsets=places,
            message_start_time=first,
            uncompressed_size=len(chunk),
        )
        self._write(b"".join(parts))
        self._chunk_indexes += _encoded(index)
        self._count(first, last, dict(zip(numbers.tolist(), counts.tolist(), strict=True)))
        self._begin_chunk()

    def _records(self, channel: NDArray[np.uint16], times_ns: NDArray[np.uint64]) -> tuple[bytes, NDArray[np.int64]]:
        """Return the chunk's records, definitions first, and the offset of each message in it."""
        data = self._data
        length = np.fromiter(map(len, data), np.int64, len(data)) + _MESSAGE_BYTES
        heads = np.zeros(len(data), _MESSAGE)
        heads["opcode"], heads["length"] = Opcode.MESSAGE, length - RECORD_HEAD.size
        heads["channel"], heads["log"] = channel, times_ns
        heads["publish"] = times_ns
        for message, publish_ns in self._publish_ns.items():
            heads["publish"][message] = publish_ns
        parts = [b""] * (2 * len(data))
        parts[::2], parts[1::2] = heads.view(f"V{_MESSAGE_BYTES}").tolist(), data
        records = b"".join([bytes(self._definitions), *parts])
        return records, len(self._definitions) + np.cumsum(length) - length

    def _begin_chunk(self) -> None:
        # schemas and channels of the messages; channel, time and payload of each; publish times that are others
        self._definitions = bytearray()
        self._channel_of: list[int] = []
        self._log_ns: list[int] = []
        self._publish_ns: dict[int, int] = {}
        self._data: list[bytes] = []
        self._message_bytes = 0

    def _count(self, first: int, last: int, counts: Mapping[int, int]) -> None:
        totals = self._totals
        totals.message_start_time = min(totals.message_start_time, first) if totals.chunk_count else first
        totals.message_end_time = max(totals.message_end_time, last)
        totals.chunk_count += 1
        for channel, count in counts.items():
            totals.message_count += count
            totals.channel_message_counts[channel] = totals.channel_message_counts.get(channel, 0) + count

    def _summary(self, start: int) -> bytes:
        """Return summary, footer and magic of a file whose summary begins at byte ``start``."""
        groups = {
            Opcode.SCHEMA: bytes(self._schemas),
            Opcode.CHANNEL: bytes(self._channels),
            Opcode.STATISTICS: _encoded(self._totals),
            Opcode.CHUNK_INDEX: bytes(self._chunk_indexes),
            Opcode.ATTACHMENT_INDEX: bytes(self._attachment_indexes),
            Opcode.METADATA_INDEX: bytes(self._metadata_indexes),
        }
        offsets = b""
        at = start
        for opcode, group in groups.items():
            if group:
                offsets += _encoded(SummaryOffset(group_opcode=opcode, group_start=at, group_length=len(group)))
            at += len(group)
        summary = b"".join(groups.values()) + offsets
        crc = zlib.crc32(_FOOTER.pack(Opcode.FOOTER, _FOOTER_BYTES, start, at), zlib.crc32(summary))
        return summary + _encoded(Footer(summary_start=start, summary_offset_start=at, summary_crc=crc)) + MCAP0_MAGIC

    def _write(self, data: bytes) -> None:
        """Write all data or none."""
        if self._failed is not None:
            raise _again(self._failed)
        remaining = memoryview(data)
        try:
            while remaining:
                # an unbuffered file may write a part, and report the reason only at the next write
                remaining = remaining[self._stream.write(remaining) :]
        except OSError as error:
            # the error of a write does not name the file
            self._failed = OSError(error.errno, error.strerror, getattr(self._stream, "name", None))
            if isinstance(self._stream, io.FileIO):
                with contextlib.suppress(OSError):
                    self._stream.truncate(self._at)
                    self._stream.seek(self._at)
            raise _again(self._failed) from error
        self._at += len(data)


def _encoded(record: McapRecord) -> bytes:
    """Return a record as its bytes in a file."""
    builder: Any = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())


def _again(error: OSError) -> OSError:
    return OSError(error.errno, error.strerror, error.filename)
