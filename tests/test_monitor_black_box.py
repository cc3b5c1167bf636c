"""Black box: what led to an alarm and what followed is left behind as a recording of its own."""

from __future__ import annotations

import errno
import gc
import random
from pathlib import Path
from typing import Any

import pytest
from loopback import START_NS, event
from mcap.reader import make_reader
from test_monitor_recorder import LAYOUT, estimates

from adapters.batch import pack
from adapters.errors import StorageError
from adapters.logs.mcap_log import MessageLogWriter
from adapters.logs.mcap_reader import MessageLogReader, read_mcap_metadata
from adapters.logs.recordings import packed, read_recording, recorded_alarms
from adapters.message import Message
from adapters.source import MAVLINK, ZENOH
from monitor.estimate import Estimates
from monitor.event import AlarmEvent, alarm_id
from monitor.pipeline import Pipeline
from monitor.profile import Profile
from monitor.recording.archive import Archive
from monitor.recording.black_box import MAX_OPEN_CLIPS, MAX_TRIES, MAX_WAITING_CLIPS, BlackBox
from monitor.recording.record_encoder import RecordEncoder
from replay.player import play

SECOND = 1_000_000_000
ENCODER = RecordEncoder([LAYOUT])


def message(second: float, **fields: Any) -> Message:
    return Message(ZENOH, "k", START_NS + round(second * SECOND), {"s": second, **fields})


def heartbeat(second: float, component: int = 1) -> Message:
    fields = {"type": 2, "autopilot": 3, "base_mode": 217, "custom_mode": 4, "system_status": 4, "mavlink_version": 3}
    return Message(MAVLINK, "HEARTBEAT", START_NS + round(second * SECOND), fields, 1, component)


def raised(second: float, channel: str = "motor1") -> AlarmEvent:
    since = START_NS + round(second * SECOND)
    return event(1, channel, id=alarm_id("copter-1", "motors", channel, since), time_ns=since, since_ns=since)


def black_box(folder: Path, **options: Any) -> BlackBox:
    options = {"before_s": 5.0, "after_s": 3.0, **options}
    return BlackBox(folder, "copter-1", ENCODER.topics, {"fauio": "1"}, {"profile.toml": b"x = 1"}, **options)


def hold(box: BlackBox, *messages: Message) -> None:
    box.record(ENCODER.batch(pack(messages)), telemetry=True)


def feed(box: BlackBox, first: int, last: int) -> None:
    """Feed one message each second, all in one batch."""
    hold(box, *(message(second) for second in range(first, last)))


def finish(box: BlackBox) -> None:
    while box.work(1000):
        pass


def clips(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.mcap"))


def seconds(path: Path) -> list[float]:
    return [found.fields["s"] for found in read_recording(path) if found.source == ZENOH]


def test_a_clip_holds_what_came_before_and_after_and_says_which_alarm_it_is(tmp_path: Path) -> None:
    box = black_box(tmp_path)
    feed(box, 0, 20)
    alarm = raised(19)
    box.record(ENCODER.estimates(estimates(19)))
    box.alarm(alarm)
    box.record(ENCODER.event(alarm))
    feed(box, 20, 40)
    finish(box)
    [path] = clips(tmp_path)
    assert path.name == f"copter-1-{alarm.id}.mcap"
    assert seconds(path) == [*range(14, 23)]
    assert read_mcap_metadata(path)["fauio"] == {
        "fauio": "1",
        "alarm_id": alarm.id,
        "alarm_channel": "motor1",
        "alarm_observer": "motors",
        "alarm_ids": alarm.id,
    }
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert [found.data for found in reader.iter_attachments()] == [b"x = 1"]
        topics = {channel.topic for _, channel, _ in reader.iter_messages()}
    own = {"motors/sample", "motors/estimate", "alarm", "alarm_json"}
    assert topics == {"/zenoh/k", *(f"/fauio/{name}" for name in own)}
    assert (box.statistics().written, box.statistics().open, box.statistics().failed) == (1, 0, None)


def test_it_begins_with_what_each_component_last_said_of_the_phase(tmp_path: Path) -> None:
    box = black_box(tmp_path)
    before = [heartbeat(0, 1), heartbeat(1, 1), heartbeat(2, 154)]
    for found in before:
        hold(box, found)
    feed(box, 3, 20)
    box.alarm(raised(19))
    box.close()
    messages = list(read_recording(clips(tmp_path)[0]))
    assert messages[:2] == before[1:]
    assert seconds(clips(tmp_path)[0]) == [*range(14, 20)]


# before the alarm of GPS the gate opens for 1 s and the inertial observer settles for 5 s
@pytest.mark.parametrize(("name", "before_s"), [("copter_motor2_080", 5.0), ("copter_gps_step25m", 7.0)])
def test_the_clip_of_an_alarm_raises_it_again(
    name: str, before_s: float, quad_profile: Profile, tmp_path: Path, data: Path
) -> None:
    messages = list(read_recording(data / f"{name}.tlog.xz"))
    phase = {"HEARTBEAT", "EXTENDED_SYS_STATE"}
    # the vehicle says that it is armed and in the air long before the clip begins, and never again
    last = messages[0].received_ns + 2 * SECOND
    messages = [found for found in messages if found.name not in phase or found.received_ns < last]
    pipeline = Pipeline(quad_profile, "copter-1")
    encoder = RecordEncoder(pipeline.layouts)
    box = BlackBox(
        tmp_path, "copter-1", encoder.topics, pipeline.metadata(), quad_profile.files, before_s=before_s, after_s=3.0
    )
    archive = Archive(encoder, black_box=box)
    first = None
    for batch in packed(messages, 50):
        archive.batch(batch)
        for output in pipeline.run(batch):
            if isinstance(output, Estimates):
                archive.estimates(output)
            else:
                archive.event(output)
                first = first or output
        box.work(500)
    box.close()
    assert first is not None
    path = tmp_path / f"copter-1-{first.id}.mcap"
    recorded = list(read_recording(path))
    assert {found.name for found in recorded[:2]} == phase
    assert recorded[0].received_ns < last
    again = [found for found in play(quad_profile, recorded).events if found.state == "raised"]
    assert [found.channel for found in again][:1] == [first.channel]


def test_a_portion_is_all_that_is_written_in_one_turn(tmp_path: Path) -> None:
    box = black_box(tmp_path)
    feed(box, 0, 20)
    box.alarm(raised(19))
    box.alarm(raised(19, "motor2"))
    assert clips(tmp_path) == []
    assert [box.work(5) for _ in range(4)] == [5, 5, 2, 0]
    feed(box, 20, 21)
    assert box.work(5) == 2
    assert box.statistics().open == 2
    box.close()


def test_more_alarms_than_clips_are_named_by_those_that_cover_them(tmp_path: Path) -> None:
    box = black_box(tmp_path)
    feed(box, 0, 20)
    alarms = [raised(19, f"motor{number}") for number in range(6)]
    for alarm in alarms:
        box.alarm(alarm)
        box.alarm(alarm)
    assert box.statistics().open == MAX_OPEN_CLIPS
    box.close()
    assert [path.stem.removeprefix("copter-1-") for path in clips(tmp_path)] == sorted(a.id for a in alarms[:4])
    for path in clips(tmp_path):
        assert sorted(read_mcap_metadata(path)["fauio"]["alarm_ids"].split(",")) == sorted(a.id for a in alarms)


def test_a_later_clip_names_the_alarms_of_its_seconds_before(tmp_path: Path) -> None:
    box = black_box(tmp_path)
    alarms = [raised(10), raised(14), raised(17)]
    for second in range(30):
        feed(box, second, second + 1)
        for alarm in alarms:
            if alarm.time_ns == START_NS + second * SECOND:
                box.alarm(alarm)
        box.work(100)
    first, second, third = (a.id for a in alarms)
    assert [read_mcap_metadata(path)["fauio"]["alarm_ids"] for path in clips(tmp_path)] == [
        first,
        f"{first},{second}",
        f"{second},{third}",
    ]


def test_a_clip_has_one_metadata_record_and_the_events_of_alarms_raised_while_it_was_made(tmp_path: Path) -> None:
    box = black_box(tmp_path)
    alarms = [raised(10), raised(12)]
    for second in range(20):
        feed(box, second, second + 1)
        for alarm in alarms:
            if alarm.time_ns == START_NS + second * SECOND:
                box.record(ENCODER.event(alarm))
                box.alarm(alarm)
        box.work(100)
    path = tmp_path / f"copter-1-{alarms[0].id}.mcap"
    assert [event["id"] for event in recorded_alarms(path)] == [alarm.id for alarm in alarms]
    with path.open("rb") as stream:
        assert [record.name for record in make_reader(stream).iter_metadata()] == ["fauio"]


def test_other_states_and_clips_that_exist_already_change_nothing(tmp_path: Path) -> None:
    box = black_box(tmp_path)
    alarm = raised(0)
    (tmp_path / f"copter-1-{alarm.id}.mcap").write_bytes(b"earlier")
    feed(box, 0, 2)
    box.alarm(alarm)
    for state in ("updated", "acknowledged", "shelved", "cleared"):
        box.alarm(event(2, state=state))
    box.close()
    assert [path.read_bytes() for path in clips(tmp_path)] == [b"earlier"]


def test_silence_ends_a_clip_when_the_caller_says_what_time_it_is(tmp_path: Path) -> None:
    box = black_box(tmp_path)
    feed(box, 0, 10)
    box.alarm(raised(9))
    box.work(100, START_NS + 12 * SECOND)
    assert box.statistics().open == 1
    box.work(100, START_NS + 13 * SECOND)
    assert box.statistics().written == 1


def test_a_clock_that_is_set_back_ends_a_clip_that_would_wait_for_its_end(tmp_path: Path) -> None:
    box = black_box(tmp_path)
    feed(box, 1000, 1010)
    box.alarm(raised(1009))
    feed(box, 0, 5)
    finish(box)
    assert box.statistics().open == 0
    assert seconds(clips(tmp_path)[0]) == [*range(1004, 1010)]


def test_what_is_held_is_bounded_in_time_number_and_bytes_whatever_the_clock_does(tmp_path: Path) -> None:
    box = black_box(tmp_path, held_records=100)
    for number in range(1000):
        hold(box, message(number / 1000))
    assert box.statistics().held_records == 100
    box = black_box(tmp_path, held_bytes=10_000)
    for number in range(100):
        hold(box, message(number / 1000, text="x" * 1000))
    assert box.statistics().held_bytes <= 10_000
    assert box.statistics().held_records == 9
    box = black_box(tmp_path)
    feed(box, 100, 120)
    feed(box, 0, 3)
    assert box.statistics().held_records == 3


def test_a_clip_that_is_never_written_does_not_grow_without_end(tmp_path: Path) -> None:
    box = black_box(tmp_path, held_records=50, after_s=3600.0)
    box.alarm(raised(0))
    feed(box, 0, 1000)
    assert box.statistics().dropped == 900
    box.close()
    assert len(seconds(clips(tmp_path)[0])) == 100


def test_the_oldest_clips_go_and_foreign_files_stay(tmp_path: Path) -> None:
    foreign = tmp_path / "copter-1-20261121T090517Z-000000.mcap"
    foreign.write_bytes(b"x" * 500_000)
    box = black_box(tmp_path, budget_bytes=400_000)
    noise = random.Random(1)
    for number in range(10):
        start = number * 100
        for second in range(start, start + 5):
            hold(box, message(second, text=noise.randbytes(10_000).hex()))
        box.alarm(raised(start + 4))
        feed(box, start + 5, start + 10)
        finish(box)
    box.close()
    own = [path for path in clips(tmp_path) if path != foreign]
    assert sum(path.stat().st_size for path in own) <= 400_000
    assert foreign.exists()
    assert 0 < len(own) < 10
    assert own[-1].name == f"copter-1-{raised(904).id}.mcap"


def test_a_clip_of_a_quarter_of_the_budget_ends_early_and_is_whole(tmp_path: Path) -> None:
    box = black_box(tmp_path, budget_bytes=400_000)
    noise = random.Random(1)
    box.alarm(raised(0))
    for number in range(100):
        hold(box, message(number / 1000, text=noise.randbytes(10_000).hex()))
    finish(box)
    reader = MessageLogReader(clips(tmp_path)[0])
    assert 0 < len(list(reader)) < 100
    assert reader.scan.stopped_at is None
    assert box.statistics().dropped > 0


def retry(box: BlackBox, second: float) -> None:
    """Let it try all again that it may try at that time."""
    while box.work(1000, START_NS + round(second * SECOND)):
        pass


def test_a_clip_that_the_disk_refuses_is_written_when_there_is_room_again(tmp_path: Path) -> None:
    folder = tmp_path / "clips"
    box = black_box(folder)
    folder.rmdir()
    feed(box, 0, 10)
    box.alarm(raised(9))
    finish(box)
    assert (box.statistics().failures, box.statistics().open) == (0, 1)
    assert "No such file" in str(box.statistics().failed)
    feed(box, 10, 15)
    folder.mkdir()
    retry(box, 18.9)
    assert clips(folder) == []
    retry(box, 19.1)
    assert seconds(clips(folder)[0]) == list(range(4, 13))
    assert (box.statistics().written, box.statistics().open, box.statistics().failed) == (1, 0, None)


def test_a_disk_that_takes_a_clip_again_is_no_trouble_any_more_while_the_clip_goes_on(tmp_path: Path) -> None:
    folder = tmp_path / "clips"
    box = black_box(folder, after_s=30.0)
    folder.rmdir()
    feed(box, 0, 10)
    box.alarm(raised(9))
    finish(box)
    feed(box, 10, 15)
    folder.mkdir()
    retry(box, 18.9)
    assert box.statistics().failed is not None
    retry(box, 19.1)
    assert (box.statistics().failed, box.statistics().open, box.statistics().written) == (None, 1, 0)
    assert seconds(clips(folder)[0]) == list(range(4, 15))
    feed(box, 20, 50)
    finish(box)
    assert seconds(clips(folder)[0]) == [*range(4, 15), *range(20, 40)]
    assert box.statistics().written == 1


def test_a_disk_that_fills_within_a_clip_costs_none_of_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    box = black_box(tmp_path)
    feed(box, 0, 10)
    box.alarm(raised(9))
    box.work(3)
    with monkeypatch.context() as full:

        def refuse(*_: Any) -> None:
            raise OSError(errno.ENOSPC, "No space left on device")

        full.setattr(MessageLogWriter, "add_all", refuse)
        finish(box)
        assert clips(tmp_path) == []
    feed(box, 10, 20)
    retry(box, 20.0)
    box.alarm(raised(19, "motor2"))
    retry(box, 30.0)
    assert [seconds(path) for path in clips(tmp_path)] == [list(range(4, 13)), list(range(14, 20))]
    assert (box.statistics().written, box.statistics().failures) == (2, 0)


def test_clips_that_the_disk_never_takes_are_given_up_the_oldest_first(tmp_path: Path) -> None:
    folder = tmp_path / "clips"
    box = black_box(folder)
    folder.rmdir()
    for number in range(MAX_WAITING_CLIPS + 2):
        feed(box, 5 * number, 5 * number + 5)
        box.alarm(raised(5 * number + 4))
        finish(box)
    assert (box.statistics().failures, box.statistics().open) == (2, MAX_WAITING_CLIPS)
    for number in range(MAX_TRIES + 1):
        retry(box, 100.0 + 11.0 * number)
    assert (box.statistics().failures, box.statistics().open) == (MAX_WAITING_CLIPS + 2, 0)
    assert "No such file" in str(box.statistics().failed)
    folder.mkdir()
    box.alarm(raised(49))
    box.close()
    assert (box.statistics().written, box.statistics().failed) == (1, None)


def test_what_a_full_disk_took_of_a_clip_stays_when_the_monitor_ends(tmp_path: Path) -> None:
    box = black_box(tmp_path)
    feed(box, 0, 10)
    (tmp_path / f"copter-1-{raised(9).id}.mcap").symlink_to("/nowhere/at/all")
    box.alarm(raised(9))
    box.alarm(raised(9, "motor2"))
    box.close()
    assert (box.statistics().failures, box.statistics().written, box.statistics().open) == (1, 1, 0)


def test_a_folder_that_is_none_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(StorageError, match=r"file/sub: cannot hold recordings: Not a directory"):
        black_box(tmp_path / "file" / "sub")


def test_the_garbage_collector_does_not_search_the_records_held(tmp_path: Path) -> None:
    box = black_box(tmp_path)
    feed(box, 0, 1)
    gc.collect()
    # those of other tests need not be counted
    gc.freeze()
    before = len(gc.get_objects())
    hold(box, *(message(k / 1000) for k in range(3000)))
    gc.collect()
    assert box.statistics().held_records == 3001
    assert len(gc.get_objects()) - before < 300
