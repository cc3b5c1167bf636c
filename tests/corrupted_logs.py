"""A corpus of damaged recordings: kinds of logs, and kinds of damage that are done to them.

A kind is an entry of :data:`KINDS`: its suffix and what writes one; :func:`blocks` has to know how its files are made.
"""

from __future__ import annotations

import functools
import gzip
import lzma
import random
import zlib
from collections.abc import Callable, Iterator
from io import BytesIO
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from foreign_logs import ARM_DEFINITION, ARM_TOPIC, ARM_TYPE, arm_rows, json_log, mcap_log, protobuf_log, ros2_bag
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Chunk, Message
from mcap.stream_reader import breakup_chunk
from onboard_flights import dataflash_of, ulog_of

from adapters.logs.mcap_log import MessageLogWriter
from adapters.logs.recordings import read_recording
from adapters.message import Message as Telemetry
from adapters.simulation.arm import SCENARIOS, ArmRun, simulate_arm
from adapters.simulation.arm_source import arm_messages, arm_packets

START_NS = 1_795_251_917_000_000_000
CHUNK_BYTES = 4000
FLIGHT = Path(__file__).parent / "data" / "copter_5s.tlog.xz"


@functools.cache
def _run() -> ArmRun:
    return simulate_arm(SCENARIOS["healthy"], 6.0, 100.0, "zero")


@functools.cache
def _flight() -> list[Telemetry]:
    # without a position fix: the times of all messages hang on the first one
    return [one for one in islice(read_recording(FLIGHT), 1300) if one.name != "GPS_RAW_INT"]


def _tlog(path: Path) -> None:
    path.write_bytes(b"".join(((START_NS + t) // 1000).to_bytes(8) + packet for t, packet in arm_packets(_run())))


def _ours(path: Path) -> None:
    with MessageLogWriter(path) as log:
        for number, message in enumerate(arm_messages(_run(), START_NS)):
            log.write(message)
            if number % 50 == 0:
                log.flush()


def _onboard(write: Callable[[list[Telemetry], Path], Path]) -> Callable[[Path], None]:
    return lambda path: ignore(write(_flight(), path))


def _ros2(compression: str) -> Callable[[Path], None]:
    return lambda path: ignore(
        ros2_bag(path, {ARM_TOPIC: (ARM_TYPE, ARM_DEFINITION, arm_rows(_run()))}, compression, CHUNK_BYTES)
    )


def _unchunked(path: Path) -> None:
    rows = ((time_ns, str(fields).replace("'", '"').encode()) for time_ns, fields in arm_rows(_run()))
    mcap_log(path, ARM_TOPIC, ("Arm", "jsonschema", b"{}"), "json", rows, "none", use_chunking=False)


def ignore(_: object) -> None:
    """Return nothing."""


KINDS: dict[str, tuple[str, Callable[[Path], None]]] = {
    "tlog": (".tlog", _tlog),
    "mcap": (".mcap", _ours),
    "ros2": (".mcap", _ros2("zstd")),
    "ros2-lz4": (".mcap", _ros2("lz4")),
    "ros2-plain": (".mcap", _ros2("none")),
    "json": (".mcap", lambda path: ignore(json_log(path, ARM_TOPIC, arm_rows(_run()), chunk_bytes=CHUNK_BYTES))),
    "protobuf": (".mcap", lambda path: ignore(protobuf_log(path, arm_rows(_run()), "lz4", CHUNK_BYTES))),
    "unchunked": (".mcap", _unchunked),
    "ulog": (".ulg", _onboard(ulog_of)),
    "dataflash": (".bin", _onboard(dataflash_of)),
}
"""Kinds of logs by name: what their files end in, and what writes one."""

PACKED: dict[str, Callable[[bytes], bytes]] = {"": bytes, ".xz": lzma.compress, ".gz": gzip.compress}
"""Compressions of whole files by suffix."""


class Damaged(NamedTuple):
    """A damaged file: its bytes, how many at its beginning and how many at its end are as they were."""

    data: bytes
    before: int
    behind: int


def truncated(data: bytes, draw: random.Random) -> Damaged:
    at = draw.randrange(len(data))
    return Damaged(data[:at], at, 0)


def flipped_bits(data: bytes, draw: random.Random) -> Damaged:
    damaged = bytearray(data)
    places = [draw.randrange(len(data)) for _ in range(draw.choice((1, 1, 3, 20)))]
    for place in places:
        damaged[place] ^= 1 << draw.randrange(8)
    return Damaged(bytes(damaged), min(places), len(data) - 1 - max(places))


def wrong_magic(data: bytes, draw: random.Random) -> Damaged:
    count = draw.randint(1, 8)
    return Damaged(draw.randbytes(count) + data[count:], 0, len(data) - count)


def no_bytes(data: bytes, draw: random.Random) -> Damaged:
    return Damaged(b"", 0, 0)


def only_zeros(data: bytes, draw: random.Random) -> Damaged:
    return Damaged(bytes(draw.randint(1, len(data))), 0, 0)


def zero_tail(data: bytes, draw: random.Random) -> Damaged:
    at = draw.randrange(len(data))
    return Damaged(data[:at] + bytes(len(data) - at + draw.choice((0, 100_000))), at, 0)


def zero_hole(data: bytes, draw: random.Random) -> Damaged:
    at, count = draw.randrange(len(data)), draw.choice((1, 50, 5000))
    behind = data[at + count :]
    return Damaged(data[:at] + bytes(len(data) - at - len(behind)) + behind, at, len(behind))


def garbage(data: bytes, draw: random.Random) -> Damaged:
    """Put garbage in, or in the place of something."""
    at, count = draw.randrange(len(data)), draw.choice((1, 50, 5000))
    behind = data[at + draw.choice((0, count)) :]
    return Damaged(data[:at] + draw.randbytes(count) + behind, at, len(behind))


def lost_bytes(data: bytes, draw: random.Random) -> Damaged:
    at = draw.randrange(len(data))
    behind = data[at + draw.choice((1, 50, 5000)) :]
    return Damaged(data[:at] + behind, at, len(behind))


DAMAGES = (truncated, flipped_bits, wrong_magic, no_bytes, only_zeros, zero_tail, zero_hole, garbage, lost_bytes)


def damaged_files(data: bytes, count: int, seed: int) -> Iterator[tuple[str, Damaged]]:
    """Yield as many damaged copies of a file, each with the name of its damage."""
    draw = random.Random(seed)
    for number in range(count):
        damage = DAMAGES[number % len(DAMAGES)]
        yield damage.__name__, damage(data, draw)


class Batch(NamedTuple):
    """A stretch of an undamaged file that is read as a whole or not at all, and how many messages it holds.

    ``defines``: what stands behind may be readable only with it.
    """

    start: int
    stop: int
    messages: int
    defines: bool = False


def blocks(suffix: str, data: bytes) -> list[Batch]:
    """Return the blocks of a file, by the format's own lengths: packets, chunks, or messages outside of chunks."""
    found = {".tlog": _packets, ".mcap": _records, ".ulg": _ulog_records, ".bin": _dataflash_records}[suffix]
    return [*found(data)]


def _packets(data: bytes) -> Iterator[Batch]:
    at = 0
    while at < len(data):
        magic, length = data[at + 8 : at + 10]
        stop = at + 8 + length + (8 if magic == 0xFE else 12 + 13 * (data[at + 10] & 1))
        yield Batch(at, stop, 1)
        at = stop


def _records(data: bytes) -> Iterator[Batch]:
    at = 8
    while data[at] != Opcode.FOOTER:
        stop = at + 9 + int.from_bytes(data[at + 1 : at + 9], "little")
        if data[at] == Opcode.MESSAGE:
            yield Batch(at, stop, 1)
        elif data[at] == Opcode.CHUNK:
            records = breakup_chunk(Chunk.read(ReadDataStream(BytesIO(data[at + 9 : stop]))))
            yield Batch(at, stop, sum(isinstance(record, Message) for record in records))
        at = stop


def _ulog_records(data: bytes) -> Iterator[Batch]:
    yield Batch(0, 16, 0, defines=True)
    at = 16
    while at < len(data):
        stop = at + 3 + int.from_bytes(data[at : at + 2], "little")
        kind = data[at + 2 : at + 3]
        yield Batch(at, stop, kind not in b"ABFRS", kind in b"ABF")
        at = stop


def _dataflash_records(data: bytes) -> Iterator[Batch]:
    at, lengths = 0, {128: 89}
    while at < len(data):
        stop = at + lengths[data[at + 2]]
        if data[at + 2] == 128:
            lengths[data[at + 3]] = data[at + 4]
        yield Batch(at, stop, 1, data[at + 2] == 128)
        at = stop


def unpacked(packed: str, data: bytes) -> bytes:
    """Return what the beginning of a compressed file holds."""
    if not packed:
        return data
    stream = lzma.LZMADecompressor() if packed == ".xz" else zlib.decompressobj(31)
    # a decompressor that is given damaged bytes puts out nothing of what stood before them in the same piece
    return stream.decompress(data[: len(data) // 128 * 128])
