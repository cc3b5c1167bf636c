"""Finishes MCAP files that were not closed: the mcap library writes all whole messages anew, with an index."""

import contextlib
import fcntl
import os
import shutil
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Header, Metadata, Schema
from mcap.writer import MCAP0_MAGIC, Writer

from adapters.errors import StorageError
from adapters.logs.mcap_log import CHUNK_BYTES
from adapters.logs.mcap_records import MESSAGE_HEAD, UNREADABLE, McapRecords


@dataclass(frozen=True, slots=True)
class Recovery:
    """The result of finishing a file."""

    path: Path
    messages: int  # in the file now
    cut_bytes: int  # bytes of a record at the end that was cut off; its whole messages are kept


def is_unfinished(path: Path) -> bool:
    """Return whether a file begins as MCAP and does not end as MCAP; raise OSError if it cannot be read."""
    with path.open("rb") as file:
        begins = file.read(len(MCAP0_MAGIC)) == MCAP0_MAGIC
        file.seek(-min(len(MCAP0_MAGIC), file.seek(0, os.SEEK_END)), os.SEEK_END)
        return begins and file.read() != MCAP0_MAGIC


def finish(path: Path) -> Recovery | None:
    """Replace an unfinished file by a finished one; a file with damage inside is kept as ``NAME.damaged``.

    None is returned if the file is finished already.

    Raises
    ------
    StorageError
        The file cannot be written, or is being written.
    TelemetryError
        It is not an MCAP file, or needs a compression that is not installed.
    """
    copy_path = path.with_name(f".{path.name}.finishing")
    try:
        with path.open("r+b", buffering=0) as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                raise StorageError(f"{path}: is being written; it is finished when that ends") from None
            return _finish(path, copy_path) if is_unfinished(path) else None
    except OSError as error:
        raise StorageError(f"{path}: cannot be finished: {error.strerror}") from error
    finally:
        copy_path.unlink(missing_ok=True)


def _finish(path: Path, copy_path: Path) -> Recovery:
    scan, cut_bytes = McapRecords(path), 0
    with copy_path.open("wb") as stream:
        copy = _Copy(stream)
        for opcode, body in scan.flat():
            if opcode == Opcode.DATA_END:
                break
            # an unreadable message is left out
            with contextlib.suppress(McapError, *UNREADABLE):
                copy.add(opcode, body)
        else:
            cut_bytes = path.stat().st_size - (scan.stopped_at or 0)
        copy.begin()
        copy.writer.finish()
        stream.flush()
        os.fsync(stream.fileno())
    shutil.copymode(path, copy_path)
    if scan.damaged_chunks or scan.lost_ways > scan.broken_off:
        path.rename(path.with_name(f"{path.name}.damaged"))
    copy_path.replace(path)
    return Recovery(path, copy.messages, cut_bytes)


class _Copy:
    """A file into which records are copied; ``messages`` counts them."""

    def __init__(self, stream: BinaryIO) -> None:
        self.writer: Any = Writer(stream, chunk_size=CHUNK_BYTES)
        self.messages = 0
        self._begun = False
        # definitions by their ids in the source file, and their ids in this one
        self._schemas: dict[int, tuple[Schema, int]] = {}
        self._channels: dict[int, tuple[Channel, int]] = {}

    def begin(self, profile: str = "", library: str = "fauio") -> None:
        """Write the header of the file, unless it was written."""
        if not self._begun:
            self._begun = True
            self.writer.start(profile, library)

    def add(self, opcode: int, body: bytes) -> None:
        """Add a record, unless it is an index."""
        stream = ReadDataStream(BytesIO(body))
        if opcode == Opcode.HEADER:
            header = Header.read(stream)
            self.begin(header.profile, header.library)
        self.begin()
        if opcode == Opcode.MESSAGE:
            channel, sequence, time_ns, publish_ns = MESSAGE_HEAD.unpack_from(body)
            self.writer.add_message(
                self._channels[channel][1], time_ns, body[MESSAGE_HEAD.size :], publish_ns, sequence
            )
            self.messages += 1
        elif opcode == Opcode.SCHEMA:
            self._add_schema(Schema.read(stream))
        elif opcode == Opcode.CHANNEL:
            self._add_channel(Channel.read(stream))
        elif opcode == Opcode.METADATA:
            metadata = Metadata.read(stream)
            self.writer.add_metadata(metadata.name, metadata.metadata)
        elif opcode == Opcode.ATTACHMENT:
            file = Attachment.read(stream)
            self.writer.add_attachment(file.create_time, file.log_time, file.name, file.media_type, file.data)

    def _add_schema(self, schema: Schema) -> None:
        known = self._schemas.get(schema.id)
        if known is None or known[0] != schema:
            number = self.writer.register_schema(schema.name, schema.encoding, schema.data)
            self._schemas[schema.id] = schema, number

    def _add_channel(self, channel: Channel) -> None:
        known = self._channels.get(channel.id)
        if known is None or known[0] != channel:
            schema = self._schemas[channel.schema_id][1] if channel.schema_id else 0
            number = self.writer.register_channel(channel.topic, channel.message_encoding, schema, channel.metadata)
            self._channels[channel.id] = channel, number
