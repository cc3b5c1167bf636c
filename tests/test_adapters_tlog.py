"""Telemetry logs: the same messages as pymavlink reads, and all that damage leaves."""

from __future__ import annotations

import gzip
import lzma
import os
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from onboard_flights import messages_of

from adapters.errors import TelemetryError
from adapters.logs import compressed
from adapters.logs.damage import ScanStatistics
from adapters.logs.tlog import TlogReader
from adapters.message import Message

FLIGHT = Path(__file__).parent / "data" / "copter_5s.tlog.xz"
RAW = lzma.decompress(FLIGHT.read_bytes())


def records(raw: bytes) -> list[bytes]:
    """Return the records of an undamaged log."""
    found = []
    while raw:
        size = 8 + raw[9] + 12
        found.append(raw[:size])
        raw = raw[size:]
    return found


RECORDS = records(RAW)


def read(tmp_path: Path, raw: bytes) -> tuple[list[Message], ScanStatistics]:
    path = tmp_path / "a.tlog"
    path.write_bytes(raw)
    reader = TlogReader(path)
    return messages_of(reader), reader.statistics()


def key(message: Message) -> tuple[str, int, str]:
    return message.name, message.received_ns, repr(message.fields)


def test_messages_are_those_that_pymavlink_reads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MAVLINK20", "1")
    monkeypatch.setenv("MAVLINK_DIALECT", os.environ.get("MAVLINK_DIALECT", "ardupilotmega"))
    from pymavlink import mavutil

    path = tmp_path / "a.tlog"
    path.write_bytes(RAW)
    log = mavutil.mavlink_connection(str(path))
    ours = list(messages_of(TlogReader(path)))
    for message in ours:
        theirs = log.recv_msg()
        fields = theirs.to_dict()
        assert message.name == fields.pop("mavpackettype")
        assert (message.system, message.component) == (theirs.get_srcSystem(), theirs.get_srcComponent())
        assert message.received_ns / 1e9 == pytest.approx(theirs._timestamp, abs=1e-6)
        assert repr(dict(message.fields)) == repr(fields)
    assert log.recv_msg() is None
    log.close()
    assert len(ours) == 2683


@pytest.mark.parametrize(("suffix", "pack"), [("", bytes), (".xz", lzma.compress), (".gz", gzip.compress)])
def test_compressed_logs_read_like_plain_ones(tmp_path: Path, suffix: str, pack: Any) -> None:
    path = tmp_path / f"a.tlog{suffix}"
    path.write_bytes(pack(RAW))
    reader = TlogReader(path)
    assert [key(one) for one in messages_of(reader)] == [key(one) for one in messages_of(TlogReader(FLIGHT))]
    assert reader.statistics() == ScanStatistics(2683, 0, 0, 0, broken_off=False)


def test_only_the_wanted_messages_are_decoded() -> None:
    wanted = {"ATTITUDE", "HEARTBEAT"}
    reader = TlogReader(FLIGHT, wanted)
    assert [key(one) for one in messages_of(reader)] == [
        key(one) for one in messages_of(TlogReader(FLIGHT)) if one.name in wanted
    ]
    assert reader.statistics().records == 2683
    assert list(messages_of(TlogReader(FLIGHT, ()))) == []


def test_packets_come_byte_for_byte() -> None:
    assert [(t // 1000).to_bytes(8) + packet for t, packet in TlogReader(FLIGHT).packets()] == RECORDS


def test_times_are_nanoseconds_since_1970() -> None:
    first = next(iter(messages_of(TlogReader(FLIGHT))))
    assert first.received_ns == int.from_bytes(RAW[:8]) * 1_000


@given(st.integers(1, len(RAW) - 1))
def test_a_truncated_log_gives_every_message_before_its_end(tmp_path_factory: pytest.TempPathFactory, cut: int) -> None:
    messages, found = read_or_nothing(tmp_path_factory.mktemp("cut"), RAW[:cut])
    whole, size = 0, 0
    while size + len(RECORDS[whole]) <= cut:
        size += len(RECORDS[whole])
        whole += 1
    assert len(messages) == whole
    if found is not None:
        assert found.broken_off == (size != cut)
        assert (found.damaged, found.unknown, found.skipped_bytes) == (0, 0, cut - size)


def read_or_nothing(folder: Path, raw: bytes) -> tuple[list[Message], ScanStatistics | None]:
    try:
        return read(folder, raw)
    except TelemetryError:
        return [], None


@given(st.integers(0, len(RAW) - 1), st.integers(1, 2000), st.randoms(use_true_random=False))
def test_damage_costs_no_message_outside_of_it(
    tmp_path_factory: pytest.TempPathFactory, start: int, size: int, random: Any
) -> None:
    raw = bytearray(RAW)
    stop = min(start + size, len(raw))
    raw[start:stop] = random.randbytes(stop - start)
    messages, _ = read_or_nothing(tmp_path_factory.mktemp("damage"), bytes(raw))
    expected, at = [], 0
    for record in RECORDS:
        if at + len(record) <= start or at >= stop:
            expected.append(int.from_bytes(record[:8]) * 1_000)
        at += len(record)
    got = [message.received_ns for message in messages]
    assert set(expected) <= set(got)


@pytest.mark.parametrize("place", [3, 8, 9, 10, 15, 30])
def test_a_flipped_bit_anywhere_in_a_record_is_counted_once(tmp_path: Path, place: int) -> None:
    raw = bytearray(RAW)
    at = sum(map(len, RECORDS[:1000]))
    raw[at + place] ^= 0x10
    messages, found = read(tmp_path, bytes(raw))
    assert len(messages) >= 2682
    if place >= 8:
        # A damaged id may look like a message of another dialect.
        assert (len(messages), found.damaged + found.unknown, found.broken_off) == (2682, 1, False)


def test_a_message_of_another_dialect_is_counted_and_passed_over(tmp_path: Path) -> None:
    number = (59_999).to_bytes(3, "little")
    unknown = RECORDS[0][:8] + bytes([0xFD, 2, 0, 0, 0, 1, 1]) + number + b"\xfd\xfe\x00\x00"
    messages, found = read(tmp_path, b"".join(RECORDS[:10]) + unknown + b"".join(RECORDS[10:20]))
    assert len(messages) == 20
    assert found == ScanStatistics(21, 1, 0, 0, broken_off=False)


@pytest.mark.parametrize("piece_bytes", [5, 14, 1 << 16])
def test_what_is_found_does_not_depend_on_how_the_file_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, piece_bytes: int
) -> None:
    monkeypatch.setattr(compressed, "_PIECE_BYTES", piece_bytes)
    number = (59_999).to_bytes(3, "little")
    unknown = RECORDS[0][:8] + bytes([0xFD, 255, 1, 0, 0, 1, 1]) + number + bytes(270)
    _, found = read(tmp_path, RECORDS[0] + unknown * 20 + RECORDS[1])
    assert found == ScanStatistics(22, 20, 0, 0, broken_off=False)


@pytest.mark.parametrize("content", [b"\x00", b"not a log at all, just text" * 100, bytes(5000), b"\xfd" * 5000])
def test_a_file_without_any_packet_is_reported_by_name(tmp_path: Path, content: bytes) -> None:
    with pytest.raises(TelemetryError, match=r"a.tlog: holds no MAVLink 1 or 2 packet; is it a telemetry log\?"):
        read(tmp_path, content)


def test_an_empty_file_is_called_empty(tmp_path: Path) -> None:
    with pytest.raises(TelemetryError, match=r"a.tlog: is empty; was the recording started"):
        read(tmp_path, b"")


def test_a_broken_xz_file_gives_what_could_be_decompressed(tmp_path: Path) -> None:
    packed = bytearray(FLIGHT.read_bytes())
    path = tmp_path / "a.tlog.xz"
    path.write_bytes(packed[: len(packed) // 2])
    reader = TlogReader(path)
    messages = messages_of(reader)
    assert 1000 < len(messages) < 2683
    assert reader.statistics().broken_off
    packed[len(packed) // 2 :] = bytes(len(packed) - len(packed) // 2)
    path.write_bytes(packed)
    assert len(list(messages_of(TlogReader(path)))) >= 1000


def test_a_missing_file_is_reported_by_name(tmp_path: Path) -> None:
    with pytest.raises(TelemetryError, match=r"none\.tlog: cannot be opened"):
        list(messages_of(TlogReader(tmp_path / "none.tlog")))
