"""Disk work in threads: a disk that hangs costs recordings, not monitoring; what is kept is kept in order."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from loopback import START_NS, event, until

from adapters.batch import memory_bytes, pack
from adapters.message import Message
from adapters.source import MAVLINK
from monitor.pipeline import Pipeline
from monitor.profile import Profile
from monitor.recording import background
from monitor.recording.archive import Archive
from monitor.recording.background import BackgroundArchive, BackgroundJournal, DiskThread, Turn, wait_for
from monitor.recording.journal import Journal
from monitor.recording.record_encoder import RecordEncoder
from monitor.service.vehicle_monitor import VehicleMonitor

HEARTBEATS = pack([Message(MAVLINK, "HEARTBEAT", START_NS + k, {"type": 2, "autopilot": 3}, 1, 1) for k in range(100)])


class Disk:
    """Answers only while it is well."""

    def __init__(self) -> None:
        self.well = threading.Event()
        self.asked = threading.Event()

    def answer(self, *_: object) -> None:
        self.asked.set()
        self.well.wait(30)


@pytest.fixture
def disk() -> Iterator[Disk]:
    one = Disk()
    yield one
    one.well.set()


class SlowJournal(Journal):
    """A journal on such a disk."""

    disk: Disk

    def write_all(self, events: Any) -> None:
        self.disk.answer()
        super().write_all(events)


class SlowRecorder:
    """A recorder on such a disk."""

    def __init__(self, disk: Disk) -> None:
        self.disk = disk
        self.records = 0

    def record(self, records: Any, **_: object) -> None:
        self.disk.answer()
        self.records += len(records)

    def flush(self) -> None:
        self.disk.answer()

    def add_metadata(self, metadata: object) -> None: ...

    def close(self) -> None: ...

    def statistics(self) -> Any:
        from monitor.recording.recorder import RecorderStatistics

        return RecorderStatistics(records=self.records)


def test_jobs_are_done_in_order_and_what_finds_no_room_is_refused(disk: Disk) -> None:
    done: list[int] = []
    thread = DiskThread("test", 10)
    assert thread.put(disk.answer)
    assert all(thread.put(lambda k=k: done.append(k), 5) for k in range(2))  # type: ignore[misc]
    assert not thread.put(lambda: done.append(9), 1)
    assert thread.put(lambda: done.append(2))
    assert not thread.wait(0.01)
    since = time.monotonic()
    assert not thread.wait(10.0)
    assert time.monotonic() - since < 5.0
    disk.well.set()
    until(lambda: thread.wait(1.0))
    assert done == [0, 1, 2]
    assert thread.close(5.0)
    assert not thread.put(disk.answer)


def test_jobs_with_a_size_are_done_when_they_are_waited_for_or_take_half_of_the_room() -> None:
    done: list[int] = []
    thread = DiskThread("test", 10)
    assert thread.put(lambda: done.append(0), 2)
    assert thread.wait(5.0)
    assert thread.put(lambda: done.append(1), 5)
    assert thread.put(lambda: done.append(2), 1)
    until(lambda: len(done) == 3)
    assert thread.close(5.0)


def test_a_job_that_takes_processor_time_does_not_wait_for_the_disk(
    disk: Disk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(background, "_STALLED_S", 0.01)
    thread = DiskThread("test", 10)

    def compute() -> None:
        while time.thread_time() < 0.1:
            pass
        disk.answer()

    thread.put(compute)
    assert disk.asked.wait(30)
    assert thread.stalled_s == 0.0
    monkeypatch.setattr(background, "_BUSY", 1.0)
    assert thread.stalled_s > 0.01
    disk.well.set()
    assert thread.close(5.0)


def test_threads_that_share_a_turn_write_one_at_a_time_and_say_that_they_wait(
    disk: Disk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(background, "_STALLED_S", 0.01)
    turn = Turn()
    first, second = DiskThread("first", 10, turn), DiskThread("second", 10, turn)
    first.put(disk.answer)
    until(lambda: first.stalled_s > 0.0)
    second.put(lambda: None)
    assert not second.wait(0.05)
    assert second.stalled_s > 0.0
    disk.well.set()
    until(lambda: second.wait(1.0))
    assert second.stalled_s == 0.0
    assert first.close(5.0)
    assert second.close(5.0)


def test_a_job_that_fails_is_logged_and_the_next_is_done(caplog: pytest.LogCaptureFixture) -> None:
    thread = DiskThread("test", 10)
    thread.put(lambda: 1 / 0)
    assert thread.wait(5.0)
    assert "test failed" in caplog.text
    assert thread.close(5.0)


def test_a_disk_that_hangs_delays_an_alarm_once_and_by_a_moment_and_loses_rows_not_events(
    disk: Disk, quad_profile: Profile, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(background, "_STALLED_S", 0.01)
    monkeypatch.setattr(background, "HELD_BYTES", 1000 * memory_bytes(HEARTBEATS) // 100)
    pipeline = Pipeline(quad_profile, "copter-1", 1)
    recorder = SlowRecorder(disk)
    encoder = RecordEncoder(pipeline.layouts)
    archive = BackgroundArchive(Archive(encoder, recorder), "copter-1")  # type: ignore[arg-type]
    slow = SlowJournal(tmp_path / "journal.db")
    slow.disk = disk
    journal = BackgroundJournal(slow)
    patience_s = 0.3
    published: list[Any] = []
    monitor = VehicleMonitor(
        pipeline, (archive,), journal, published.append, START_NS, lambda: wait_for([archive, journal], patience_s)
    )
    outlet: Any = type(
        "Outlet", (), {"event": lambda *_: None, "estimates": lambda *_: None, "close": lambda _: None}
    )()
    monitor.activate(outlet, START_NS)
    since = time.monotonic()
    for k in range(20):
        monitor.process(HEARTBEATS)
        monitor.flush()
        monitor._publish([event(k + 1, f"motor{k}")])
    # less than if each of the alarms had waited
    assert time.monotonic() - since < 20 * patience_s
    assert len(published) == 20
    assert disk.asked.is_set()
    until(lambda: journal.statistics().pending > 0)
    until(lambda: "not answered" in (archive.statistics().trouble or ""))
    assert archive.statistics().lost == 900
    disk.well.set()
    until(lambda: wait_for([archive, journal], 1.0))
    assert [one.seq for one in journal.events("copter-1")] == list(range(1, 21))
    until(lambda: archive.statistics().trouble is None)
    # what began the monitor, heartbeats, and three records of each event
    assert recorder.records == 1101 + 3 * 20
    archive.close({})
    journal.close()


def test_events_are_on_the_disk_when_the_wait_for_it_is_over(tmp_path: Path) -> None:
    journal = BackgroundJournal(Journal(tmp_path / "journal.db"))
    for seq in range(1, 101):
        journal.write(event(seq))
        assert journal.wait(10.0)
        assert [one.seq for one in journal.events(limit=1)] == [seq]
    journal.shelve("copter-1", {"motors/motor1": START_NS})
    journal.retry()
    assert journal.wait(10.0)
    assert journal.shelved("copter-1") == {"motors/motor1": START_NS}
    assert journal.statistics().written == 100
    journal.close()
