"""MCAP files of any writer: only what is wanted is decoded, and what is missing is said."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from foreign_logs import START_NS, json_log, mcap_log
from mcap.writer import CompressionType, Writer

from adapters.logs.mcap_log import MessageLogWriter
from adapters.logs.mcap_reader import MessageLogReader
from adapters.logs.recordings import Recording
from adapters.message import LATEST_NS, Message
from adapters.source import LINK, MAVLINK, ZENOH


def two_topics(path: Path) -> Path:
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.LZ4)
        writer.start()
        good = writer.register_channel("/good", "json", 0)
        bad = writer.register_channel("/bad", "json", 0)
        other = writer.register_channel("/picture", "cbor", 0)
        for number in range(10):
            writer.add_message(good, START_NS + number, json.dumps({"n": number}).encode(), 0)
            writer.add_message(bad, START_NS + number, b"{", 0)
            writer.add_message(other, START_NS + number, b"\xa0", 0)
        writer.finish()
    return path


def test_only_what_is_wanted_is_decoded(tmp_path: Path) -> None:
    reader = MessageLogReader(two_topics(tmp_path / "log.mcap"), {"good"})
    assert [message.fields["n"] for message in reader] == [*range(10)]
    assert reader.damaged_records == 0
    assert reader.other_records == 20
    assert reader.damage() is None


def test_what_cannot_be_read_is_said_in_a_line(tmp_path: Path) -> None:
    recording = Recording(two_topics(tmp_path / "log.mcap"))
    assert len(list(recording)) == 10
    [damage] = recording.damage()
    assert damage.line() == (
        "log.mcap: cannot read /picture: encoding 'cbor' is not known; cdr, json and protobuf are; "
        "10 messages cannot be decoded"
    )


def test_our_topics_are_wanted_by_the_name_of_their_messages(tmp_path: Path) -> None:
    with MessageLogWriter(tmp_path / "log.mcap") as log:
        for source in (ZENOH, MAVLINK, LINK):
            for name in ("a", "b"):
                log.write(Message(source, name, START_NS, {"n": 1}))
    found = list(MessageLogReader(tmp_path / "log.mcap", {"a"}))
    assert [(message.source, message.name) for message in found] == [(ZENOH, "a"), (MAVLINK, "a"), (LINK, "a")]


@pytest.mark.parametrize("cut", [0, 3])
def test_an_unfinished_file_is_said_to_be_one(tmp_path: Path, cut: int) -> None:
    path = tmp_path / "log.mcap"
    with MessageLogWriter(path) as log:
        for number in range(100):
            log.write(Message(ZENOH, "k", START_NS + number, {"n": number}))
        log.flush()
        data = path.read_bytes()
    path.write_bytes(data[: len(data) - cut])
    recording = Recording(path)
    assert len(list(recording)) == 100
    [damage] = recording.damage()
    said = "cannot be read from byte" if cut else "was not finished, ends without an index at byte"
    assert damage.line().startswith(f"log.mcap: {said} {damage.stopped_at}")


def rows(count: int) -> list[tuple[int, dict[str, Any]]]:
    return [(START_NS + number, {"n": number, "padding": "x" * (number * 7919 % 200)}) for number in range(count)]


def test_a_damaged_block_costs_what_the_index_counts(tmp_path: Path) -> None:
    path = json_log(tmp_path / "log.mcap", "/k", rows(1000), chunk_bytes=10_000)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    recording = Recording(path)
    found = [message.fields["n"] for message in recording]
    [damage] = recording.damage()
    assert 900 < len(found) < 1000
    assert damage.found == ("1 damaged block", f"{1000 - len(found)} of 1000 messages lost")


@pytest.mark.parametrize("compression", ["none", "zstd"])
def test_of_a_block_that_breaks_off_its_beginning_is_read(tmp_path: Path, compression: str) -> None:
    # one block, as a writer of 1 MiB blocks leaves a short recording
    path = json_log(tmp_path / "log.mcap", "/k", rows(5000), compression)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 3])
    found = [message.fields["n"] for message in MessageLogReader(path)]
    assert found == [*range(len(found))]
    assert len(found) > 1000
    path.write_bytes(data[: len(data) // 3] + bytes(2 * len(data) // 3))
    assert [message.fields["n"] for message in MessageLogReader(path)] == found


@pytest.mark.parametrize("hole", [b"", bytes(5000), b"\x06\x05" * 3000, b"\xff" * 40_000])
@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
def test_blocks_behind_damage_are_found_again(tmp_path: Path, compression: str, hole: bytes) -> None:
    path = json_log(tmp_path / "log.mcap", "/k", rows(4000), compression, chunk_bytes=8000)
    data = path.read_bytes()
    at = len(data) // 3
    path.write_bytes(data[:at] + hole + data[at + 3000 :])
    recording = Recording(path)
    found = [message.fields["n"] for message in recording]
    assert found == sorted(set(found))
    assert found[0] == 0
    assert found[-1] == 3999
    assert len(found) > 3000
    assert recording.damage()


def test_messages_outside_of_blocks_are_found_again(tmp_path: Path) -> None:
    encoded = [(time_ns, json.dumps(fields).encode()) for time_ns, fields in rows(2000)]
    path = mcap_log(
        tmp_path / "log.mcap", "/k", ("K", "jsonschema", b"{}"), "json", encoded, "none", use_chunking=False
    )
    data = path.read_bytes()
    at = len(data) // 3
    path.write_bytes(data[:at] + data[at + 1000 :])
    found = [message.fields["n"] for message in MessageLogReader(path)]
    assert found == sorted(set(found))
    assert found[-1] == 1999
    assert len(found) > 1980


def test_a_wrong_beginning_does_not_hide_what_follows(tmp_path: Path) -> None:
    path = json_log(tmp_path / "log.mcap", "/k", rows(10))
    data = path.read_bytes()
    path.write_bytes(b"\x88" + data[1:])
    recording = Recording(path)
    assert len(list(recording)) == 10
    assert recording.damage()[0].found == ("1 damaged place",)


def test_a_file_of_a_session_that_is_none_is_passed_over_and_said(tmp_path: Path) -> None:
    for number in range(3):
        with MessageLogWriter(tmp_path / f"a-20260101T000000Z-00000{number}.mcap") as log:
            log.write(Message(ZENOH, "k", START_NS, {"n": number}))
    (tmp_path / "a-20260101T000000Z-000001.mcap").write_bytes(bytes(100))
    recording = Recording(tmp_path)
    assert [message.fields["n"] for message in recording] == [0, 2]
    [damage] = recording.damage()
    assert damage.line().startswith("a-20260101T000000Z-000001.mcap: not an MCAP file")


def test_a_ros_2_bag_of_many_files_is_read_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    (tmp_path / "metadata.yaml").touch()
    for number in range(12):
        json_log(tmp_path / f"rosbag2_2026_01_01-10_00_00_{number}.mcap", "/k", [(START_NS, {"n": number})])
    assert [message.fields["n"] for message in Recording(tmp_path)] == [*range(12)]


def test_a_record_of_an_impossible_time_is_damaged(tmp_path: Path) -> None:
    rows = [(START_NS, b"{}"), ((1 << 64) - 1, b"{}"), (LATEST_NS, b"{}"), (START_NS + 1, b"{}")]
    reader = MessageLogReader(mcap_log(tmp_path / "log.mcap", "/a", ("a", "jsonschema", b"{}"), "json", rows))
    assert [message.received_ns for message in reader] == [START_NS, START_NS + 1]
    assert reader.damaged_records == 2
