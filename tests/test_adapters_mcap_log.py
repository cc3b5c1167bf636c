"""Message logs: read in the order of writing, readable after a kill, honest about damage."""

from __future__ import annotations

import gzip
import io
import json
import lzma
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_protobuf.decoder import DecoderFactory

from adapters.encoding.record import Record, Schema
from adapters.errors import StorageError, TelemetryError
from adapters.logs.mcap_log import CHUNK_BYTES, MAX_CHANNELS, MessageLogWriter
from adapters.logs.mcap_reader import MessageLogReader, read_mcap_metadata
from adapters.message import Message
from adapters.source import MAVLINK, ZENOH

START_NS = 1_795_251_917_000_000_000
SCHEMA = Schema("fauio.Alarm", "jsonschema", b'{"type": "object"}')


def attitude(number: int, received_ns: int | None = None) -> Message:
    fields = {"time_boot_ms": number, "roll": 0.5, "pitch": -0.25, "yaw": 0.0}
    rates = {"rollspeed": number / 4, "pitchspeed": 0.0, "yawspeed": 1.0}
    return Message(MAVLINK, "ATTITUDE", received_ns or START_NS + number, {**fields, **rates}, 1, 1)


def arm(number: int, received_ns: int) -> Message:
    return Message(ZENOH, "arm/telemetry", received_ns, {"time_ns": number, "data": [1.5, {"deep": "ü"}]})


def write(path: Path, messages: list[Message]) -> Path:
    with MessageLogWriter(path) as log:
        for message in messages:
            log.write(message)
    return path


def long_log(path: Path) -> list[Message]:
    """Write a log of several chunks and return what it holds."""
    messages = [attitude(number) for number in range(10_000)]
    write(path, messages)
    return messages


@pytest.mark.parametrize("suffix", [".mcap", ".mcap.xz", ".mcap.gz"])
def test_messages_come_back_in_the_order_of_writing_even_where_times_are_equal_or_fall(
    tmp_path: Path, suffix: str
) -> None:
    messages = [
        attitude(1, START_NS + 9),
        arm(1, START_NS + 9),
        attitude(2, START_NS + 9),
        attitude(3, START_NS + 1),
        arm(2, START_NS + 9),
        Message(MAVLINK, "STATUSTEXT", START_NS, {"severity": 6, "text": "héllo", "id": 0, "chunk_seq": 0}, 1, 1),
        attitude(4, 0),
    ]
    raw = write(tmp_path / "plain.mcap", messages).read_bytes()
    path = tmp_path / f"log{suffix}"
    path.write_bytes({".mcap": bytes, ".mcap.xz": lzma.compress, ".mcap.gz": gzip.compress}[suffix](raw))
    reader = MessageLogReader(path)
    assert list(reader) == messages
    assert reader.messages == len(messages)
    assert reader.scan.stopped_at is None
    assert reader.scan.damaged_chunks == reader.damaged_records == 0


def test_other_tools_read_typed_fields_from_the_file_alone(tmp_path: Path) -> None:
    path = write(tmp_path / "log.mcap", [attitude(7), arm(1, START_NS)])
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        schema, channel, message, decoded = next(reader.iter_decoded_messages(topics=["/mavlink/ATTITUDE"]))
        assert schema is not None
        assert (schema.name, schema.encoding) == ("mavlink.ATTITUDE", "protobuf")
        assert (decoded.time_boot_ms, decoded.rollspeed, decoded.system_id) == (7, 1.75, 1)
        assert message.log_time == message.publish_time == START_NS + 7
        [(_, channel, message)] = reader.iter_messages(topics=["/zenoh/arm/telemetry"])
        assert channel.message_encoding == "json"
        assert json.loads(message.data)["data"] == [1.5, {"deep": "ü"}]


def test_messages_that_fit_no_definition_are_kept_as_json(tmp_path: Path) -> None:
    odd = [
        Message(MAVLINK, "UNKNOWN_4711", START_NS, {"a": 1, "text": "\udcff"}, 1, 2),
        Message(MAVLINK, "ATTITUDE", START_NS, {"roll": 0.1}, 1, 2),
        attitude(1),
    ]
    assert list(MessageLogReader(write(tmp_path / "log.mcap", odd))) == odd


def test_nan_and_infinity_from_json_come_back(tmp_path: Path) -> None:
    odd = Message(ZENOH, "k", START_NS, {"v": [float("inf"), -float("inf"), float("nan"), 2**70]})
    [back] = MessageLogReader(write(tmp_path / "log.mcap", [odd]))
    assert repr(back) == repr(odd)


def test_what_no_record_can_hold_is_counted_and_the_log_goes_on(tmp_path: Path) -> None:
    deep: dict[str, Any] = {}
    for _ in range(20_000):
        deep = {"d": deep}
    bad = [
        Message(ZENOH, "k", START_NS, {"v": object()}),
        Message(ZENOH, "k", START_NS, {"v": b"bytes"}),
        Message(ZENOH, "k", START_NS, deep),
        Message(ZENOH, "\udcff", START_NS, {"v": 1}),
        attitude(1, -5),
        attitude(1, 2**64),
    ]
    with MessageLogWriter(tmp_path / "log.mcap") as log:
        for message in bad:
            log.write(message)
            log.write(attitude(1))
        for number in range(MAX_CHANNELS + 10):
            log.write(Message(ZENOH, f"flood/{number}", START_NS, {}))
    # ATTITUDE took the first of the topics
    assert log.unrecordable == len(bad) + 11
    assert len(list(MessageLogReader(tmp_path / "log.mcap"))) == log.records


def test_a_stream_is_written_and_left_open() -> None:
    stream = io.BytesIO()
    with MessageLogWriter(stream) as log:
        log.write(attitude(1))
    assert not stream.closed
    assert stream.getvalue().endswith(b"\x89MCAP0\r\n")


def test_writing_after_close_names_the_mistake(tmp_path: Path) -> None:
    log = MessageLogWriter(tmp_path / "log.mcap")
    log.close()
    log.close()
    log.flush()
    with pytest.raises(RuntimeError, match="closed"):
        log.write(attitude(1))


def test_a_truncated_log_gives_every_message_of_its_whole_chunks(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    messages = long_log(path)
    raw = path.read_bytes()
    seen = []
    for part in range(1, 16, 2):
        path.write_bytes(raw[: len(raw) * part // 16])
        reader = MessageLogReader(path)
        found = list(reader)
        assert found == messages[: len(found)]
        assert reader.scan.stopped_at is not None
        seen.append(len(found))
    assert seen == sorted(seen)
    assert seen[-1] == len(messages)
    assert len(set(seen)) > 3


@pytest.mark.parametrize("compress", [gzip.compress, lzma.compress])
def test_a_truncated_compressed_log_gives_what_stands_before_the_break(tmp_path: Path, compress: Any) -> None:
    path = tmp_path / "log.mcap"
    messages = long_log(path)
    packed = tmp_path / ("log.mcap.gz" if compress is gzip.compress else "log.mcap.xz")
    raw = compress(path.read_bytes())
    packed.write_bytes(raw[: len(raw) * 3 // 4])
    reader = MessageLogReader(packed)
    found = list(reader)
    assert found == messages[: len(found)]
    assert len(found) > 0
    assert reader.scan.stopped_at is not None


def test_one_flipped_byte_costs_one_chunk_and_is_counted(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    messages = long_log(path)
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert len(summary.chunk_indexes) > 4
    raw = path.read_bytes()
    for index in summary.chunk_indexes[::2]:
        broken = bytearray(raw)
        broken[index.chunk_start_offset + index.chunk_length // 2] ^= 0x10
        path.write_bytes(broken)
        reader = MessageLogReader(path)
        found = list(reader)
        # also the first chunk, which defines schema and channel: the index at the end has them too
        numbers = [message.fields["time_boot_ms"] for message in found]
        assert found == [messages[number] for number in sorted(set(numbers))]
        assert 0 < len(messages) - len(found) < CHUNK_BYTES // 50
        assert reader.scan.damaged_chunks == 1
        assert reader.scan.stopped_at is None


@given(data=st.data())
def test_no_damage_ever_raises_anything_but_the_error_for_the_user(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    stream = io.BytesIO()
    with MessageLogWriter(stream) as log:
        log.add_metadata("fauio", {"version": "1"})
        for number in range(20):
            log.write(attitude(number))
            log.write(arm(number, START_NS))
            log.flush()
    broken = bytearray(stream.getvalue())
    for _ in range(data.draw(st.integers(1, 5))):
        broken[data.draw(st.integers(0, len(broken) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path_factory.mktemp("damage") / "log.mcap"
    path.write_bytes(broken[: data.draw(st.integers(0, len(broken)))])
    try:
        for message in MessageLogReader(path):
            assert message.source in (MAVLINK, ZENOH)
        read_mcap_metadata(path)
    except TelemetryError as error:
        assert "\n" not in str(error)


def test_metadata_is_amended_in_its_place_and_only_to_the_same_length(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    log = MessageLogWriter(path)
    log.add_metadata("fauio", {"clock": "  "})
    log.write(attitude(1))
    log.flush()
    log.amend_metadata("fauio", {"clock": "12"})
    with pytest.raises(ValueError, match="no metadata record 'fauio' of"):
        log.amend_metadata("fauio", {"clock": "123"})
    log.write(attitude(2))
    log.close()
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert [record.metadata for record in reader.iter_metadata()] == [{"clock": "12"}]
        assert len([*reader.iter_messages()]) == 2


def test_metadata_comes_back_also_from_an_unfinished_log(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    log = MessageLogWriter(path)
    log.add_metadata("fauio", {"version": "1", "profile": "a"})
    log.add_metadata("fauio", {"profile": "b"})
    log.flush()
    assert read_mcap_metadata(path) == {"fauio": {"version": "1", "profile": "b"}}
    log.close()
    assert read_mcap_metadata(path) == {"fauio": {"version": "1", "profile": "b"}}


def test_our_results_are_passed_over_and_json_that_is_no_object_is_counted(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with MessageLogWriter(path) as log:
        log.write_record(Record("/fauio/alarm_json", "json", SCHEMA, b"{}", START_NS))
        log.write(attitude(1))
        log.write_record(Record("/other", "json", None, b"[]", START_NS))
    reader = MessageLogReader(path)
    assert list(reader) == [attitude(1)]
    assert reader.other_records == 1
    assert reader.damaged_records == 1


def test_logs_without_chunks_are_read_too(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, use_chunking=False)
        writer.start()
        channel = writer.register_channel("/zenoh/k", "json", 0)
        for number in range(3):
            writer.add_message(channel, START_NS, json.dumps({"v": number}).encode(), START_NS)
        writer.finish()
    assert [message.fields["v"] for message in MessageLogReader(path)] == [0, 1, 2]


@pytest.mark.parametrize("name", ["log.mcap", "log.mcap.gz", "log.mcap.xz"])
@pytest.mark.parametrize("content", [b"", b"\x00" * 100, b"not a log at all"])
def test_a_file_that_is_no_mcap_is_one_line_for_the_user(tmp_path: Path, name: str, content: bytes) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(TelemetryError, match=r"^[^\n]*log\.mcap[^\n]*not an MCAP file[^\n]*$"):
        list(MessageLogReader(path))


def test_a_path_that_cannot_be_opened_is_one_line_for_the_user(tmp_path: Path) -> None:
    with pytest.raises(TelemetryError, match=r"nothing\.mcap: [^\n]*No such file"):
        list(MessageLogReader(tmp_path / "nothing.mcap"))
    with pytest.raises(TelemetryError, match=r"Is a directory"):
        list(MessageLogReader(tmp_path))
    with pytest.raises(StorageError, match=r"x\.mcap: cannot be written: No such file"):
        MessageLogWriter(tmp_path / "nowhere" / "x.mcap")
