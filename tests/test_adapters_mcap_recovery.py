"""Unfinished MCAP files are finished: every reader opens them, and no message that was whole is lost."""

from __future__ import annotations

import fcntl
import json
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap.records import Message as McapMessage
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC, Writer

import fauio
from adapters.encoding.record import Record, Schema
from adapters.errors import StorageError
from adapters.logs.mcap_log import MessageLogWriter
from adapters.logs.mcap_reader import MessageLogReader
from adapters.logs.mcap_recovery import finish, is_unfinished
from monitor.recording.recover import finish_all

SCHEMA = Schema("thing", "jsonschema", b"{}")


def write_log(path: Path, chunks: int = 5, each: int = 40) -> None:
    with MessageLogWriter(path) as log:
        log.add_metadata("fauio", {"vehicle": "one"})
        log.add_attachment("profile/a.json", "application/json", b"{}")
        for chunk in range(chunks):
            for k in range(each):
                number = chunk * each + k
                data = json.dumps({"n": number, "noise": hash(str(number))}).encode()
                log.write_record(Record(f"/fauio/thing{number % 3}", "json", SCHEMA, data, 1000 + number))
            log.flush()


def numbers(path: Path) -> list[int]:
    """Return what a plain reader that goes by the index reads."""
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        read = [json.loads(message.data)["n"] for _, _, message in reader.iter_messages()]
        assert summary.statistics.message_count == len(read)
        assert [one.name for one in reader.iter_attachments()] == ["profile/a.json"]
        assert [one.metadata for one in reader.iter_metadata()] == [{"vehicle": "one"}]
        return read


def plainly_read(path: Path) -> list[int]:
    """Return what our reader, which needs no index, reads."""
    return [
        json.loads(record.data)["n"]
        for topic in range(3)
        for record in MessageLogReader(path, topic=f"/fauio/thing{topic}").records()
    ]


def test_wherever_a_file_is_cut_off_all_messages_that_are_whole_are_in_its_index(tmp_path: Path) -> None:
    whole, cut = tmp_path / "whole.mcap", tmp_path / "cut.mcap"
    write_log(whole)
    content = whole.read_bytes()
    head = content.index(b"\x06", 200)
    for size in range(head, len(content), 127):
        cut.write_bytes(content[:size])
        before = sorted(plainly_read(cut))
        assert is_unfinished(cut)
        done = finish(cut)
        assert done is not None
        assert sorted(numbers(cut)) == before == list(range(len(before)))
        assert done.messages == len(before)
        assert not is_unfinished(cut)
        assert finish(cut) is None


def test_a_finished_file_stays_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "whole.mcap"
    write_log(path)
    content = path.read_bytes()
    assert finish(path) is None
    assert path.read_bytes() == content


def test_damage_in_the_middle_costs_what_it_hit(tmp_path: Path) -> None:
    path = tmp_path / "damaged.mcap"
    write_log(path)
    content = bytearray(path.read_bytes())[:-400]
    content[content.index(b"zstd", content.index(b"zstd") + 4) + 50] ^= 0xFF
    path.write_bytes(content)
    before = sorted(plainly_read(path))
    assert len(before) == 160
    assert finish(path) is not None
    assert sorted(numbers(path)) == before
    assert (tmp_path / "damaged.mcap.damaged").read_bytes() == content


def test_a_file_that_was_only_begun_is_finished_empty(tmp_path: Path) -> None:
    path = tmp_path / "begun.mcap"
    path.write_bytes(MCAP0_MAGIC + b"\x01")
    done = finish(path)
    assert done is not None
    assert (done.messages, [*tmp_path.iterdir()]) == (0, [path])
    with path.open("rb") as stream:
        assert make_reader(stream).get_summary() is not None


def test_what_other_recorders_say_of_their_channels_and_messages_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "other.mcap"
    with path.open("wb") as stream:
        # a chunk for each message
        writer = Writer(stream, chunk_size=1)
        writer.start("ros2", "another")
        channel = writer.register_channel(
            "/imu", "cdr", writer.register_schema("a/B", "ros2msg", b"int8 a"), {"qos": "1"}
        )
        writer.add_message(channel, 7, b"x", 6, sequence=5)
    assert finish(path) is not None
    with path.open("rb") as stream:
        reader = make_reader(stream)
        [(schema, kept, message)] = reader.iter_messages()
        assert (reader.get_header().profile, reader.get_header().library) == ("ros2", "another")
        assert schema is not None
        assert (schema.name, kept.metadata) == ("a/B", {"qos": "1"})
        assert (message.log_time, message.publish_time, message.sequence, message.data) == (7, 6, 5, b"x")


def test_a_file_that_is_being_written_is_left_alone_and_readers_that_need_no_index_read_it(tmp_path: Path) -> None:
    path = tmp_path / "live.mcap"
    log = MessageLogWriter(path)
    log.write_record(Record("/fauio/thing0", "json", SCHEMA, b'{"n": 0}', 1))
    log.flush()
    with pytest.raises(StorageError, match="is being written"):
        finish(path)
    assert plainly_read(path) == [0]
    with path.open("rb") as stream:
        message = next(record for record in StreamReader(stream).records if isinstance(record, McapMessage))
        assert json.loads(message.data)["n"] == 0
    log.close()
    assert not is_unfinished(path)
    with path.open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


def test_the_command_finishes_folders_and_says_what_it_did(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("a/one.mcap", "b/two.mcap", "three.mcap"):
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        write_log(path)
        if name != "three.mcap":
            path.write_bytes(path.read_bytes()[:-300])
    assert fauio.main(["recover", str(tmp_path / "a" / "one.mcap")]) == 0
    assert capsys.readouterr().out == f"{tmp_path}/a/one.mcap: finished, 200 messages\n"
    assert fauio.main(["recover", str(tmp_path), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert [(row["path"], row["messages"]) for row in said["finished"]] == [(f"{tmp_path}/b/two.mcap", 200)]
    assert fauio.main(["recover", str(tmp_path)]) == 0
    assert "nothing to finish" in capsys.readouterr().out
    assert fauio.main(["recover", str(tmp_path / "nothing.mcap")]) == 2
    assert "no such file" in capsys.readouterr().err


def test_a_daemon_that_starts_finishes_what_the_one_before_left(tmp_path: Path) -> None:
    path = tmp_path / "vehicle" / "left.mcap"
    path.parent.mkdir()
    write_log(path)
    path.write_bytes(path.read_bytes()[:-300])
    said: list[tuple[str, dict[str, Any]]] = []
    finish_all(tmp_path, lambda event, **fields: said.append((event, fields))).join()
    assert [(event, fields["messages"]) for event, fields in said] == [("recording finished", 200)]
    assert len(numbers(path)) == 200
