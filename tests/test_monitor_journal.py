"""The journal keeps each event exactly once: over kills, full disks, locks and damage, with readers beside it."""

import contextlib
import os
import random
import re
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from loopback import event

from adapters.errors import StorageError
from monitor.recording import journal as module
from monitor.recording.journal import Journal
from monitor.recording.journal_file import APPLICATION_ID, read_connection

TESTS = Path(__file__).parent
ROOT = TESTS.parent


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "journal.db"


@contextlib.contextmanager
def opened(path: Path, max_events: int = 1_000_000) -> Iterator[Journal]:
    with contextlib.closing(Journal(path, max_events)) as journal:
        yield journal


def seqs(journal: Journal) -> list[int]:
    return [event.seq for event in journal.events(limit=1_000_000)]


def test_what_was_written_is_read_back_as_it_was(path: Path) -> None:
    first = event(1, estimate=None, shelved_until_ns=5, state="shelved")
    with opened(path) as journal:
        journal.write(first, {"inputs": {"motor1": 0.5}, "bad": float("nan")})
        journal.write(event(2, "motor2", vehicle="copter-2"))
        assert journal.events() == [first, event(2, "motor2", vehicle="copter-2")]
        assert journal.events("copter-1") == [first]
        assert journal.events(since_ns=first.time_ns + 1) == [event(2, "motor2", vehicle="copter-2")]
        assert journal.events(limit=1) == [event(2, "motor2", vehicle="copter-2")]
        assert journal.frame(first.id) == {"inputs": {"motor1": 0.5}, "bad": None}
        assert journal.frame("another") is None


def test_an_event_given_again_is_there_once_and_another_with_its_number_is_counted(path: Path) -> None:
    with opened(path) as journal:
        for _ in range(3):
            journal.write(event(1))
        journal.write(event(1, message="another"))
        counts = journal.statistics()
        assert journal.events() == [event(1)]
    assert (counts.written, counts.duplicates, counts.conflicts) == (1, 2, 1)
    assert "other content" in (counts.last_error or "")


def test_active_alarms_and_numbers_come_back_after_a_restart(path: Path) -> None:
    with opened(path) as journal:
        journal.write(event(1, "motor1"), {"y": [1]})
        journal.write(event(2, "motor2"))
        journal.write(event(3, "motor1", state="acknowledged", acknowledged=True), {"y": [2]})
        journal.write(event(4, "motor2", state="cleared"))
        journal.write(event(5, "motor3", state="updated", latched=True))
        journal.write(event(6, "motor4", state="shelved", shelved_until_ns=9))
    with opened(path) as journal:
        assert [(event.channel, event.seq) for event in journal.active("copter-1")] == [
            ("motor1", 3),
            ("motor3", 5),
            ("motor4", 6),
        ]
        assert (journal.last_seq("copter-1"), journal.last_seq("copter-2")) == (6, 0)
        assert journal.frame("01J-motor1") == {"y": [1]}


EVENTS = st.builds(
    lambda seq, alarm, state, vehicle: event(seq, id=f"alarm-{alarm}", state=state, vehicle=vehicle),
    st.integers(1, 12),
    st.integers(1, 3),
    st.sampled_from(["raised", "updated", "acknowledged", "shelved", "cleared"]),
    st.sampled_from(["copter-1", "copter-2"]),
)


@given(given_events=st.lists(EVENTS, max_size=25))
def test_any_sequence_of_events_gives_the_active_set_of_a_dictionary(
    tmp_path_factory: pytest.TempPathFactory, given_events: list[module.AlarmEvent]
) -> None:
    kept: dict[tuple[str, int], module.AlarmEvent] = {}
    latest: dict[tuple[str, str], module.AlarmEvent] = {}
    with opened(tmp_path_factory.mktemp("model") / "journal.db") as journal:
        for one in given_events:
            journal.write(one)
            if kept.setdefault((one.vehicle, one.seq), one) is one:
                known = latest.get((one.vehicle, one.id))
                latest[one.vehicle, one.id] = one if known is None or one.seq > known.seq else known
        for vehicle in ("copter-1", "copter-2"):
            standing = [one for one in latest.values() if one.vehicle == vehicle and one.state != "cleared"]
            assert journal.active(vehicle) == sorted(standing, key=lambda one: one.seq)
            assert journal.last_seq(vehicle) == max((seq for name, seq in kept if name == vehicle), default=0)
        assert journal.events() == list(kept.values())


def test_every_event_reported_before_kill_9_is_there_exactly_once(path: Path) -> None:
    generator = random.Random(5)
    reported: set[int] = set()
    environment = os.environ | {"PYTHONPATH": f"{ROOT}{os.pathsep}{TESTS}"}
    for _ in range(3):
        with subprocess.Popen(
            [sys.executable, str(TESTS / "journal_writer.py"), str(path)],
            stdout=subprocess.PIPE,
            text=True,
            env=environment,
        ) as writer:
            assert writer.stdout is not None
            reported.add(int(writer.stdout.readline()))
            time.sleep(generator.uniform(0.0, 0.1))
            writer.send_signal(signal.SIGKILL)
            reported.update(int(line) for line in writer.stdout if line.endswith("\n"))
    with opened(path) as journal:
        assert journal.set_aside is None
        present = seqs(journal)
        assert present == list(range(1, len(present) + 1))
        assert reported <= set(present)
        assert len(present) - max(reported) <= 1
        assert journal.last_seq("copter-1") == len(present)


def test_with_a_full_disk_events_wait_in_order_and_are_written_when_there_is_room(path: Path) -> None:
    with opened(path) as journal:
        connection = journal._connection
        assert connection is not None
        pages = connection.execute("PRAGMA page_count").fetchone()[0]
        connection.execute(f"PRAGMA max_page_count = {pages + 2}")
        for seq in range(1, 101):
            journal.write(event(seq))
        counts = journal.statistics()
        assert 0 < counts.written < 100
        assert counts.written + counts.pending == 100
        assert "full" in (counts.last_error or "")
        assert seqs(journal) == list(range(1, counts.written + 1))
        assert journal.retry() == counts.pending
        connection.execute(f"PRAGMA max_page_count = {pages + 1000}")
        assert journal.retry() == 0
        assert seqs(journal) == list(range(1, 101))


FILE_LIMIT = """
import resource, sys
from loopback import event
from monitor.recording.journal import Journal
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]), resource.RLIM_INFINITY))
journal = Journal(sys.argv[1])
for seq in range(1, 301):
    journal.write(event(seq))
before = journal.statistics()
assert before.pending > 0 and before.written + before.pending == 300, before
resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
while journal.retry():
    pass
journal.close()
print(before.written)
"""


@pytest.mark.parametrize("limit", [0, 50_000, 200_000])
def test_writes_that_the_operating_system_refuses_are_made_up_for_later(path: Path, limit: int) -> None:
    environment = os.environ | {"PYTHONPATH": f"{ROOT}{os.pathsep}{TESTS}"}
    command = [sys.executable, "-c", FILE_LIMIT, str(path), str(limit)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    with opened(path) as journal:
        assert journal.set_aside is None
        assert seqs(journal) == list(range(1, 301))


def test_what_waits_is_bounded_and_the_oldest_go_first(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_PENDING", 5)
    with opened(path) as journal, contextlib.closing(sqlite3.connect(path, isolation_level=None)) as other:
        other.execute("BEGIN EXCLUSIVE")
        for seq in range(1, 9):
            journal.write(event(seq))
        counts = journal.statistics()
        assert (counts.pending, counts.dropped) == (5, 3)
        assert "locked" in (counts.last_error or "")
        other.execute("ROLLBACK")
        assert journal.retry() == 0
        assert seqs(journal) == [4, 5, 6, 7, 8]


def test_closing_writes_what_still_waits(path: Path) -> None:
    journal = Journal(path)
    with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as other:
        other.execute("BEGIN EXCLUSIVE")
        for seq in range(1, 500):
            journal.write(event(seq))
        other.execute("ROLLBACK")
    journal.close()
    journal.close()
    journal.write(event(500))
    assert journal.statistics().pending == 1
    assert len(journal.events()) == 499


def test_a_journal_that_is_locked_at_the_start_is_opened_later(path: Path) -> None:
    Journal(path).close()
    with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as other:
        other.execute("PRAGMA locking_mode = EXCLUSIVE")
        other.execute("BEGIN EXCLUSIVE")
        journal = Journal(path)
        journal.write(event(1))
        with pytest.raises(OSError, match="journal cannot be read"):
            journal.events()
        assert journal.retry() == 1
        assert not journal.statistics().open
    assert journal.retry() == 0
    assert journal.statistics().open
    assert seqs(journal) == [1]
    journal.close()


def test_readers_in_other_threads_see_whole_events_in_order_and_stop_no_writer(path: Path) -> None:
    failures: list[BaseException] = []
    stop = threading.Event()

    def read(journal: Journal) -> None:
        try:
            last = 0
            while not stop.is_set():
                present = seqs(journal)
                assert present == list(range(1, len(present) + 1))
                assert len(present) >= last
                last = len(present)
                assert len(journal.active("copter-1")) <= 1
        except BaseException as error:
            failures.append(error)

    with opened(path) as journal:
        readers = [threading.Thread(target=read, args=(journal,)) for _ in range(2)]
        for reader in readers:
            reader.start()
        for seq in range(1, 61):
            journal.write(event(seq))
        stop.set()
        for reader in readers:
            reader.join()
        counts = journal.statistics()
    assert failures == []
    assert (counts.written, counts.pending, counts.last_error) == (60, 0, None)


def test_beyond_the_bound_the_oldest_go_but_an_alarm_that_stands_stays_with_its_frame(path: Path) -> None:
    with opened(path, max_events=50) as journal:
        journal.write(event(1, "standing"), {"y": [1]})
        for seq in range(2, 302):
            journal.write(event(seq, id=f"alarm-{seq // 2}", state=("raised", "cleared")[seq % 2]), {"y": [seq]})
        assert seqs(journal) == [1, *range(253, 302)]
        assert journal.statistics().pruned == 251
        assert [one.channel for one in journal.active("copter-1")] == ["standing"]
        assert journal.frame("01J-standing") == {"y": [1]}
        assert journal.frame("alarm-1") is None
        assert journal.frame("alarm-150") == {"y": [300]}
    with opened(path, max_events=40) as journal:
        journal.write(event(302, "other", state="cleared"))
        assert seqs(journal) == [1, *range(264, 303)]
        assert journal.last_seq("copter-1") == 302


def test_events_and_frames_that_no_row_can_hold_are_counted(path: Path) -> None:
    with opened(path) as journal:
        journal.write(event(1 << 70))
        journal.write(event(1, time_ns=1 << 70, message="\udcff"), {"array": object()})
        journal.write(event(2), {"large": "x" * module.MAX_FRAME_BYTES})
        nested: list[object] = []
        nested.append(nested)
        journal.write(event(3), {"endless": nested})
        assert seqs(journal) == [1, 2, 3]
        assert journal.statistics().rejected == 4
        assert journal.frame("01J-motor1") is None


def damage(path: Path, how: str) -> None:
    content = bytearray(path.read_bytes())
    if how == "truncated":
        content = content[:5000]
    elif how == "header cut":
        content = content[:40]
    elif how == "zeros":
        content = bytearray(len(content))
    else:
        content[4096:] = random.Random(1).randbytes(len(content) - 4096)
    path.write_bytes(content)


@pytest.mark.parametrize("how", ["truncated", "header cut", "zeros", "random pages"])
def test_a_damaged_journal_is_set_aside_and_a_new_one_begun(path: Path, how: str) -> None:
    with opened(path) as journal:
        for seq in range(1, 100):
            journal.write(event(seq))
    damage(path, how)
    damaged = path.read_bytes()
    with opened(path) as journal:
        assert journal.set_aside is not None
        assert journal.set_aside.name.startswith("journal.db.damaged-")
        assert journal.set_aside.read_bytes() == damaged
        assert "set aside" in (journal.statistics().last_error or "")
        journal.write(event(1))
        assert seqs(journal) == [1]
    with opened(path) as journal:
        assert journal.set_aside is None


@pytest.mark.parametrize("left", [0, 100, 16384])
def test_an_index_that_another_program_cut_is_made_anew(path: Path, left: int) -> None:
    with opened(path) as journal:
        journal.write(event(1))
        journal.retry()
        os.truncate(f"{path}-shm", left)
        journal.retry()
        journal.write(event(2))
        assert seqs(journal) == [1, 2]
    with opened(path) as journal:
        assert seqs(journal) == [1, 2]


@pytest.mark.parametrize("endings", [("",), ("", "-wal"), ("", "-wal", "-shm")])
def test_another_journal_is_begun_where_the_open_one_is_moved_away(
    path: Path, endings: tuple[str, ...], caplog: pytest.LogCaptureFixture
) -> None:
    with opened(path) as journal:
        journal.write(event(1))
        for ending in endings:
            Path(f"{path}{ending}").rename(f"{path}.old{ending}")
        journal.retry()
        assert "was deleted or moved away: another one is begun" in caplog.text
        journal.write(event(2))
        assert seqs(journal) == [2]
    with opened(path) as journal:
        assert seqs(journal) == [2]


def test_an_event_that_a_disk_has_changed_does_not_hide_the_others(path: Path) -> None:
    with opened(path) as journal:
        journal.write(event(1, "motor1"))
        journal.write(event(2, "motor2"))
        with contextlib.closing(sqlite3.connect(path)) as other:
            other.execute("UPDATE event SET body = CAST(x'7bff' AS TEXT) WHERE seq = 1")
            other.commit()
        assert seqs(journal) == [2]
        assert "cannot be read" in (journal.statistics().last_error or "")


def test_what_can_be_no_journal_is_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "flight.tlog").write_bytes(b"\xfd\x09 telemetry")
    with contextlib.closing(sqlite3.connect(tmp_path / "other.db")) as other:
        other.execute("CREATE TABLE theirs (x)")
        other.commit()
    Journal(tmp_path / "newer.db").close()
    with contextlib.closing(sqlite3.connect(tmp_path / "newer.db")) as newer:
        newer.execute("PRAGMA user_version = 2")
    complaints = {
        "flight.tlog": "no database",
        "other.db": "another program",
        "newer.db": "newer fauio",
        "absent/journal.db": "create it",
        "": "is a folder",
    }
    before = (tmp_path / "flight.tlog").read_bytes()
    for name, complaint in complaints.items():
        with pytest.raises(StorageError, match=complaint) as refused:
            Journal(tmp_path / name)
        assert "\n" not in str(refused.value)
        assert str(tmp_path / name) in str(refused.value)
    assert (tmp_path / "flight.tlog").read_bytes() == before


def test_a_journal_that_may_not_be_written_is_refused_in_one_line() -> None:
    with pytest.raises(StorageError, match=r"^/proc/self/journal\.db: cannot be written as journal: unable to open"):
        Journal("/proc/self/journal.db")


def test_the_queries_of_the_operations_page_run(path: Path) -> None:
    page = (ROOT / "docs/operations.md").read_text()
    queries = re.findall(r"```sql\n(.*?)```", page, re.DOTALL)
    assert f"`PRAGMA application_id` is {APPLICATION_ID}," in page
    with opened(path) as journal, contextlib.closing(read_connection(path)) as reader:
        journal.write(event(1), {"y": [1]})
        journal.write(event(2))
        assert [len(reader.execute(query).fetchall()) for query in queries] == [2, 1, 1]


def test_every_commit_waits_for_the_disk(path: Path) -> None:
    with opened(path) as journal:
        assert journal._connection is not None
        # 2 is FULL: a power cut takes no event that was published
        assert journal._connection.execute("PRAGMA synchronous").fetchone() == (2,)


def test_events_of_one_moment_are_one_transaction_and_wait_together(path: Path) -> None:
    with opened(path) as journal:
        journal.write_all([(event(seq), None) for seq in range(1, 11)])
        assert [one.seq for one in journal.events()] == list(range(1, 11))
        assert journal.statistics().written == 10


def test_the_write_ahead_log_stays_bounded(path: Path) -> None:
    with opened(path) as journal:
        for seq in range(1, 601):
            journal.write(event(seq, message="x" * 500), {"y": [0.1] * 50})
        assert Path(f"{path}-wal").stat().st_size < 2 * 1000 * 4200
    assert not Path(f"{path}-wal").exists()


def test_beside_a_reader_that_holds_a_transaction_the_log_stays_bounded_and_no_event_is_lost(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("monitor.recording.journal_file.WAL_BYTES", 200_000)
    with opened(path) as journal:
        journal.write(event(1))
        with contextlib.closing(read_connection(path)) as reader:
            reader.execute("BEGIN")
            assert reader.execute("SELECT count(*) FROM event").fetchone() == (1,)
            for seq in range(2, 61):
                journal.write(event(seq))
            waiting = journal.statistics()
            assert 0 < waiting.pending < 59
            assert "reads it" in str(waiting.last_error)
            assert Path(f"{path}-wal").stat().st_size < 300_000
            assert sum(map(bool, Path(f"{path}-later").read_bytes().splitlines())) == waiting.pending
            # After a kill all are there, though the other still reads.
            with opened(path) as other:
                assert seqs(other) == list(range(1, 61))
        while journal.retry():
            pass
        assert seqs(journal) == list(range(1, 61))
        assert not Path(f"{path}-later").exists()
        journal.write(event(61))
        assert journal.statistics().pending == 0


def test_what_another_process_locks_out_is_on_the_disk_all_the_same(path: Path) -> None:
    with opened(path) as journal:
        journal.write(event(1))
    with opened(path) as journal, contextlib.closing(sqlite3.connect(path, isolation_level=None)) as other:
        other.execute("BEGIN IMMEDIATE")
        journal.write(event(2), {"y": [1.0]})
        later = Path(f"{path}-later")
        kept = later.read_bytes()
        # What a power cut leaves of the last line costs that line alone.
        later.write_bytes(kept + kept[:40])
        other.execute("ROLLBACK")
        with opened(path) as restarted:
            assert seqs(restarted) == [1, 2]
            assert restarted.frame("01J-motor1") == {"y": [1.0]}


def test_a_query_that_takes_too_long_is_given_up(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with opened(path) as journal:
        journal.write_all([(event(seq), None) for seq in range(1, 2001)])
        monkeypatch.setattr(module, "LONGEST_QUERY_S", -1.0)
        monkeypatch.setattr(module, "_STEPS", 100)
        with pytest.raises(OSError, match="interrupted"):
            journal.events()
        assert journal.last_seq("copter-1") == 2000


def test_an_event_whose_fields_a_failing_disk_has_changed_is_left_out(path: Path) -> None:
    with opened(path) as journal:
        journal.write(event(1))
        journal.write(event(2))
    with contextlib.closing(sqlite3.connect(path)) as connection, connection:
        connection.execute("UPDATE event SET body = replace(body, '\"seq\":1', '\"seq\":[]')")
    with opened(path) as journal:
        assert journal.events() == [event(2)]
        assert "event that cannot be read" in str(journal.statistics().last_error)


def test_what_operators_have_shelved_is_remembered_as_it_was_last(path: Path) -> None:
    with opened(path) as journal:
        assert journal.shelved("copter-1") == {}
        journal.shelve("copter-1", {"motors/motor1": 5, "motors/motor2": 1 << 70})
        journal.shelve("copter-2", {"motors/motor1": 7})
        journal.shelve("copter-1", {"motors/motor3": 6})
    with opened(path) as journal:
        assert journal.shelved("copter-1") == {"motors/motor3": 6}
        assert journal.shelved("copter-2") == {"motors/motor1": 7}
        journal.shelve("copter-2", {})
        assert journal.shelved("copter-2") == {}


def test_what_is_shelved_while_another_process_locks_the_journal_is_written_afterwards(path: Path) -> None:
    with opened(path) as journal:
        with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as other:
            other.execute("BEGIN IMMEDIATE")
            journal.shelve("copter-1", {"motors/motor1": 5})
            assert "locked" in str(journal.statistics().last_error)
            other.execute("ROLLBACK")
        journal.retry()
        assert journal.shelved("copter-1") == {"motors/motor1": 5}


@pytest.mark.parametrize("damaged", ["", "{", "[1]", "[" * 100_000])
def test_a_damaged_freeze_frame_is_none(tmp_path: Path, damaged: str) -> None:
    journal = Journal(tmp_path / "events.sqlite")
    journal.write(event(1), {"u": {"a": 1.0}})
    assert journal.frame(event(1).id) == {"u": {"a": 1.0}}
    with contextlib.closing(sqlite3.connect(tmp_path / "events.sqlite")) as connection:
        connection.execute("UPDATE alarm SET frame = ?", (damaged,))
        connection.commit()
    assert journal.frame(event(1).id) is None
    journal.close()
