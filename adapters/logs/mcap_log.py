"""Writes message logs in MCAP, so that a crash loses nothing flushed; :mod:`adapters.logs.mcap_reader` reads them."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Self, cast

from adapters.encoding.message_record import encode
from adapters.encoding.record import Record, Schema
from adapters.errors import StorageError
from adapters.logs.mcap_writer import McapWriter
from adapters.message import Message

MAX_CHANNELS = 4096
"""Topics come from the network: the memory for them, and for their schemas, has to end."""


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
        Records handed to the operating system; the others wait in the current chunk, or were lost.
    dropped : int
        Records lost to writes that failed.
    """

    records: int
    unrecordable: int
    written: int
    dropped: int = 0


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
    StorageError
        The file cannot be created.
    OSError
        A write failed, in any method. The file is whole up to the last chunk; only :meth:`close` and :meth:`resume`
        are of use then.
    """

    def __init__(self, target: str | os.PathLike[str] | BinaryIO) -> None:
        self._owned: BinaryIO | None = None
        if isinstance(target, str | os.PathLike):
            try:
                # unbuffered: a buffer would keep what could not be written, and try again on closing
                target = self._owned = cast(BinaryIO, Path(target).open("wb", buffering=0))  # noqa: SIM115 - close()
            except OSError as error:
                raise StorageError(
                    f"{target}: cannot be written: {error.strerror}; its folder has to exist and be writable"
                ) from error
        try:
            self._writer = McapWriter(target)
        except OSError:
            if self._owned is not None:
                self._owned.close()
            raise
        self._channels: dict[tuple[str, str, Schema | None], int] = {}
        self._records = 0
        self._unrecordable = 0
        self._closed = False

    @property
    def size(self) -> int:
        """Bytes the file will have at most if it is closed now."""
        return self._writer.size

    @property
    def position(self) -> int:
        """Records in the file and on their way to it: the number of the last one taken."""
        return self._writer.position

    @property
    def written(self) -> int:
        """Records handed to the operating system."""
        return self._writer.written

    @property
    def failed(self) -> bool:
        """Whether a write has failed and nothing was resumed since."""
        return self._writer.failed

    def write(self, message: Message) -> None:
        """Record a telemetry message; one that cannot be recorded is counted and left out."""
        try:
            record = encode(message)
        except ValueError:
            self._unrecordable += 1
            return
        self.write_record(record)

    def write_record(self, record: Record) -> None:
        """Record what is encoded already; a schema goes into the file with the topic's first record of that kind."""
        channel = self.channel(record.topic, record.encoding, record.schema)
        if channel is None or not 0 <= record.time_ns < 1 << 64:
            self._unrecordable += 1
            return
        self.add(channel, record.data, record.time_ns, record.publish_ns)

    def channel(self, topic: str, encoding: str, schema: Schema | None) -> int | None:
        """Return the id of a channel for :meth:`add`, None where it would be new and the file has too many already."""
        known = self._channels.get((topic, encoding, schema))
        if known is not None or len(self._channels) >= MAX_CHANNELS:
            return known
        schema_id = 0 if schema is None else self._writer.add_schema(schema.name, schema.encoding, schema.data)
        channel = self._writer.add_channel(topic, encoding, schema_id)
        self._channels[topic, encoding, schema] = channel
        return channel

    def add(self, channel: int, data: bytes, time_ns: int, publish_ns: int | None = None) -> None:
        """Record encoded data on a channel; times are Unix nanoseconds, neither negative nor beyond 64 bits."""
        self.add_all([channel], [data], [time_ns], publish_ns)

    def add_all(
        self, channels: Sequence[int], data: Sequence[bytes], times_ns: Sequence[int], publish_ns: int | None = None
    ) -> None:
        """Record encoded data, each on its channel, in their order; see :meth:`add`."""
        if self._closed:
            raise RuntimeError("the log is closed; open another one")
        self._records += len(data)
        self._writer.add_messages(channels, times_ns, data, publish_ns)

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

    def resume(self) -> None:
        """Go on after a write that failed, behind the last whole chunk of the file."""
        self._writer.resume()

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
        writer = self._writer
        there = writer.written if writer.failed else writer.position
        return WriterStatistics(self._records, self._unrecordable, writer.written, self._records - there)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
