"""Recording for weeks: files follow each other without a gap, within a budget, and a sick disk is survived."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from loopback import START_NS, event, until
from mcap.reader import make_reader
from own_records import own_records
from test_monitor_recorder import Log, estimates

from adapters.errors import StorageError
from adapters.logs.mcap_reader import MessageLogReader, read_mcap_metadata
from adapters.logs.recordings import read_batches, read_recording, recording_kind
from adapters.message import Message
from adapters.source import ZENOH
from monitor.estimate import Estimates
from monitor.pipeline import Pipeline
from monitor.profile import Profile
from monitor.recording.recorder import RETRY_S
from monitor.recording.retention import FileSeries, Together
from replay.player import play

SECOND = 1_000_000_000
NAME = re.compile(r"copter-1-\d{8}T\d{6}Z-\d{6}\.mcap")


def message(number: int, at_ns: int | None = None) -> Message:
    return Message(ZENOH, "k", START_NS + number * SECOND if at_ns is None else at_ns, {"n": number})


def noise(number: int, size: int = 20_000) -> Message:
    """Return a message that no compression makes smaller."""
    text = random.Random(number).randbytes(size // 2).hex()
    return Message(ZENOH, "k", START_NS + number * SECOND, {"n": number, "text": text})


def recorder(folder: Path, monotonic: Callable[[], float] = time.monotonic, **limits: Any) -> Log:
    series = FileSeries(folder, "copter-1", **limits)
    return Log(series, metadata={"fauio": "1"}, files={"profile.toml": b"x = 1"}, monotonic=monotonic)


def files(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.mcap"))


def numbers(path: Path) -> list[int]:
    return [found.fields["n"] for found in read_recording(path)]


def test_a_new_file_begins_after_so_much_telemetry_time(tmp_path: Path) -> None:
    with recorder(tmp_path, file_s=10.0) as log:
        for number in range(35):
            log.write(message(number))
    assert [numbers(path) for path in files(tmp_path)] == [
        [*range(10)],
        [*range(10, 20)],
        [*range(20, 30)],
        [*range(30, 35)],
    ]
    assert files(tmp_path)[0].name == "copter-1-20261121T090517Z-000000.mcap"
    assert numbers(tmp_path) == [*range(35)]
    assert log.counts().files == 4


@pytest.mark.parametrize("limits", [{"file_s": 10.0}, {"file_bytes": 200_000, "budget_bytes": 10_000_000}])
def test_files_end_at_the_same_records_however_batches_are_cut(tmp_path: Path, limits: dict[str, Any]) -> None:
    with recorder(tmp_path / "few", **limits) as few, recorder(tmp_path / "many", **limits) as many:
        for number in range(100):
            few.write(noise(number, 10_000))
        for start in range(0, 100, 37):
            many.write(*(noise(number, 10_000) for number in range(start, min(start + 37, 100))))
    expected = [numbers(path) for path in files(tmp_path / "few")]
    assert len(expected) > 3
    assert [numbers(path) for path in files(tmp_path / "many")] == expected


def test_each_file_is_complete_in_itself(tmp_path: Path) -> None:
    with recorder(tmp_path, file_s=2.0) as log:
        for number in range(4):
            log.write(message(number))
            log.estimates(estimates(number))
            log.event(event(number))
            log.add_metadata({"fauio": "2"})
    assert len(files(tmp_path)) == 2
    for path in files(tmp_path):
        assert read_mcap_metadata(path)["fauio"] == {"fauio": "2"}
        with path.open("rb") as stream:
            reader = make_reader(stream, validate_crcs=True)
            assert [found.data for found in reader.iter_attachments()] == [b"x = 1"]
            topics = {channel.topic for _, channel, _ in reader.iter_messages()}
        assert topics == {
            "/zenoh/k",
            "/fauio/motors/sample",
            "/fauio/motors/estimate",
            "/fauio/alarm",
            "/fauio/alarm_json",
            "/fauio/log",
        }


def test_what_the_monitor_stamps_with_the_vehicles_clock_begins_no_file(tmp_path: Path) -> None:
    with recorder(tmp_path, file_s=10.0) as log:
        for number in range(20):
            log.write(message(0))
            log.event(event(number, time_ns=START_NS + number * 3600 * SECOND))
    assert len(files(tmp_path)) == 1


def test_a_file_that_begins_with_a_record_of_the_monitor_is_named_by_the_last_telemetry(tmp_path: Path) -> None:
    with recorder(tmp_path, file_bytes=20_000, budget_bytes=10_000_000) as log:
        log.write(noise(0, 18_000))
        log.event(event(1, time_ns=2**62, message="x" * 18_000))
    assert [path.name.split("-")[2] for path in files(tmp_path)] == ["20261121T090517Z"] * len(files(tmp_path))
    assert len(files(tmp_path)) > 1


def test_files_stay_in_order_when_the_clock_is_set_back_and_after_a_restart(tmp_path: Path) -> None:
    with recorder(tmp_path, file_s=10.0) as log:
        for number, hour in enumerate((1, 0, 2, 2)):
            log.write(message(number, START_NS + hour * 3600 * SECOND))
    with recorder(tmp_path) as log:
        log.write(message(4, START_NS))
    assert numbers(tmp_path) == [0, 1, 2, 3, 4]
    assert len(files(tmp_path)) == 4
    assert all(NAME.fullmatch(path.name) for path in files(tmp_path))


def test_the_oldest_go_so_that_all_stay_within_the_budget_and_foreign_files_stay(tmp_path: Path) -> None:
    foreign = [tmp_path / name for name in ("copter-1-notes.mcap", "copter-10-20200101T000000Z-000000.mcap", "a.txt")]
    for path in foreign:
        path.write_bytes(b"x" * 300_000)

    def total() -> int:
        with contextlib.suppress(FileNotFoundError):
            return sum(path.stat().st_size for path in files(tmp_path) if NAME.fullmatch(path.name))
        return 1 << 60

    with recorder(tmp_path, file_bytes=200_000, budget_bytes=700_000) as log:
        for number in range(100):
            log.write(noise(number))
            log.flush()
            until(lambda: total() <= 700_000)
            assert log.counts().path in files(tmp_path)
    own = [path for path in files(tmp_path) if NAME.fullmatch(path.name)]
    assert all(path.stat().st_size <= 200_000 for path in own)
    assert len(own) >= 3
    assert all(path.exists() for path in foreign)
    assert 0 < len(own) < log.counts().files
    kept = [number for path in own for number in numbers(path)]
    assert kept == [*range(kept[0], 100)]


def test_files_of_vehicles_that_are_gone_go_so_that_all_vehicles_stay_within_their_budget(tmp_path: Path) -> None:
    def old(vehicle: str, number: int) -> Path:
        path = tmp_path / vehicle / f"{vehicle}-20200101T000000Z-{number:06}.mcap"
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(b"x" * 300_000)
        os.utime(path, (number, number))
        return path

    other, gone, younger = old("copter-2", 0), old("copter-3", 1), old("copter-3", 2)
    notes = tmp_path / "copter-3" / "notes.mcap"
    notes.write_bytes(b"x" * 300_000)
    together = Together(1_150_000, {"copter-1", "copter-2"})
    with recorder(tmp_path / "copter-1", file_bytes=150_000, budget_bytes=500_000, together=together) as log:
        log.write(noise(0))
        log.flush()
        until(lambda: not gone.exists())
    assert all(path.exists() for path in (other, younger, notes))


def test_a_record_larger_than_a_file_gets_one_of_its_own(tmp_path: Path) -> None:
    with recorder(tmp_path, file_bytes=10_000, budget_bytes=10_000_000) as log:
        for number in range(5):
            log.write(noise(number, 50_000))
    assert [len(numbers(path)) for path in files(tmp_path)] == [1] * 5


def test_a_budget_of_less_than_two_files_and_a_folder_that_is_none_are_one_line(tmp_path: Path) -> None:
    with pytest.raises(StorageError, match=r"budget of 100 bytes is less than two files of 90 bytes; raise"):
        recorder(tmp_path, file_bytes=90, budget_bytes=100)
    (tmp_path / "file").touch()
    with pytest.raises(StorageError, match=r"file/sub: cannot hold recordings: Not a directory"):
        recorder(tmp_path / "file" / "sub")


def test_a_name_no_file_can_have_is_made_one(tmp_path: Path) -> None:
    with Log(FileSeries(tmp_path, "fleet/copter 1")) as log:
        log.write(message(0))
    assert recording_kind(tmp_path) == "mcap"
    assert files(tmp_path)[0].name.startswith("fleet_copter_1-2026")


def test_a_rotated_session_replays_to_the_same_events_as_one_file(
    quad_profile: Profile, data: Path, tmp_path: Path
) -> None:
    pipeline = Pipeline(quad_profile)
    expected = []
    series = FileSeries(tmp_path, "copter-1", file_s=4.0)
    with Log(series, pipeline.layouts, pipeline.metadata(), quad_profile.files) as log:
        for batch in read_batches(data / "copter_motor2_080.tlog.xz", count=100):
            log.batch(batch)
            for output in pipeline.run(batch):
                if isinstance(output, Estimates):
                    log.estimates(output)
                else:
                    log.event(output)
                    expected.append(output)
    assert len(files(tmp_path)) >= 3
    assert expected
    assert list(play(quad_profile, read_recording(tmp_path)).events) == expected


FULL_DISK = """
import json, resource, signal, sys
sys.path.insert(0, sys.argv[2])
from pathlib import Path
from test_monitor_rotation import message, noise, recorder
now = 0.0
with recorder(Path(sys.argv[1]), monotonic=lambda: now) as log:
    for number in range(50):
        log.write(noise(number))
        log.flush()
    # real files refuse what goes beyond this, half-way through a write, as those of a full disk do
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (log.counts().path.stat().st_size + 8000, resource.RLIM_INFINITY))
    for number in range(50, 60):
        log.write(noise(number))
        log.flush()
    broken = log.counts()
    resource.setrlimit(resource.RLIMIT_FSIZE, (10, resource.RLIM_INFINITY))
    now = 10.5
    for number in range(60, 70):
        log.write(noise(number))
        log.flush()
    again = log.counts()
    files = len(list(Path(sys.argv[1]).iterdir()))
    resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    log.write(noise(70))
    now = 30.0
    for number in range(71, 80):
        log.write(noise(number))
found = log.counts()
print(json.dumps([broken.failed, broken.dropped, broken.failures, again.dropped, again.failures, files,
                  found.failed, found.dropped, found.files, found.records]))
"""


def test_a_full_disk_costs_what_it_cannot_hold_and_recording_goes_on_when_there_is_room(tmp_path: Path) -> None:
    command = [sys.executable, "-c", FULL_DISK, tmp_path / "log", Path(__file__).parent]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    reason, first, failures, second, refused, count, failed, dropped, begun, records = json.loads(done.stdout)
    assert "File too large" in reason
    assert (first, failures) == (10, 1)
    # the file that could not even be begun is not left behind
    assert (second, refused, count) == (20, 2, 1)
    assert (failed, dropped, begun, records) == (None, 21, 2, 80)
    assert numbers(tmp_path / "log") == [*range(50), *range(71, 80)]
    broken, after = (MessageLogReader(path) for path in files(tmp_path / "log"))
    for reader in (broken, after):
        list(reader)
        assert reader.scan.damaged_chunks == 0
        # the summary fits where the chunk did not
        assert reader.scan.stopped_at is None


def test_a_disk_that_refuses_each_write_is_tried_again_every_ten_seconds(tmp_path: Path) -> None:
    now = 0.0
    log = recorder(tmp_path, file_s=1.0, monotonic=lambda: now)
    log.write(message(0))
    shutil.rmtree(tmp_path)
    for number in range(1, 100):
        now = number / 2
        log.write(message(number))
        log.flush()
    assert log.counts().failed is not None
    assert "No such file" in log.counts().failed
    assert log.counts().failures == 1 + int((99 / 2 - 0.5) // RETRY_S)
    assert log.counts().dropped == 99
    tmp_path.mkdir()
    now += RETRY_S
    log.write(message(100))
    log.close()
    assert log.counts().failed is None
    assert numbers(tmp_path) == [100]


def test_a_device_without_space_is_no_error_of_ours(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = recorder(tmp_path)
    monkeypatch.setattr(FileSeries, "next_path", lambda self, time_ns: Path("/dev/full"))
    log.write(message(0))
    log.flush()
    log.add_metadata({"a": "b"})
    log.close()
    assert log.counts().failed == f"[Errno {errno.ENOSPC}] No space left on device: '/dev/full'"
    assert log.counts().dropped == 1
    assert Path("/dev/full").exists()


CRASH = """
import sys
sys.path.insert(0, sys.argv[2])
from pathlib import Path
from test_monitor_rotation import estimates, event, message, recorder
log = recorder(Path(sys.argv[1]), file_s=200.0, file_bytes=100_000)
number = 0
while True:
    for _ in range(20):
        log.write(message(number))
        log.estimates(estimates(number))
        log.event(event(number))
        number += 1
    log.flush()
    print(number, flush=True)
"""


@pytest.mark.parametrize("attempts", [1, pytest.param(4, marks=pytest.mark.long)])
def test_whatever_was_flushed_survives_kills_at_random_moments(tmp_path: Path, attempts: int) -> None:
    moments = random.Random(5)
    folders = [tmp_path / str(attempt) for attempt in range(attempts)]
    children = [
        subprocess.Popen(
            [sys.executable, "-c", CRASH, folder, Path(__file__).parent], stdout=subprocess.PIPE, text=True
        )
        for folder in folders
    ]
    for folder, child in zip(folders, children, strict=True):
        with child:
            assert child.stdout is not None
            first = child.stdout.readline()
            time.sleep(moments.uniform(0.0, 0.3))
            child.send_signal(signal.SIGKILL)
            flushed = int((child.stdout.read().split() or [first])[-1])
        found = numbers(folder)
        assert found == [*range(len(found))]
        assert len(found) >= flushed
        held = [path for path in files(folder) if path.stat().st_size]
        assert len(files(folder)) - len(held) <= 1  # one may be as new as the kill, and hold nothing yet
        for path in held:
            reader = MessageLogReader(path)
            count = len(list(reader))
            assert reader.scan.damaged_chunks == reader.damaged_records == 0
            assert reader.other_records >= 4 * (count - 20)


def test_a_clock_gone_mad_costs_its_records_and_not_the_recording(tmp_path: Path) -> None:
    with recorder(tmp_path, file_s=10.0) as log:
        for at_ns in (-5, 2**64, 2**61, 0, START_NS):
            log.write(message(1, at_ns))
        log.estimates(replace(estimates(0), samples=replace(estimates(0).samples, time_ns=np.array([-1]))))
        log.estimates(estimates(1))
    # two messages, a sample and its estimate
    assert log.statistics().lost == 4
    assert len(numbers(tmp_path)) == 3


OWED = """
import json, resource, sys
sys.path.insert(0, sys.argv[2])
from pathlib import Path
from test_monitor_rotation import event, message, noise, recorder
now = 0.0
log = recorder(Path(sys.argv[1]), monotonic=lambda: now)
def limit(size):
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))
log.write(message(0))
log.event(event(1))
log.flush()
limit(1024)
log.write(noise(1))
log.event(event(2))
log.flush()
log.event(event(3))
now = 11.0
log.flush()
log.write(message(2))
full = log.counts()
limit(resource.RLIM_INFINITY)
if sys.argv[3] == "later":
    now = 22.0
    log.flush()
    log.event(event(4))
log.close()
after = log.counts()
print(json.dumps([full.failures, full.failed, full.dropped, after.failed, after.dropped, after.files]))
"""


@pytest.mark.parametrize("when", ["later", "at the end"])
def test_alarm_events_from_while_the_disk_was_full_are_recorded_once_there_is_room(tmp_path: Path, when: str) -> None:
    command = [sys.executable, "-c", OWED, tmp_path / "log", Path(__file__).parent, when]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    failures, full, dropped, failed, lost, begun = json.loads(done.stdout)
    assert (failures, dropped) == (2, 2)
    assert "File too large" in full
    # the second could be begun, but took no events
    assert (failed, lost, begun) == (None, 2, 3)
    assert len(files(tmp_path / "log")) == 2
    records = own_records(files(tmp_path / "log"))
    expected = [1, 2, 3, 4] if when == "later" else [1, 2, 3]
    assert [json.loads(data)["seq"] for data in records["/fauio/alarm_json"]] == expected
    assert len(records["/fauio/alarm"]) == len(expected)
    assert numbers(tmp_path / "log") == [0]
