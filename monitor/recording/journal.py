"""The journal: every alarm event exactly once, on disk before it is published, even if the process is killed.

An SQLite database in WAL mode, whose every commit waits for the disk (``synchronous = FULL``): what
:meth:`Journal.write` has committed survives ``kill -9`` and a power cut.
"""

import contextlib
import functools
import json
import logging
import math
import os
import sqlite3
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

from adapters.errors import StorageError
from monitor.bus.payload import to_json
from monitor.event import AlarmEvent, valid_event
from monitor.recording.journal_file import DamagedError, has_room, open_database, read_connection, set_aside

PRUNED_AT_ONCE = 64
"""Most events deleted with each new one. Any number above 1 brings a journal back within its bound; 64 take 0.25 ms
(measured), for which an alarm can wait."""
LARGEST = (1 << 63) - 1
"""SQLite's largest integer."""

_INSERT = """
INSERT INTO event (vehicle, seq, alarm, time_ns, body) VALUES (?, ?, ?, ?, ?) ON CONFLICT (vehicle, seq) DO NOTHING
"""
_NOTE_ALARM = """
INSERT INTO alarm (id, vehicle, seq, latest, standing, frame) VALUES (?, ?, ?, ?, ?, ?)
ON CONFLICT (id, vehicle) DO UPDATE SET
    latest = iif(excluded.seq > seq, excluded.latest, latest),
    standing = iif(excluded.seq > seq, excluded.standing, standing),
    seq = max(seq, excluded.seq),
    frame = coalesce(frame, excluded.frame)
"""
_NOTE_VEHICLE = """
INSERT INTO vehicle (name, last_seq) VALUES (?, ?)
ON CONFLICT (name) DO UPDATE SET last_seq = max(last_seq, excluded.last_seq)
"""
_OLDEST = """
SELECT number FROM event WHERE number NOT IN (SELECT latest FROM alarm WHERE standing = 1) ORDER BY number LIMIT ?
"""


@dataclass(frozen=True, slots=True)
class JournalRow:
    """An event as the tables hold it."""

    vehicle: str
    seq: int
    alarm: str
    time_ns: int
    active: bool
    body: str
    frame: str | None


def insert(connection: sqlite3.Connection, row: JournalRow) -> str:
    """Write one row unless it is there; return ``"written"``, ``"duplicates"`` or ``"conflicts"``."""
    cursor = connection.execute(_INSERT, (row.vehicle, row.seq, row.alarm, row.time_ns, row.body))
    if cursor.rowcount == 0:
        there = connection.execute("SELECT body FROM event WHERE vehicle = ? AND seq = ?", (row.vehicle, row.seq))
        return "duplicates" if there.fetchone()[0] == row.body else "conflicts"
    connection.execute(_NOTE_ALARM, (row.alarm, row.vehicle, row.seq, cursor.lastrowid, int(row.active), row.frame))
    connection.execute(_NOTE_VEHICLE, (row.vehicle, row.seq))
    return "written"


def prune(connection: sqlite3.Connection, excess: int) -> int:
    """Delete some of the oldest events, and cleared alarms without events; return how many events."""
    if excess <= 0:
        return 0
    numbers = connection.execute(_OLDEST, (min(excess, PRUNED_AT_ONCE),)).fetchall()
    if not numbers:
        return 0
    connection.executemany("DELETE FROM event WHERE number = ?", numbers)
    connection.execute("DELETE FROM alarm WHERE standing = 0 AND latest <= ?", numbers[-1])
    return len(numbers)


def shelve(connection: sqlite3.Connection, vehicle: str, channels: Mapping[str, int]) -> None:
    """Replace a vehicle's shelved channels by these, with the Unix times until which they are shelved."""
    connection.execute("DELETE FROM shelved WHERE vehicle = ?", (vehicle,))
    connection.executemany(
        "INSERT INTO shelved (vehicle, channel, until_ns) VALUES (?, ?, ?)",
        [(vehicle, plain(channel), bounded(until_ns)) for channel, until_ns in channels.items()],
    )


def plain(text: str) -> str:
    """Return a text without lone surrogates, which UTF-8 and so SQLite cannot hold."""
    return text.encode(errors="backslashreplace").decode()


def bounded(number: int) -> int:
    """Return the number cut to 64 bits."""
    return max(-LARGEST, min(number, LARGEST))


MAX_PENDING = 10_000
"""Most events that wait for the disk. Chosen: a night of alarms on a full disk, in 8 MB of memory."""
MAX_FRAME_BYTES = 1 << 15
"""Largest freeze frame. Chosen: that of a copter with two observers has 4.3 kB, so there is room for plants with
hundreds of channels."""
MAX_ANSWER = 100_000
"""Most events that one query returns: some 40 MB of JSON."""
LONGEST_QUERY_S = 2.0
"""Time after which a query for past events is given up. Chosen: a hundred times that of the largest answer."""
_STEPS = 10_000
"""Steps of SQLite's virtual machine between two looks at the clock: about a millisecond."""
LATER_BYTES = 1 << 26
"""Largest file of rows that the database does not take at present. Chosen: :data:`MAX_PENDING` events with their
frames."""
RETRIED_AT_ONCE = 200
"""Events of one transaction of a retry. Chosen: 200 take 2 to 6 ms (measured), which the monitoring loop can spare."""

_FULL_S = 1.0
"""Pause after which a write-ahead log without room is looked at again: that of retries."""

_ACTIVE = """
SELECT body FROM alarm JOIN event ON event.number = alarm.latest
WHERE alarm.standing = 1 AND alarm.vehicle = ? ORDER BY alarm.seq
"""
_EVENTS = """
SELECT number, body FROM event WHERE {} time_ns >= ? ORDER BY time_ns DESC, number DESC LIMIT ?
"""


@dataclass(frozen=True, slots=True)
class JournalStatistics:
    """Counts of a journal since it was opened."""

    written: int = 0
    duplicates: int = 0  # events given again, which are not written again
    conflicts: int = 0  # events not written because another event has their vehicle and number
    # events and freeze frames that no row can hold: numbers beyond 64 bits, frames that are not JSON or too large
    rejected: int = 0
    pending: int = 0  # events in memory that wait for the disk
    dropped: int = 0  # events lost because too many were waiting
    pruned: int = 0  # old events deleted to keep the bound
    # whether the file is open; if it is not, every :meth:`Journal.retry` tries to open it
    open: bool = True
    last_error: str | None = None  # the last error, kept after it has passed


class Journal:
    """Append-only journal of alarm events with one writer in this process and readers in any thread.

    No trouble of the disk raises from :meth:`write`, :meth:`retry` or :meth:`close`: events wait in
    memory, in order, until :meth:`retry` (called once a second) can write them, and in the file ``<path>-later`` beside
    the database, which the next start reads. So nothing is lost while another program locks the database, or holds a
    read transaction, which keeps SQLite from giving back its write-ahead log: beyond 32 MB of it all waits.

    Queries give the events in the database, each over a connection of its own, so readers and writer do not wait for
    each other. Beyond ``max_events`` the oldest events are deleted, a few with each new one, but never the latest event
    of an alarm that is not cleared. A damaged journal is moved to the path ``set_aside`` at the start, and this one
    begins empty.

    Where the file is deleted or moved away, the next :meth:`retry` begins another one.

    Raises
    ------
    StorageError
        The file cannot be a journal: no folder, not writable, no database, another program's, of a newer version.
        A full or failing disk and a locked file raise nothing.
    """

    def __init__(self, path: str | os.PathLike[str], max_events: int = 1_000_000) -> None:
        self.set_aside: Path | None = None
        self._path = Path(path)
        self._max_events = max_events
        self._lock = threading.Lock()
        self._pending: deque[JournalRow] = deque()
        self._shelved: dict[str, Mapping[str, int]] = {}
        self._later = Path(f"{self._path}-later")
        self._full_s = -math.inf  # when the write-ahead log last had no room
        self._counts = dict.fromkeys(("written", "duplicates", "conflicts", "rejected", "dropped", "pruned"), 0)
        self._last_error: str | None = None
        self._connection: sqlite3.Connection | None = None
        self._file: tuple[int, int] | None = None  # device and number of the open file
        self._index_bytes = 0  # largest size of its write-ahead log's index so far
        self._events = 0
        with self._lock:
            self._open()

    def write(self, event: AlarmEvent, frame: Mapping[str, Any] | None = None) -> None:
        """Commit an event, once however often it is given; keep it in memory if the disk does not take it.

        An event is identified by its vehicle and ``seq``. The first freeze frame of an alarm (inputs, outputs,
        estimates and thresholds at the moment) is kept by its id.
        """
        self.write_all([(event, frame)])

    def write_all(self, events: Iterable[tuple[AlarmEvent, Mapping[str, Any] | None]]) -> None:
        """Commit events with their freeze frames as :meth:`write` does, in one transaction: one wait for the disk."""
        with self._lock:
            rows = [row for event, frame in events if (row := self._row(event, frame)) is not None]
            # After those that wait, to keep the order.
            if not rows or (not self._pending and self._has_room() and self._commit(rows)):
                return
            self._pending.extend(rows)
            self._keep(rows)
            while len(self._pending) > MAX_PENDING:
                self._pending.popleft()
                self._counts["dropped"] += 1

    def shelve(self, vehicle: str, channels: Mapping[str, int]) -> None:
        """Replace the stored channels (``observer/channel``) that are shelved, and the times until which they are."""
        with self._lock:
            self._shelved[plain(vehicle)] = dict(channels)
            self._commit_shelved()

    def retry(self) -> int:
        """Write some of the pending events, the oldest first; return how many are still pending."""
        with self._lock:
            if self._connection is not None and _identity(self._path) != self._file:
                logging.getLogger(__name__).error("%s was deleted or moved away: another one is begun", self._path)
                self._disconnect()
            self._keep_index()
            if self._connection is None:
                try:
                    self._open()
                except StorageError as error:
                    self._last_error = str(error)
            batch = [self._pending[index] for index in range(min(RETRIED_AT_ONCE, len(self._pending)))]
            if batch and self._has_room() and self._commit(batch):
                for _ in batch:
                    self._pending.popleft()
                if not self._pending:
                    self._later.unlink(missing_ok=True)
            self._commit_shelved()
            return len(self._pending)

    def statistics(self) -> JournalStatistics:
        """Return the counts so far."""
        with self._lock:
            return JournalStatistics(
                **self._counts,
                pending=len(self._pending),
                open=self._connection is not None,
                last_error=self._last_error,
            )

    def active(self, vehicle: str) -> list[AlarmEvent]:
        """Return the latest event of each of a vehicle's alarms that is not cleared, by ``seq``.

        Raises
        ------
        OSError
            The journal cannot be read; all other queries raise it too.
        """
        return self._readable(body for (body,) in self._query(_ACTIVE, (plain(vehicle),)))

    def shelved(self, vehicle: str) -> dict[str, int]:
        """Return the channels of a vehicle that operators have shelved, and the Unix times at which that ends."""
        return dict(self._query("SELECT channel, until_ns FROM shelved WHERE vehicle = ?", (plain(vehicle),)))

    def last_seq(self, vehicle: str) -> int:
        """Return the largest ``seq`` of a vehicle's events, 0 where it has none."""
        rows = self._query("SELECT last_seq FROM vehicle WHERE name = ?", (plain(vehicle),))
        return int(rows[0][0]) if rows else 0

    def events(self, vehicle: str | None = None, since_ns: int = 0, limit: int = 1000) -> list[AlarmEvent]:
        """Return the newest events of a vehicle, or of all, in the order they were written.

        None is from before the Unix time ``since_ns``, and there are never more than :data:`MAX_ANSWER`. A query of
        more than :data:`LONGEST_QUERY_S` raises OSError.
        """
        whose, values = ("", ()) if vehicle is None else ("vehicle = ? AND", (plain(vehicle),))
        rows = self._query(
            _EVENTS.format(whose), (*values, bounded(since_ns), max(0, min(limit, MAX_ANSWER))), LONGEST_QUERY_S
        )
        return self._readable(body for _, body in sorted(rows))

    def frame(self, alarm_id: str) -> dict[str, Any] | None:
        """Return the freeze frame of an alarm, None where there is none or the file is damaged there."""
        rows = self._query("SELECT frame FROM alarm WHERE id = ? AND frame IS NOT NULL", (plain(alarm_id),))
        try:
            frame = json.loads(rows[0][0]) if rows else None
        except (TypeError, ValueError, RecursionError):
            return None
        return frame if isinstance(frame, dict) else None

    def close(self) -> None:
        """Write pending events as far as the disk takes them, and close; a second call does nothing."""
        before = MAX_PENDING + 1
        while 0 < (waiting := self.statistics().pending) < before:
            before = waiting
            self.retry()
        with self._lock:
            self._commit_shelved()
            self._disconnect()

    def _keep_index(self) -> None:
        """Restore the length of the log's index, with zeros, after another program cut it; SQLite then fills it anew.

        SQLite maps it into memory, and a process that reads beyond the end of the mapped file is ended by a signal.
        """
        index = Path(f"{self._path}-shm")
        try:
            size = index.stat().st_size
            if size < self._index_bytes:
                os.truncate(index, 0)
                os.truncate(index, self._index_bytes)
                logging.getLogger(__name__).error("%s was cut: it is made anew", index)
            self._index_bytes = max(size, self._index_bytes)
        except OSError:
            return

    def _disconnect(self) -> None:
        if self._connection is not None:
            with contextlib.suppress(sqlite3.Error):
                self._connection.close()
            self._connection = None

    def _open(self) -> None:
        try:
            try:
                self._connection = open_database(self._path)
            except DamagedError as error:
                self.set_aside = set_aside(self._path)
                self._last_error = f"{self._path}: damaged ({error}), set aside as {self.set_aside.name}"
                self._connection = open_database(self._path)
            self._file, self._index_bytes = _identity(self._path), 0
            self._events = self._connection.execute("SELECT count(*) FROM event").fetchone()[0]
            self._restore()
        except sqlite3.Error as error:
            self._note(error)

    def _has_room(self) -> bool:
        """Return whether the write-ahead log may grow; after it had no room, look again only after a second."""
        if self._connection is None:
            return False
        if time.monotonic() - self._full_s < _FULL_S:
            return False
        try:
            if has_room(self._path, self._connection):
                self._full_s = -math.inf
                return True
        except sqlite3.Error as error:
            self._note(error)
            return False
        self._full_s = time.monotonic()
        self._last_error = f"{self._path}: another program reads it without an end; events wait in {self._later.name}"
        return False

    def _keep(self, rows: Sequence[JournalRow]) -> None:
        """Write rows that the database does not take to the file beside it."""
        # A line that a full disk cut off ends here.
        lines = b"".join(b"\n" + to_json(astuple(row)) for row in rows) + b"\n"
        try:
            with self._later.open("ab") as file:
                if file.tell() + len(lines) <= LATER_BYTES:
                    file.write(lines)
                    file.flush()
                    os.fsync(file.fileno())
        except OSError as error:
            self._last_error = f"{self._later}: {error.strerror}"

    def _restore(self) -> None:
        """Write the rows of that file from an earlier run to the database; damaged ones are left out."""
        try:
            lines = self._later.read_bytes().splitlines()
        except OSError:
            return
        rows = [row for line in lines if (row := _row_of(line)) is not None]
        if self._commit(rows):
            with contextlib.suppress(OSError):
                self._later.unlink()
        else:
            self._pending.extendleft(reversed(rows))

    def _row(self, event: AlarmEvent, frame: Mapping[str, Any] | None) -> JournalRow | None:
        """Return an event as a row; None, counted, where no row can hold it."""
        if not isinstance(event.seq, int) or abs(event.seq) > LARGEST:
            self._reject(f"event of {event.vehicle} with seq {event.seq!r:.40}")
            return None
        try:
            body = to_json(event.to_json()).decode()
            time_ns = bounded(int(event.time_ns))
            vehicle, alarm = plain(event.vehicle), plain(event.id)
        except (TypeError, ValueError, AttributeError, RecursionError, OverflowError) as error:
            self._reject(f"event {event.seq} of {event.vehicle!r:.80}: {error}")
            return None
        frozen = None if frame is None else self._frozen(event, frame)
        return JournalRow(vehicle, event.seq, alarm, time_ns, event.state != "cleared", body, frozen)

    def _frozen(self, event: AlarmEvent, frame: Mapping[str, Any]) -> str | None:
        try:
            body = to_json(frame)
        except (TypeError, ValueError, RecursionError) as error:
            self._reject(f"freeze frame of {event.id}: {error}")
            return None
        if len(body) > MAX_FRAME_BYTES:
            self._reject(f"freeze frame of {event.id}: {len(body)} bytes")
            return None
        return body.decode()

    def _commit(self, rows: Sequence[JournalRow]) -> bool:
        """Write rows in one transaction; return whether all are there."""
        counts = dict.fromkeys(("written", "duplicates", "conflicts", "pruned"), 0)
        conflict = None

        def write(connection: sqlite3.Connection) -> None:
            nonlocal conflict
            for row in rows:
                outcome = insert(connection, row)
                counts[outcome] += 1
                if outcome == "conflicts":
                    conflict = f"event {row.seq} of {row.vehicle} already exists, with other content"
            counts["pruned"] = prune(connection, self._events + counts["written"] - self._max_events)

        if not self._transact(write):
            return False
        for name, count in counts.items():
            self._counts[name] += count
        if conflict is not None:
            self._last_error = f"{self._path}: {conflict}"
        self._events += counts["written"] - counts["pruned"]
        return True

    def _commit_shelved(self) -> None:
        """Write the shelved channels that are not written yet."""
        for vehicle, channels in list(self._shelved.items()):
            if not self._transact(functools.partial(shelve, vehicle=vehicle, channels=channels)):
                return
            del self._shelved[vehicle]

    def _transact(self, work: Callable[[sqlite3.Connection], None]) -> bool:
        """Call ``work`` in one transaction; return whether the disk took it."""
        if self._connection is None:
            return False
        try:
            self._connection.execute("BEGIN IMMEDIATE")
            work(self._connection)
            self._connection.execute("COMMIT")
        except sqlite3.Error as error:
            self._note(error)
            with contextlib.suppress(sqlite3.Error):
                self._connection.rollback()
            return False
        return True

    def _query(self, sql: str, values: Sequence[Any], longest_s: float = math.inf) -> list[Any]:
        until_s = time.monotonic() + longest_s
        try:
            alone = self._connection is None
            with contextlib.closing(read_connection(self._path, alone)) as connection:
                connection.set_progress_handler(lambda: time.monotonic() > until_s, _STEPS)
                return connection.execute(sql, values).fetchall()
        except (sqlite3.Error, UnicodeDecodeError) as error:
            raise OSError(f"{self._path}: journal cannot be read: {error}") from error

    def _readable(self, bodies: Iterable[str]) -> list[AlarmEvent]:
        """Return events from their JSON, without those that a failing disk has damaged."""
        events = []
        for body in bodies:
            try:
                event = valid_event(json.loads(body))
            except (ValueError, RecursionError):
                event = None
            if event is None:
                self._last_error = f"{self._path}: event that cannot be read: {body:.80}"
            else:
                events.append(event)
        return events

    def _note(self, error: sqlite3.Error) -> None:
        self._last_error = f"{self._path}: {error}"

    def _reject(self, what: str) -> None:
        self._counts["rejected"] += 1
        self._last_error = f"{self._path}: cannot hold {what}"


def _identity(path: Path) -> tuple[int, int] | None:
    """Return the device and number of a file; None where there is none."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_dev, found.st_ino


def _row_of(line: bytes) -> JournalRow | None:
    """Return a row from its line; None where a failing disk has damaged it."""
    try:
        row = JournalRow(*json.loads(line))
        kinds = (str, int, str, int, bool, str, str | None)
        return row if all(map(isinstance, astuple(row), kinds)) else None
    except (TypeError, ValueError, RecursionError):
        return None
