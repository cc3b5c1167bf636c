"""What goes to disk: a full one costs a recording in one file telemetry, never an alarm event, and it goes on."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from own_records import own_records
from test_monitor_recorder import LAYOUT, Log, estimates
from test_monitor_rotation import message, numbers

from adapters.batch import pack
from monitor.recording.archive import Archive
from monitor.recording.record_encoder import RecordEncoder
from monitor.recording.recorder import Recorder

FULL = """
import json, resource, sys
sys.path.insert(0, sys.argv[2])
from pathlib import Path
from test_monitor_rotation import Log, estimates, event, message, noise
now = 0.0
archive = Log(Path(sys.argv[1]), monotonic=lambda: now)
said = []
def limit(size):
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))
def note():
    counts = archive.statistics()
    said.append([counts.records, counts.lost, counts.trouble])
archive.write(message(0))
archive.flush()
limit(1024)
archive.estimates(estimates(0))
archive.write(noise(1))
archive.event(event(1))
archive.flush()
archive.event(event(2))
note()
for now in (5.0, 11.0):
    archive.write(message(2))
    archive.flush()
note()
limit(resource.RLIM_INFINITY)
now = 22.0
archive.flush()
note()
archive.write(message(3))
archive.estimates(estimates(1))
archive.event(event(3))
archive.close()
note()
print(json.dumps(said))
"""


def test_a_recording_in_one_file_goes_on_when_the_disk_has_room_with_the_alarms_it_missed(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    command = [sys.executable, "-c", FULL, path, Path(__file__).parent]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    stopped = f"recording stopped: [Errno 27] File too large: '{path}'"
    # ten taken, of which telemetry, sample and estimate are lost and the alarms wait
    assert json.loads(done.stdout) == [[10, 3, stopped], [12, 5, stopped], [12, 5, None], [18, 5, None]]
    assert numbers(path) == [0, 3]
    records = own_records([path])
    assert [json.loads(data)["seq"] for data in records["/fauio/alarm_json"]] == [1, 2, 3]
    assert {topic: len(found) for topic, found in records.items()} == {
        "/fauio/alarm": 3,
        "/fauio/alarm_json": 3,
        "/fauio/log": 3,
        "/fauio/motors/sample": 1,
        "/fauio/motors/estimate": 1,
    }


def test_what_is_held_until_the_flush_is_recorded_as_what_is_encoded_at_once(tmp_path: Path) -> None:
    encoder = RecordEncoder([LAYOUT])
    held = Archive(encoder, Recorder(tmp_path / "held.mcap", encoder.topics, {}, {}))
    with Log(tmp_path / "at_once.mcap") as at_once:
        for number in range(20):
            for archive in (held, at_once):
                archive.batch(pack([message(number)]))
                archive.estimates(estimates(2 * number, 2))
                at_once.encode()
                if number % 7 == 6:
                    archive.flush()
    held.close()
    assert numbers(tmp_path / "held.mcap") == numbers(tmp_path / "at_once.mcap") == [*range(20)]
    assert own_records([tmp_path / "held.mcap"]) == own_records([tmp_path / "at_once.mcap"])
