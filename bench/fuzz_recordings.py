"""Fuzz targets of our own recordings: telemetry logs, MCAP, its records, compressed files."""

from __future__ import annotations

import contextlib
import gzip
import io
import itertools
import lzma
from collections.abc import Iterable
from pathlib import Path

from fuzz_adapters import DATA, START_NS, packet
from fuzz_input import Draw, random_inputs
from fuzz_target import Run, Target, only

from adapters.batch import messages
from adapters.encoding.foreign_record import foreign_decoder
from adapters.encoding.message_record import decoder, encode
from adapters.encoding.record import Record, Schema
from adapters.errors import TelemetryError
from adapters.logs.compressed import CompressedFile
from adapters.logs.mcap_log import MessageLogWriter
from adapters.logs.mcap_reader import MessageLogReader, read_mcap_metadata
from adapters.logs.recordings import read_recording
from adapters.logs.tlog import TlogReader
from adapters.mavlink.mavlink_columns import decoded, dialect, wanted_kinds
from adapters.mavlink.mavlink_message import mavlink_types
from adapters.mavlink.packets import PacketList, PacketScanner
from adapters.message import Message
from adapters.source import CLOCK, LINK, MAVLINK, OPERATOR, ZENOH


def _tlog(folder: Path) -> Run:
    def run(data: bytes) -> None:
        draw = Draw(data)
        packed = draw.number() % 8
        if packed < 4:
            content = draw.rest()
        else:
            content = b"".join(draw.take(8).rjust(8, b"\0") + packet(draw) for _ in range(draw.number() % 6))
            content = draw.edited(content)
        suffix = ("", ".xz", ".gz", "")[packed % 4]
        path = folder / f"log.tlog{suffix}"
        path.write_bytes(content)
        reader, batches = TlogReader(path), TlogReader(path)
        one_by_one, at_once = [], []
        with only(TelemetryError):
            for time_ns, recorded in reader.packets():
                PacketScanner(dialect()).scan(recorded, single := PacketList(dialect()), time_ns)
                (message,) = messages(decoded(single, wanted_kinds()))
                encode(message)
                one_by_one.append(repr(message))
        with only(TelemetryError):
            at_once = [repr(message) for batch in batches for message in messages(batch)]
        assert (at_once, batches.statistics()) == (one_by_one, reader.statistics())

    return run


def _tlog_seeds() -> list[bytes]:
    records = itertools.islice(TlogReader(DATA / "copter_5s.tlog.xz").packets(), 60)
    log = b"".join((time_ns // 1000).to_bytes(8) + one for time_ns, one in records)
    packed = [b"\1" + lzma.compress(log[:600]), b"\2" + gzip.compress(log[:600], mtime=0)]
    return [b"\0" + log, b"\0" + log[:200], *packed, *(b"\4" + one for one in random_inputs(40))]


def _compressed(folder: Path) -> Run:
    def run(data: bytes) -> None:
        path = folder / ("one.xz" if data[:1] < b"\x80" else "one.gz")
        path.write_bytes(data[1:])
        file = CompressedFile(path)
        for _ in file:
            pass

    return run


def _compressed_seeds() -> list[bytes]:
    content = (b"some text, " * 9, b"\0" * 3_000_000, bytes(range(256)), b"")
    alone = lzma.compress(b"x" * 40, format=lzma.FORMAT_ALONE)
    bombs = [alone[:1] + b"\xff\xff\xff\xff" + alone[5:], alone]
    return [
        *(b"\0" + lzma.compress(one) for one in content),
        *(b"\xff" + gzip.compress(one, mtime=0) for one in content),
        *(b"\0" + one for one in bombs),
    ]


def _some_messages() -> list[Message]:
    flight = list(itertools.islice(read_recording(DATA / "copter_5s.tlog.xz"), 30))
    more = [
        Message(ZENOH, "arm/telemetry", START_NS, {"time_ns": 5, "data": [1.5, {"deep": "ü"}]}),
        Message(CLOCK, "silence", START_NS + 1, {}),
        Message(LINK, "signing", START_NS + 2, {"forged": 3}, 1, 1),
        Message(OPERATOR, "ack", START_NS + 3, {"id": "01J", "by": "me"}),
        Message(MAVLINK, "UNHEARD_OF", START_NS + 4, {"a": 1}, 1, 1),
    ]
    return [*more, *flight]


def _log_bytes(messages: Iterable[Message], finished: bool) -> bytes:
    stream = io.BytesIO()
    log = MessageLogWriter(stream)
    log.add_metadata("fauio", {"vehicle": "copter"})
    for message in messages:
        log.write(message)
    log.flush()
    if finished:
        log.close()
    return stream.getvalue()


def _mcap_records(draw: Draw) -> bytes:
    """Return a log whose container is right and whose channels and records are anything."""
    stream = io.BytesIO()
    with MessageLogWriter(stream) as log:
        while draw.more:
            source = draw.choice(("mavlink", "zenoh", "link", "journal", "operator", "clock", "fauio", ""))
            name = draw.choice(("ATTITUDE", "signing", "a/b", "", "rules"))
            encoding = draw.choice(("json", "protobuf", "cdr", ""))
            schema = draw.choice((None, *_schemas()))
            if draw.number() % 3 == 0 and schema is not None:
                schema = Schema(schema.name, schema.encoding, draw.edited(schema.data))
            log.write_record(Record(f"/{source}/{name}", encoding, schema, draw.block(), draw.number(8)))
    return stream.getvalue()


def _schemas() -> list[Schema]:
    return [one for one in (encode(message).schema for message in _ATTITUDE) if one is not None]


_ATTITUDE = [
    mavlink_types()[30].decode(bytes(28), START_NS, 0, 0),
    Message(ZENOH, "x", START_NS, {}),
]


def _mcap(folder: Path) -> Run:
    bases = [_log_bytes(_some_messages(), finished) for finished in (True, False)]

    def run(data: bytes) -> None:
        draw = Draw(data)
        how = draw.number() % 6
        suffix = ".xz" if how == 5 else ""
        if how < 2:
            content = draw.edited(bases[how])
        elif how == 2:
            content = _mcap_records(draw)
        else:
            content = draw.rest()
        path = folder / f"log.mcap{suffix}"
        path.write_bytes(content)
        reader = MessageLogReader(path)
        with only(TelemetryError):
            for message in reader:
                _plain_message(message)
        reader.damage()
        with only(TelemetryError):
            read_mcap_metadata(path)

    return run


def _plain_message(message: Message) -> None:
    assert isinstance(message.fields, dict)
    assert type(message.system) is int
    assert type(message.component) is int
    with contextlib.suppress(ValueError):
        encode(message)


def _mcap_seeds() -> list[bytes]:
    small = [_log_bytes(_some_messages()[:count], finished) for count in (0, 1, 6) for finished in (True, False)]
    packed = b"\5" + lzma.compress(small[3])
    return [packed, *(b"\3" + one for one in small), *(bytes([k % 3]) + one for k, one in enumerate(random_inputs(60)))]


def _record(folder: Path) -> Run:
    schemas = [None, *_schemas()]

    def run(data: bytes) -> None:
        draw = Draw(data)
        topic = draw.choice(
            ("/mavlink/ATTITUDE", "/zenoh/a/b", "/link/signing", "/journal/standing", "/operator/rules")
        )
        encoding, schema = draw.choice(("json", "json", "protobuf", "cdr")), draw.choice(schemas)
        if schema is not None and draw.number() % 4 == 0:
            schema = Schema(schema.name, schema.encoding, draw.edited(schema.data))
        payload, time_ns = draw.rest(), draw.number(8)
        foreign = None if schema is None else Schema(schema.name, "ros2msg", schema.data)
        with only(ValueError):
            _plain_message(decoder(topic, encoding, schema)(payload, time_ns))
        with only(ValueError):
            _plain_message(foreign_decoder(topic, encoding, foreign)(payload, time_ns))

    return run


def _record_seeds() -> list[bytes]:
    plain = [encode(message) for message in _some_messages()]
    kinds = {"json": 0, "protobuf": 2}
    topics = ("mavlink", "zenoh", "link", "journal", "operator")
    found = [
        bytes([topics.index(record.topic.split("/")[1]), kinds[record.encoding], 1, 1]) + record.data
        for record in plain
        if record.topic.split("/")[1] in topics
    ]
    odd = [b'{"system_id":[1],"component_id":{},"fields":[1]}', b'{"system_id":1}', b"[" * 3000, b"[]", b"1" * 5000]
    return [*found, *(bytes([k, 0, 0, 0]) + one for k in range(5) for one in odd), *random_inputs(20)]


TARGETS = (
    Target("tlog", "telemetry logs, plain and compressed", _tlog, _tlog_seeds, 1 << 13),
    Target("mcap", "MCAP logs: damaged, unfinished, with any records", _mcap, _mcap_seeds, 1 << 13),
    Target("record", "records of logs to messages", _record, _record_seeds),
    Target("compressed", ".xz and .gz", _compressed, _compressed_seeds, 1 << 13),
)
