"""Recordings in blocks hold, and give back, what recordings message by message do."""

from __future__ import annotations

from itertools import islice
from pathlib import Path
from typing import Any

from mcap.reader import NonSeekingReader

from adapters.batch import Batch, messages
from adapters.logs.mcap_log import MessageLogWriter
from adapters.logs.mcap_reader import MessageLogReader
from adapters.logs.recordings import packed, read_batches, read_recording
from adapters.message import Message
from adapters.source import MAVLINK, OPERATOR, ZENOH
from monitor.profile import read_profile
from replay.player import play, play_batches

START_NS = 1_790_000_000_000_000_000
FLIGHT = Path(__file__).parent / "data" / "copter_5s.tlog.xz"
PROFILE = Path(__file__).parent.parent / "replay" / "data" / "quad"
# another vehicle, a text, numbers that the definition does not allow, a key that a MAVLink message has too
ODD = (
    Message(MAVLINK, "ATTITUDE", START_NS, {"roll": 1.0}, 1, 1),
    Message(ZENOH, "ATTITUDE", START_NS + 1, {"roll": 1.5}),
    Message(MAVLINK, "SYSTEM_TIME", START_NS + 2, {"time_unix_usec": (1 << 64) - 1, "time_boot_ms": 1}, 1, 1),
    Message(MAVLINK, "SYSTEM_TIME", START_NS + 3, {"time_unix_usec": 5, "time_boot_ms": -1}, 1, 1),
    Message(MAVLINK, "SYSTEM_TIME", START_NS + 4, {"time_unix_usec": 5, "time_boot_ms": 2}, 0, 0),
    Message(ZENOH, "SYSTEM_TIME", START_NS + 5, {"time_unix_usec": 5, "time_boot_ms": 3}),
    Message(OPERATOR, "acknowledge", START_NS + 6, {"channel": "motor1"}),
    Message(ZENOH, "arm/telemetry", START_NS + 7, {"y": [1.0, 2.0], "n": 3}),
)


def records(path: Path) -> list[Any]:
    with path.open("rb") as stream:
        found = NonSeekingReader(stream).iter_messages(log_time_order=False)
        return [(channel.topic, schema and schema.data, one.log_time, one.data) for schema, channel, one in found]


def all_messages(blocks: list[Batch]) -> list[str]:
    return [repr(message) for block in blocks for message in messages(block)]


def test_blocks_of_a_recording_are_its_messages(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with MessageLogWriter(path) as log:
        for number, message in enumerate(islice(read_recording(FLIGHT), 800)):
            log.write(message)
            if number % 80 == 0:
                log.write(ODD[number // 80 % len(ODD)])
    expected = [repr(message) for message in read_recording(path)]
    assert len(expected) > 800
    for count in (1, 170, 1 << 20):
        assert all_messages([*read_batches(path, count=count)]) == expected
    only = {"ATTITUDE", "HEARTBEAT"}
    assert all_messages([*read_batches(path, only)]) == [repr(message) for message in read_recording(path, only)]


def test_blocks_pass_over_what_cannot_be_decoded_and_count_it(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with MessageLogWriter(path) as log:
        for message in ODD:
            log.write(message)
    data = path.read_bytes()
    [*whole] = MessageLogReader(path)
    assert len(whole) == len(ODD)
    path.write_bytes(data[: len(data) // 2])
    one_by_one, together = MessageLogReader(path), MessageLogReader(path)
    assert all_messages([*together.batches(3)]) == [repr(message) for message in one_by_one]
    assert together.damaged_records == one_by_one.damaged_records
    assert together.damage() == one_by_one.damage()
    assert together.damage() == one_by_one.damage()


def test_a_recording_does_not_depend_on_how_the_stream_is_cut(tmp_path: Path) -> None:
    profile = read_profile(PROFILE)
    stretch = [*read_recording(FLIGHT)]
    stretch[40:40] = [*ODD, Message(MAVLINK, "ATTITUDE", START_NS, {"roll": 1.0}, 7, 1)]
    paths = tmp_path / "few.mcap", tmp_path / "many.mcap"
    for path, count in zip(paths, (3, 700), strict=True):
        play_batches(profile, packed(stretch, count), record=path)
    few, many = (sorted(records(path), key=lambda record: record[0]) for path in paths)
    assert {topic for topic, *_ in few} >= {"/fauio/motors/estimate", "/mavlink/ATTITUDE", "/zenoh/ATTITUDE"}
    assert many == few


def test_a_recording_replays_in_blocks_as_its_messages_do(tmp_path: Path) -> None:
    profile = read_profile(PROFILE)
    path = tmp_path / "flight.mcap"
    expected = play_batches(profile, read_batches(FLIGHT), record=path)
    found, single = play_batches(profile, read_batches(path)), play(profile, read_recording(path))
    assert found.events == single.events == expected.events
    assert found.samples == single.samples == expected.samples > 0
