"""Telemetry logs in batches: the same messages as packet by packet, in whole and in damaged logs."""

from __future__ import annotations

import gzip
import lzma
import random
import struct
from itertools import chain
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from packet_stream import PacketStream

from adapters.batch import messages
from adapters.errors import TelemetryError
from adapters.logs import compressed
from adapters.logs.damage import ScanStatistics
from adapters.logs.tlog import TlogReader
from adapters.mavlink.mavlink_message import mavlink_types
from adapters.message import Message

DATA = Path(__file__).parent / "data"
FLIGHT = DATA / "copter_5s.tlog.xz"
RAW = lzma.decompress(FLIGHT.read_bytes())
UNKNOWN = 59_999
NUMBERS = [*sorted(mavlink_types()), UNKNOWN]
START_US = 1_795_251_917_000_000

Outcome = tuple[list[str], ScanStatistics]


def outcome(found: list[Message], statistics: ScanStatistics) -> Outcome:
    # Not a number equals nothing; the text also tells int from float.
    return [repr(message) for message in found], statistics


def one_by_one(path: Path, only: frozenset[str] | None = None) -> Outcome | str:
    reader = TlogReader(path, only)
    try:
        found = [PacketStream().messages(packet, time_ns) for time_ns, packet in reader.packets()]
        return outcome([*chain.from_iterable(found)], reader.statistics())
    except TelemetryError as error:
        return str(error)


def in_batches(path: Path, only: frozenset[str] | None = None, read_ahead_bytes: int = 1 << 20) -> Outcome | str:
    batches = TlogReader(path, only, read_ahead_bytes)
    try:
        return outcome([message for batch in batches for message in messages(batch)], batches.statistics())
    except TelemetryError as error:
        return str(error)


def record(draw: random.Random, number: int, length: int, version: int, signed: bool = False) -> bytes:
    """Return a record with a right checksum and any content."""
    kind = mavlink_types().get(number)
    sender = bytes([draw.choice((1, 1, 1, 2, 255)), draw.choice((1, 1, 190))])
    sequence = bytes([draw.randrange(256)])
    if version == 1:
        head = b"\xfe" + bytes([length]) + sequence + sender + bytes([number])
    else:
        head = b"\xfd" + bytes([length, signed, 0]) + sequence + sender + number.to_bytes(3, "little")
    packet = head + draw.randbytes(length)
    packet += struct.pack("<H", kind.checksum(packet) if kind else draw.randrange(1 << 16))
    stamp = START_US + draw.randrange(10**9) if draw.random() < 0.99 else (1 << 64) - draw.randrange(1, 10**9)
    return stamp.to_bytes(8) + packet + (draw.randbytes(13) if signed and version == 2 else b"")


def any_record(draw: random.Random) -> bytes:
    number = draw.choice(NUMBERS)
    size = mavlink_types()[number].size if number in mavlink_types() else 255
    version = draw.choice((1, 2, 2)) if number < 256 else 2
    # Shorter than the definition where zeros are cut off, longer where it has grown since.
    length = draw.choice((size, size, draw.randrange(size + 1), draw.randrange(256)))
    return record(draw, number, length, version, signed=draw.random() < 0.2)


def damaged(draw: random.Random, raw: bytes) -> bytes:
    """Return a log with flipped bits, bytes cut out or put in, and forged lengths."""
    log = bytearray(raw)
    for _ in range(draw.choice((0, 1, 2, 10))):
        at = draw.randrange(len(log) + 1)
        match draw.randrange(4):
            case 0:
                log[at : at + 1] = bytes([draw.randrange(256)])
            case 1:
                del log[at : at + draw.choice((1, 7, 300))]
            case 2:
                log[at:at] = draw.randbytes(draw.choice((1, 20, 300)))
            case 3:
                log[at:at] = draw.choice((b"\xfd\xff\0", b"\xfe\xff", b"\xfd\0\2", b"\xfd\xff\0" * 40, b"\xfe" * 600))
    return bytes(log)


@given(
    st.randoms(use_true_random=True),
    st.sampled_from((1, 100, 1_000, 5_000, 1 << 16)),
    st.sampled_from((1, 999, 4_096, 1 << 20)),
    st.booleans(),
)
def test_blocks_say_what_the_reader_says_whatever_the_log_holds(
    tmp_path_factory: pytest.TempPathFactory,
    draw: random.Random,
    piece_bytes: int,
    read_ahead_bytes: int,
    some: bool,
) -> None:
    path = tmp_path_factory.mktemp("log") / "a.tlog"
    records = [any_record(draw) for _ in range(draw.choice((0, 1, 5, 60, 600 if piece_bytes > 1 else 60)))]
    path.write_bytes(damaged(draw, b"".join(records)))
    only = frozenset(kind.name for kind in mavlink_types().values() if draw.random() < 0.5) if some else None
    expected = one_by_one(path, only)
    with mock.patch.object(compressed, "_PIECE_BYTES", piece_bytes):
        assert in_batches(path, only, read_ahead_bytes) == expected
        assert one_by_one(path, only) == expected


@given(st.randoms(use_true_random=True))
@settings(max_examples=settings().max_examples // 4)
def test_a_damaged_flight_gives_the_same_in_batches(
    tmp_path_factory: pytest.TempPathFactory, draw: random.Random
) -> None:
    path = tmp_path_factory.mktemp("log") / "a.tlog"
    path.write_bytes(damaged(draw, RAW[: draw.choice((20_000, len(RAW)))]))
    assert in_batches(path, None, draw.choice((7_000, 1 << 20))) == one_by_one(path)


@pytest.mark.parametrize("version", [1, 2])
def test_every_message_of_the_dialect_at_every_length_reads_the_same(tmp_path: Path, version: int) -> None:
    draw = random.Random(version)
    path = tmp_path / "a.tlog"
    known = {number: kind for number, kind in mavlink_types().items() if version == 2 or number < 256}
    records = []
    for number, kind in known.items():
        longest = 256 if version == 2 else kind.size + 1
        records += [
            record(draw, number, length, version)
            for length in (0, *range(number % 23 + 1, longest, 23), kind.size, 255)
        ]
    path.write_bytes(b"".join(records))
    assert in_batches(path) == one_by_one(path)
    names = {message.name for block in TlogReader(path) for message in messages(block)}
    assert names == {kind.name for kind in known.values()}


@pytest.mark.parametrize("name", ["copter_5s", "rover_steering_050_end"])
def test_flights_read_the_same_in_batches(name: str) -> None:
    path = DATA / f"{name}.tlog.xz"
    wanted = frozenset({"ATTITUDE", "HEARTBEAT", "STATUSTEXT"})
    assert in_batches(path) == one_by_one(path)
    assert in_batches(path, wanted) == one_by_one(path, wanted)
    assert in_batches(path, frozenset()) == one_by_one(path, frozenset())


def test_compressed_logs_read_like_plain_ones(tmp_path: Path) -> None:
    expected = in_batches(FLIGHT)
    for suffix, raw in ((".tlog", RAW), (".tlog.gz", gzip.compress(RAW))):
        path = tmp_path / f"a{suffix}"
        path.write_bytes(raw)
        assert in_batches(path) == expected
    path = tmp_path / "broken.tlog.xz"
    path.write_bytes(FLIGHT.read_bytes()[:-1000])
    assert in_batches(path) == one_by_one(path)


def test_columns_have_the_types_of_the_wire_and_one_sender_each(tmp_path: Path) -> None:
    draw = random.Random(0)
    path = tmp_path / "a.tlog"
    path.write_bytes(b"".join(any_record(draw) for _ in range(3_000)))
    (block,) = TlogReader(path)
    senders = [(one.name, one.system, one.component) for one in block.columns]
    assert len(senders) == len(set(senders))
    assert all((np.diff(one.position) > 0).all() for one in block.columns)
    (attitude,) = [one for one in next(iter(TlogReader(FLIGHT))).columns if one.name == "ATTITUDE"]
    assert list(attitude.fields) == ["time_boot_ms", "roll", "pitch", "yaw", "rollspeed", "pitchspeed", "yawspeed"]
    assert [values.dtype for values in attitude.fields.values()] == [np.uint32, *[np.float32] * 6]


def test_a_block_is_as_long_as_what_is_read_ahead() -> None:
    counts = [block.count for block in TlogReader(FLIGHT, read_ahead_bytes=1 << 16)]
    assert sum(counts) == 2683
    assert len(counts) > 1


def test_only_text_stays_messages(tmp_path: Path) -> None:
    texts = {kind.name for kind in mavlink_types().values() if "char" in kind.table.fieldtypes}
    draw = random.Random(1)
    path = tmp_path / "a.tlog"
    path.write_bytes(b"".join(any_record(draw) for _ in range(3_000)))
    (block,) = TlogReader(path)
    assert {message.name for message in block.others.values()} <= texts
    assert "STATUSTEXT" in texts
    assert not texts & {one.name for one in block.columns}


def test_a_missing_file_is_reported_by_name(tmp_path: Path) -> None:
    with pytest.raises(TelemetryError, match=r"none\.tlog: cannot be opened"):
        list(TlogReader(tmp_path / "none.tlog"))
