"""Reads message logs in MCAP, ours and others', finished or not, and reports what is missing."""

import contextlib
import os
import struct
import zlib
from collections.abc import Collection, Container, Iterator, Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from itertools import islice
from pathlib import Path
from typing import BinaryIO, TypeAlias

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Metadata, Statistics
from mcap.records import Schema as McapSchema
from mcap.writer import MCAP0_MAGIC

from adapters.batch import BATCH_MESSAGES, Batch, Columns, gathered, messages, pack
from adapters.encoding.foreign_record import described, foreign_name
from adapters.encoding.message_definition import canonical_type
from adapters.encoding.message_record import Decode, decoder, recorded_name
from adapters.encoding.record import Record, Schema
from adapters.encoding.typed_record import TypedRecords
from adapters.errors import TelemetryError
from adapters.logs.compressed import COMPRESSED
from adapters.logs.damage import Damage, counted
from adapters.logs.mcap_records import MESSAGE_HEAD, RECORD_HEAD, UNREADABLE, McapRecords, records_in
from adapters.message import LATEST_NS, Message
from adapters.source import ZENOH

# the footer and the magic after it; the checksum covers the summary, and the footer up to the checksum
_END = struct.Struct("<BQQQI8s")
_CHECKED_FOOTER_BYTES = 25
_DATA_END = RECORD_HEAD.pack(Opcode.DATA_END, 4)
_CHECKSUM_BYTES = 4
_MOST_SUMMARY_BYTES = 1 << 24
"""Bytes at the file's end in which a summary is searched for if it does not begin where the footer says. Chosen: enough
for hours of recording; without a summary only the topics that a damaged chunk defines are missed."""
_BATCH_BYTES = 1 << 24
"""Most payload in a batch, bytes: recordings of others hold images. Chosen: five times the payload of as many messages
of telemetry, so that it only bounds the memory."""
# samples, estimates and alarms of a monitor, which are not telemetry
_OUR_RESULTS = "/fauio/"
_ZENOH_TOPICS = f"/{ZENOH}/"


@dataclass(slots=True)
class _Topic:
    """A channel of the file; its decoder is made when its first message comes."""

    topic: str
    encoding: str
    schema: Schema | None
    wanted: bool
    decode: Decode | None = None


# topic, log time, publish time, payload
_Raw: TypeAlias = tuple[_Topic, int, int, bytes]


class MessageLogReader:
    """Reads a log's telemetry in the order it was written, also from unfinished and damaged files.

    Topics are those of :class:`MessageLogWriter`, and those of others (:mod:`adapters.encoding.foreign_record`).
    Iterate over it once. The file may be compressed, with the suffix ``.xz`` or ``.gz``.

    ``only`` names the messages wanted, and only these are decoded; None wants all. ``types`` are ROS 2 types
    (``sensor_msgs/Imu``) whose topics are wanted whatever their name; with any of them recorded JSON telemetry over
    Zenoh is wanted too, since its type is unknown. ``topic`` wants only that topic, including our own results. ``scan``
    has the file's records, and their damage so far.

    ``messages`` counts the returned messages, ``other_records`` records that are not telemetry (our own estimates and
    alarms), not wanted, or of topics that cannot be read, ``damaged_records`` single records that cannot be decoded.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        only: Container[str] | None = None,
        types: Collection[str] = (),
        topic: str | None = None,
    ) -> None:
        self._path = Path(path)
        self._only = only
        self._types = types
        self._topic = topic
        self.scan = McapRecords(self._path)
        self._schemas: dict[int, Schema] = {}
        self._topics: dict[int, _Topic] = {}
        self._unread: dict[str, str] = {}
        self.messages = self.other_records = self.damaged_records = 0
        self._expected: int | None = None

    def damage(self) -> Damage | None:
        """Return what could not be read, or None if all could; call it after the last message."""
        scan = self.scan
        findings = list(described(self._unread))
        if scan.broken_off:
            findings.append(f"cannot be read from byte {scan.stopped_at} on")
        elif scan.stopped_at is not None:
            findings.append(f"was not finished, ends without an index at byte {scan.stopped_at}")
        if scan.damaged_chunks:
            findings.append(counted(scan.damaged_chunks, "damaged block"))
        elif scan.lost_ways > scan.broken_off:
            findings.append(counted(scan.lost_ways - scan.broken_off, "damaged place"))
        if self.damaged_records:
            findings.append(f"{counted(self.damaged_records, 'message')} cannot be decoded")
        seen = self.messages + self.other_records + self.damaged_records
        if self._expected is not None and (lost := self._expected - seen) > 0:
            findings.append(f"{lost} of {counted(self._expected, 'message')} lost")
        return Damage(self._path.name, tuple(findings), scan.stopped_at) if findings else None

    def __iter__(self) -> Iterator[Message]:
        """Return the messages.

        Raises
        ------
        TelemetryError
            The file cannot be opened, is not an MCAP file or needs a compression that is not installed.
        """
        return (message for batch in self.batches() for message in messages(batch))

    def _decoded(self, topic: _Topic, time_ns: int, data: bytes) -> Message | None:
        """Return a message and count it, or None if it cannot be decoded."""
        decode = topic.decode or self._decoder(topic)
        if decode is None:
            self.other_records += 1
            return None
        try:
            message = decode(data, time_ns)
        except UNREADABLE:
            self.damaged_records += 1
            return None
        self.messages += 1
        return message

    def batches(self, count: int = BATCH_MESSAGES) -> Iterator[Batch]:
        """Return the messages in batches of ``count``, fewer if they are large or some cannot be read.

        It raises the errors of iteration.
        """
        data = self._data()
        while records := list(_first(data, count)):
            by_topic: dict[int, tuple[_Topic, list[int]]] = {}
            for index, (topic, *_) in enumerate(records):
                by_topic.setdefault(id(topic), (topic, []))[1].append(index)
            columns: list[Columns] = []
            indices: list[int] = []
            for topic, group in by_topic.values():
                together = self._columns(topic, [records[index] for index in group], group)
                columns += together or ()
                indices += () if together else group
            single = {}
            for index in sorted(indices):
                topic, time_ns, _, record = records[index]
                message = self._decoded(topic, time_ns, record)
                if message is not None:
                    single[index] = message
            if columns or single:
                yield _batch(columns, single)

    def _columns(self, topic: _Topic, group: Sequence[_Raw], indices: Sequence[int]) -> list[Columns] | None:
        """Return the messages of a topic and count them, or None if they have to be decoded one by one."""
        decode = topic.decode or self._decoder(topic)
        if not isinstance(decode, TypedRecords):
            return None
        times_ns = np.array([time_ns for _, time_ns, _, _ in group], np.int64)
        columns = decode.columns([data for *_, data in group], times_ns, np.array(indices))
        self.messages += len(group) if columns else 0
        return columns

    def records(self) -> Iterator[Record]:
        """Return the wanted records as they are in the file, readable or not; it raises the errors of iteration."""
        for topic, time_ns, publish_ns, data in self._data():
            self.messages += 1
            yield Record(topic.topic, topic.encoding, topic.schema, data, time_ns, publish_ns=publish_ns)

    def _data(self) -> Iterator[_Raw]:
        """Return topic, log time, publish time and payload of the wanted messages."""
        self._learn_from_index()
        for opcode, body in self.scan.flat():
            if opcode != Opcode.MESSAGE:
                self._define(opcode, body)
            elif (message := self._message(body)) is not None:
                yield message

    def _message(self, body: bytes) -> _Raw | None:
        """Return a message if it is wanted; otherwise count it."""
        if len(body) >= MESSAGE_HEAD.size:
            channel, _, time_ns, publish_ns = MESSAGE_HEAD.unpack_from(body)
            topic = self._topics.get(channel)
            if topic is not None and time_ns < LATEST_NS:
                if topic.wanted:
                    return topic, time_ns, publish_ns, body[MESSAGE_HEAD.size :]
                self.other_records += 1
                return None
        self.damaged_records += 1
        return None

    def _define(self, opcode: int, body: bytes) -> None:
        """Process a record that defines a schema or a channel; ignore others."""
        try:
            if opcode == Opcode.SCHEMA:
                schema = McapSchema.read(ReadDataStream(BytesIO(body)))
                self._schemas[schema.id] = Schema(schema.name, schema.encoding, schema.data)
            elif opcode == Opcode.CHANNEL:
                self._add(Channel.read(ReadDataStream(BytesIO(body))))
        except (*UNREADABLE, McapError):
            self.damaged_records += 1

    def _add(self, channel: Channel) -> None:
        topic, encoding = channel.topic, channel.message_encoding
        schema = self._schemas.get(channel.schema_id)
        known = self._topics.get(channel.id)
        if known is not None and (known.topic, known.encoding, known.schema) == (topic, encoding, schema):
            return
        if self._topic is not None:
            wanted = topic == self._topic
        else:
            name = recorded_name(topic, encoding, schema) or foreign_name(topic)
            chosen = self._only is None or name in self._only or self._is_of_type(topic, encoding, schema)
            wanted = not topic.startswith(_OUR_RESULTS) and chosen
        self._topics[channel.id] = _Topic(topic, encoding, schema, wanted)

    def _is_of_type(self, topic: str, encoding: str, schema: Schema | None) -> bool:
        if not self._types:
            return False
        if encoding == "json":
            return topic.startswith(_ZENOH_TOPICS)
        with contextlib.suppress(TelemetryError):
            return schema is not None and canonical_type(schema.name) in self._types
        return False

    def _decoder(self, topic: _Topic) -> Decode | None:
        """Make the decoder of a topic; a topic without one is not wanted any more."""
        try:
            topic.decode = decoder(topic.topic, topic.encoding, topic.schema)
        except UNREADABLE as error:
            self._unread[topic.topic] = str(error)
            topic.wanted = False
        return topic.decode

    def _learn_from_index(self) -> None:
        """Read schemas, channels and the number of messages from a finished file's end; their chunk may be damaged."""
        if self._path.suffix.lower() in COMPRESSED:
            return
        # a damaged length may exceed the memory
        with contextlib.suppress(*UNREADABLE, McapError, MemoryError, OSError), self._path.open("rb") as stream:
            for opcode, body in records_in(_summary(stream)):
                if opcode == Opcode.STATISTICS:
                    self._expected = Statistics.read(ReadDataStream(BytesIO(body))).message_count
                self._define(opcode, body)


def _first(data: Iterator[_Raw], count: int) -> Iterator[_Raw]:
    """Yield the next ``count`` records, fewer where they are large."""
    size = 0
    for message in islice(data, count):
        yield message
        size += len(message[-1])
        if size >= _BATCH_BYTES:
            return


def _batch(columns: list[Columns], single: Mapping[int, Message]) -> Batch:
    """Return columns that were decoded together and single messages as a batch; messages become columns if they can."""
    packed, index = pack([*single.values()]), np.array([*single], np.int64)
    columns += (group._replace(position=index[group.position]) for group in packed.columns)
    return gathered(columns, {int(index[at]): message for at, message in packed.others.items()})


def read_mcap_metadata(path: str | os.PathLike[str], *, ahead_only: bool = False) -> dict[str, dict[str, str]]:
    """Return a log's metadata records by name; later entries of the same name and key replace earlier ones.

    With ``ahead_only``, return those before all data, for which the file need not be read to its end.
    """
    entries: dict[str, dict[str, str]] = {}
    for opcode, body in McapRecords(Path(path)):
        if ahead_only and opcode in (Opcode.CHUNK, Opcode.MESSAGE):
            break
        if opcode == Opcode.METADATA:
            with contextlib.suppress(*UNREADABLE, McapError):
                record = Metadata.read(ReadDataStream(BytesIO(body)))
                entries.setdefault(record.name, {}).update(record.metadata)
    return entries


def _summary(stream: BinaryIO) -> bytes:
    """Return the summary at a finished file's end, checked; empty if there is none.

    It starts where the footer says, or, if bytes were lost or added before it, after the end of the data.
    """
    end = stream.seek(-_END.size, os.SEEK_END)
    opcode, _, start, _, crc, magic = _END.unpack(stream.read())
    if opcode != Opcode.FOOTER or magic != MCAP0_MAGIC or not start:
        return b""
    stream.seek(start)
    summary = stream.read(max(0, end + _CHECKED_FOOTER_BYTES - start))
    if crc and zlib.crc32(summary) != crc:
        stream.seek(max(0, end - _MOST_SUMMARY_BYTES))
        data, _, summary = stream.read(end + _CHECKED_FOOTER_BYTES - stream.tell()).rpartition(_DATA_END)
        summary = summary[_CHECKSUM_BYTES:]
        if not data or zlib.crc32(summary) != crc:
            return b""
    return summary[:-_CHECKED_FOOTER_BYTES]
