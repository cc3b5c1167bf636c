"""Message logs in MCAP: written so that a crash loses nothing flushed, read in the order of writing."""

from __future__ import annotations

import contextlib
import os
import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Self, cast

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError, UnsupportedCompressionError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, Metadata, Schema
from mcap.stream_reader import get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC

from adapters.compressed import CompressedFile
from adapters.errors import TelemetryError
from adapters.mcap_writer import McapWriter
from adapters.message import Message
from adapters.message_record import Decode, decoder, encode
from adapters.record import Record

MAX_CHANNELS = 4096
MAX_RECORD_BYTES = 512 * 1024 * 1024

_RECORD_HEAD = struct.Struct("<BQ")
_MESSAGE_HEAD = struct.Struct("<HIQQ")
_UNREADABLE = (McapError, struct.error, ValueError, KeyError, OverflowError, zstandard.ZstdError)
_Read = Callable[[int], bytes]


@dataclass(frozen=True, slots=True)
class WriterStatistics:
    """What a log writer did so far.

    Parameters
    ----------
    records : int
        Records taken, on all topics.
    unrecordable : int
        Messages left out because no record can hold them: values no JSON knows, a time before 1970, or more
        topics than :data:`MAX_CHANNELS`.
    written : int
        Records handed to the operating system; the others wait in the current chunk, or were lost to a write
        that failed.
    """

    records: int
    unrecordable: int
    written: int


class MessageLogWriter:
    """Writes telemetry, and records of other topics beside it, into one MCAP file.

    MAVLink messages go to ``/mavlink/<NAME>`` as protobuf (as JSON where a message has other fields than
    pymavlink's definition), Zenoh JSON to ``/zenoh/<key>`` as JSON. Log time and publish time are the time of
    arrival; the order in the file is the order of the calls. Not for several threads at once.

    Parameters
    ----------
    target : str | PathLike | BinaryIO
        File to create, or a stream to write to (left open at the end).

    Raises
    ------
    TelemetryError
        The file cannot be created.
    OSError
        A write failed, in any method. The file is whole up to the last chunk; only :meth:`close` is of use then.
    """

    def __init__(self, target: str | os.PathLike[str] | BinaryIO) -> None:
        self._owned: BinaryIO | None = None
        if isinstance(target, str | os.PathLike):
            try:
                # unbuffered: a buffer would keep what could not be written, and try again on closing
                target = self._owned = cast(BinaryIO, Path(target).open("wb", buffering=0))  # noqa: SIM115 - close()
            except OSError as error:
                raise TelemetryError(f"{target}: cannot be written: {error.strerror}") from error
        try:
            self._writer = McapWriter(target)
        except OSError:
            if self._owned is not None:
                self._owned.close()
            raise
        self._channels: dict[tuple[str, str], int] = {}
        self._records = 0
        self._unrecordable = 0
        self._closed = False

    @property
    def size(self) -> int:
        """Bytes the file will have at most if it is closed now."""
        return self._writer.size

    def write(self, message: Message) -> None:
        """Record a telemetry message; one that cannot be recorded is counted and left out."""
        try:
            record = encode(message)
        except ValueError:
            self._unrecordable += 1
            return
        self.write_record(record)

    def write_record(self, record: Record) -> None:
        """Record what is encoded already; the schema goes into the file with the topic's first record."""
        if self._closed:
            raise RuntimeError("the log is closed; open another one")
        channel = self._channels.get((record.topic, record.encoding)) or self._register(record)
        if channel is None or not 0 <= record.time_ns < 1 << 64:
            self._unrecordable += 1
            return
        self._records += 1
        self._writer.add_message(channel, record.time_ns, record.data)

    def add_metadata(self, name: str, entries: Mapping[str, str]) -> None:
        """Write a metadata record."""
        self._writer.add_metadata(name, entries)

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        """Attach a file."""
        self._writer.add_attachment(name, media_type, data)

    def flush(self) -> None:
        """Hand everything written so far to the operating system: it then survives ``kill -9``."""
        if not self._closed:
            self._writer.flush()

    def close(self) -> None:
        """Finish the file with its index; a second call does nothing."""
        if self._closed:
            return
        self._closed = True
        try:
            self._writer.finish()
        finally:
            if self._owned is not None:
                self._owned.close()

    def statistics(self) -> WriterStatistics:
        """Return the counts so far."""
        return WriterStatistics(self._records, self._unrecordable, self._writer.written)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _register(self, record: Record) -> int | None:
        """Return the id of a new channel, None where the file has too many already."""
        if len(self._channels) >= MAX_CHANNELS:
            return None
        schema = record.schema
        schema_id = 0 if schema is None else self._writer.add_schema(schema.name, schema.encoding, schema.data)
        channel = self._writer.add_channel(record.topic, record.encoding, schema_id)
        self._channels[record.topic, record.encoding] = channel
        return channel


@dataclass(frozen=True, slots=True)
class ReaderStatistics:
    """What a log reader found so far.

    Parameters
    ----------
    messages : int
        Messages returned.
    other_records : int
        Records of topics that are no telemetry, among them our own estimates and alarms.
    damaged_chunks : int
        Blocks of records that were lost because their checksum or compression does not hold.
    damaged_records : int
        Single records that cannot be decoded.
    stopped_at : int | None
        Byte at which an unfinished or broken file could not be read on; None after a proper end.
    """

    messages: int
    other_records: int
    damaged_chunks: int
    damaged_records: int
    stopped_at: int | None


class MessageLogReader:
    """Reads a log's telemetry in the order it was written, also from unfinished and damaged files.

    Iterate over it once; :meth:`statistics` tells what was found and what was not.

    Parameters
    ----------
    path : str | PathLike
        A ``.mcap`` file, plain or with ``.xz`` or ``.gz`` behind.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self._path = Path(path)
        self._schemas: dict[int, Schema] = {}
        self._decoders: dict[int, Decode | None] = {}
        self._messages = 0
        self._other_records = 0
        self._damaged_chunks = 0
        self._damaged_records = 0
        self._stopped_at: int | None = None

    def statistics(self) -> ReaderStatistics:
        """Return the counts so far."""
        return ReaderStatistics(
            messages=self._messages,
            other_records=self._other_records,
            damaged_chunks=self._damaged_chunks,
            damaged_records=self._damaged_records,
            stopped_at=self._stopped_at,
        )

    def __iter__(self) -> Iterator[Message]:
        """Return the messages.

        Raises
        ------
        TelemetryError
            The file cannot be opened, is no MCAP file or needs a compression that is not installed.
        """
        read = _open_log(self._path)
        self._learn_from_index()
        for opcode, body in self._records(read):
            if opcode == Opcode.CHUNK:
                yield from self._from_chunk(body)
            elif (message := self._from_record(opcode, body)) is not None:
                yield message

    def metadata(self, *, ahead_only: bool = False) -> dict[str, dict[str, str]]:
        """Return the metadata records by name; later entries of the same name and key win.

        With ``ahead_only``, those that stand ahead of all data, for which the file need not be read to its end.
        """
        found: dict[str, dict[str, str]] = {}
        for opcode, body in self._records(_open_log(self._path)):
            if ahead_only and opcode in (Opcode.CHUNK, Opcode.MESSAGE):
                break
            if opcode == Opcode.METADATA:
                with contextlib.suppress(*_UNREADABLE):
                    record = Metadata.read(ReadDataStream(BytesIO(body)))
                    found.setdefault(record.name, {}).update(record.metadata)
        return found

    def _records(self, read: _Read) -> Iterator[tuple[int, bytes]]:
        """Return (opcode, body) of each record behind the magic, up to the footer or where it breaks off."""
        at = len(MCAP0_MAGIC)
        opcode = 0
        while opcode != Opcode.FOOTER:
            self._stopped_at = at
            head = read(_RECORD_HEAD.size)
            if len(head) < _RECORD_HEAD.size:
                return
            opcode, length = _RECORD_HEAD.unpack(head)
            if not opcode or length > MAX_RECORD_BYTES or len(body := read(length)) < length:
                return
            at += len(head) + length
            yield opcode, body
        self._stopped_at = None

    def _learn_from_index(self) -> None:
        """Take schemas and channels from a finished file's end; their own chunk may be damaged."""
        if self._path.suffix in (".xz", ".gz"):
            return
        # a length that damage made up may be more than there is memory
        with contextlib.suppress(*_UNREADABLE, MemoryError, OSError), self._path.open("rb") as stream:
            stream.seek(-len(MCAP0_MAGIC), os.SEEK_END)
            if stream.read() != MCAP0_MAGIC:
                return
            stream.seek(0)
            summary = SeekingReader(stream, record_size_limit=MAX_RECORD_BYTES).get_summary()
            if summary is not None:
                self._schemas.update(summary.schemas)
                for channel in summary.channels.values():
                    self._define(channel)

    def _from_chunk(self, body: bytes) -> Iterator[Message]:
        try:
            data = _chunk_data(body)
        except UnsupportedCompressionError as error:
            raise TelemetryError(f"{self._path}: {error}; install it or convert the file to zstd") from error
        except _UNREADABLE:
            self._damaged_chunks += 1
            return
        at = 0
        while at + _RECORD_HEAD.size <= len(data):
            opcode, length = _RECORD_HEAD.unpack_from(data, at)
            at += _RECORD_HEAD.size
            if (message := self._from_record(opcode, data[at : at + length])) is not None:
                yield message
            at += length

    def _from_record(self, opcode: int, body: bytes) -> Message | None:
        """Take in one record; return the message where it is one of telemetry."""
        try:
            if opcode == Opcode.SCHEMA:
                schema = Schema.read(ReadDataStream(BytesIO(body)))
                self._schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                self._define(Channel.read(ReadDataStream(BytesIO(body))))
            elif opcode == Opcode.MESSAGE:
                channel, _, log_time, _ = _MESSAGE_HEAD.unpack_from(body)
                decode = self._decoders[channel]
                if decode is None:
                    self._other_records += 1
                    return None
                message = decode(body[_MESSAGE_HEAD.size :], log_time)
                self._messages += 1
                return message
        except _UNREADABLE:
            self._damaged_records += 1
        return None

    def _define(self, channel: Channel) -> None:
        schema = self._schemas.get(channel.schema_id)
        self._decoders[channel.id] = decoder(
            channel.topic, channel.message_encoding, None if schema is None else (schema.name, schema.data)
        )


def read_mcap_messages(path: str | os.PathLike[str]) -> Iterator[Message]:
    """Return a log's telemetry in the order it was written; see :class:`MessageLogReader`."""
    return iter(MessageLogReader(path))


def read_mcap_metadata(path: str | os.PathLike[str], *, ahead_only: bool = False) -> dict[str, dict[str, str]]:
    """Return a log's metadata records by name; see :meth:`MessageLogReader.metadata`."""
    return MessageLogReader(path).metadata(ahead_only=ahead_only)


def _chunk_data(body: bytes) -> bytes:
    """Return a chunk's records, decompressed and checked against its checksum."""
    chunk = Chunk.read(ReadDataStream(BytesIO(body)))
    sizes = [chunk.uncompressed_size]
    if chunk.compression == "zstd":
        sizes.append(zstandard.frame_content_size(chunk.data))
    if max(sizes) > MAX_RECORD_BYTES:
        raise ValueError("chunk claims an absurd size")
    stream, length = get_chunk_data_stream(chunk, validate_crc=True)
    return stream.read(length)


def _open_log(path: Path) -> _Read:
    """Open a recording, plain or compressed, step over its magic, and return what reads on from there.

    That returns as many bytes as asked for, fewer only where the file ends or its compression is damaged.
    """
    pieces = iter(CompressedFile(path))
    held = bytearray()

    def read(count: int) -> bytes:
        while len(held) < count and (piece := next(pieces, None)) is not None:
            held.extend(piece)
        taken = bytes(held[:count])
        del held[:count]
        return taken

    if read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
        raise TelemetryError(f"{path}: not an MCAP file although its name says so; check where it came from")
    return read
