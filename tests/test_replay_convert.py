"""``fauio convert`` copies what others recorded as it is, and leaves no file where nothing can be read."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from foreign_logs import (
    ARM_DEFINITION,
    ARM_TOPIC,
    ARM_TYPE,
    START_NS,
    arm_rows,
    json_log,
    protobuf_log,
    ros2_bag,
    tracked,
    write_foreign_profile,
)
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_ros2.decoder import DecoderFactory

import fauio
from adapters.logs.mcap_log import MessageLogWriter
from adapters.message import Message
from adapters.source import ZENOH
from monitor.profile import Profile

WRITERS: dict[str, Callable[[Path], Path]] = {
    "ros2": lambda path: ros2_bag(path, {ARM_TOPIC: (ARM_TYPE, ARM_DEFINITION, arm_rows(tracked()))}),
    "json": lambda path: json_log(path, ARM_TOPIC, arm_rows(tracked())),
    "protobuf": lambda path: protobuf_log(path, arm_rows(tracked())),
}


def converted(log: Path, capsys: pytest.CaptureFixture[str]) -> Path:
    out = log.with_name("out.mcap")
    assert fauio.main(["convert", str(log), "-o", str(out), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["damage"] == []
    return out


def content(path: Path) -> Iterator[tuple[Any, ...]]:
    with path.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages(log_time_order=False):
            kind = schema and (schema.name, schema.encoding, schema.data)
            times = message.log_time, message.publish_time
            yield channel.topic, channel.message_encoding, kind, times, message.data


@pytest.mark.parametrize("kind", WRITERS)
def test_what_others_recorded_is_copied_with_schema_bytes_and_times(
    kind: str, arm_profile: Profile, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = WRITERS[kind](tmp_path / "log.mcap")
    out = converted(log, capsys)
    assert list(content(out)) == list(content(log))
    profile = write_foreign_profile(arm_profile, tmp_path / "profile")
    events = []
    for path in (log, out):
        assert fauio.main(["replay", str(profile), str(path), "--json"]) == 0
        events.append(json.loads(capsys.readouterr().out)["alarms"])
    assert events[0] == events[1] != []


def test_a_copied_bag_is_decoded_by_others_as_before(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = converted(WRITERS["ros2"](tmp_path / "log.mcap"), capsys)
    with out.open("rb") as stream:
        decoded = next(make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages())
    assert list(decoded.decoded_message.y) == tracked().y[0].tolist()


def test_topics_of_any_encoding_and_of_several_schemas_are_copied(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "log.mcap"
    with log.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schemas = [writer.register_schema(name, "jsonschema", name.encode()) for name in ("first", "second")]
        channels = [writer.register_channel("/a", "json", schema) for schema in schemas]
        channels.append(writer.register_channel("/camera", "cbor", 0))
        for number in range(9):
            writer.add_message(channels[number % 3], START_NS + number, b"{}", START_NS - number)
        writer.finish()
    out = converted(log, capsys)
    assert list(content(out)) == list(content(log))


@pytest.mark.parametrize("name", ["log.mcap", "log.tlog", "log.ulg", "log.bin", "log.tlog.xz", "log.mcap.gz"])
def test_what_cannot_be_read_leaves_no_file_and_overwrites_none(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, out = tmp_path / name, tmp_path / "out.mcap"
    log.write_bytes(bytes(5000))
    assert fauio.main(["convert", str(log), "-o", str(out)]) == 2
    assert not out.exists()
    out.write_bytes(b"kept")
    assert fauio.main(["convert", str(log), "-o", str(out)]) == 2
    assert out.read_bytes() == b"kept"
    assert name in capsys.readouterr().err


def test_a_recording_is_not_converted_into_itself(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "log.mcap"
    with MessageLogWriter(path) as log:
        log.write(Message(ZENOH, "k", START_NS, {"a": 1}))
    before = path.read_bytes()
    assert fauio.main(["convert", str(path), "-o", str(path)]) == 2
    assert path.read_bytes() == before
    assert "another name" in capsys.readouterr().err
