"""The journal's database file: created, opened, refused if it is no journal, set aside if it is damaged."""

import contextlib
import sqlite3
import time
from pathlib import Path

from adapters.errors import StorageError

APPLICATION_ID = 0x6661_756A
"""SQLite's ``application_id`` of a journal: "fauj" in ASCII."""
SCHEMA_VERSION = 1
"""Version of the tables, in the file's user_version; a file with another version is not written to."""
BUSY_S = 0.05
"""Seconds for which the writer waits for another process's lock. Chosen: the monitoring loop waits as long; an event
that is not written is retried once a second."""
READ_BUSY_S = 1.0
"""Seconds for which a reader waits for a lock; it runs in its own thread, for a person who asked."""
WAL_PAGES = 1000
"""Pages in the write-ahead log (4 MB) after which SQLite moves them into the database: SQLite's default."""
WAL_BYTES = 1 << 25
"""Size of the write-ahead log, bytes, above which nothing is written, since another program's transaction keeps it from
shrinking. Chosen: 32 MB, eight times the size at which it is usually moved, and a thousand events."""

_MAGIC = b"SQLite format 3\0"
_SIDECARS = ("-wal", "-shm", "-journal")
# Errors that may pass: no room, a failing disk, a lock of another process.
_PASSING = (sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR, sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED)
_DAMAGE = (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)
# 'latest' is the number of an alarm's event with the largest seq, 'standing' is 1 while the alarm is active
_SCHEMA = f"""
BEGIN IMMEDIATE;
CREATE TABLE event (
    number INTEGER PRIMARY KEY,
    vehicle TEXT NOT NULL,
    seq INTEGER NOT NULL,
    alarm TEXT NOT NULL,
    time_ns INTEGER NOT NULL,
    body TEXT NOT NULL,
    UNIQUE (vehicle, seq)
) STRICT;
CREATE INDEX event_time ON event (time_ns);
CREATE INDEX event_vehicle_time ON event (vehicle, time_ns);
CREATE TABLE alarm (
    id TEXT NOT NULL,
    vehicle TEXT NOT NULL,
    seq INTEGER NOT NULL,
    latest INTEGER NOT NULL,
    standing INTEGER NOT NULL,
    frame TEXT,
    PRIMARY KEY (id, vehicle)
) STRICT;
CREATE INDEX alarm_standing ON alarm (standing, latest);
CREATE TABLE vehicle (name TEXT PRIMARY KEY, last_seq INTEGER NOT NULL) STRICT;
CREATE TABLE shelved (
    vehicle TEXT NOT NULL,
    channel TEXT NOT NULL,
    until_ns INTEGER NOT NULL,
    PRIMARY KEY (vehicle, channel)
) STRICT;
PRAGMA application_id = {APPLICATION_ID};
PRAGMA user_version = {SCHEMA_VERSION};
COMMIT;
"""


class DamagedError(Exception):
    """The file was a database once and cannot be read as one any more."""


def open_database(path: Path) -> sqlite3.Connection:
    """Return a connection for the journal's only writer, the file created where there is none.

    Raises
    ------
    StorageError
        The file cannot be a journal: no folder, not writable, another program's, of a newer version.
    DamagedError
        The file is a damaged database.
    sqlite3.OperationalError
        The disk is full or fails, or another process locks the file: it may work later.
    """
    _refuse_what_is_no_database(path)
    connection: sqlite3.Connection | None = None
    try:
        connection = sqlite3.connect(path, timeout=BUSY_S, isolation_level=None, check_same_thread=False)
        _prepare(path, connection)
    except BaseException as error:
        if connection is not None:
            connection.close()
        if isinstance(error, sqlite3.DatabaseError):
            _explain(path, error)
        if isinstance(error, UnicodeDecodeError):
            # SQLite quotes the name at fault, which is no longer text.
            raise DamagedError("its tables have no readable names") from error
        raise
    return connection


def read_connection(path: Path, alone: bool = False) -> sqlite3.Connection:
    """Return a connection for one query of any thread.

    ``alone`` says that no one has the file open, not even our own writer: then it is read without creating a file, as
    is necessary on a full disk. Such a connection could write; others cannot.
    """
    uri = f"{path.absolute().as_uri()}?mode={'rw' if alone else 'ro'}"
    connection = sqlite3.connect(uri, uri=True, timeout=READ_BUSY_S, isolation_level=None)
    connection.text_factory = lambda text: text.decode(errors="replace")
    if alone:
        # The write-ahead log's index is then in memory (sqlite.org/wal.html, "without shared-memory").
        connection.execute("PRAGMA locking_mode = EXCLUSIVE")
    return connection


def has_room(path: Path, connection: sqlite3.Connection) -> bool:
    """Return whether the write-ahead log may grow; if it is full, try to move it into the database first."""
    log = path.with_name(path.name + "-wal")
    for checkpoint in (False, True):
        if checkpoint:
            connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        try:
            if log.stat().st_size <= WAL_BYTES:
                return True
        except OSError:
            return True
    return False


def set_aside(path: Path) -> Path:
    """Rename a damaged database and its sidecars to ``<name>.damaged-<time>``; return the new path.

    Raises StorageError where the folder does not allow it.
    """
    stem = f"{path.name}.damaged-{time.strftime('%Y%m%dT%H%M%SZ', time.gmtime())}"
    target = path.with_name(stem)
    count = 1
    while target.exists():
        count += 1
        target = path.with_name(f"{stem}-{count}")
    try:
        for sidecar in _SIDECARS:
            with contextlib.suppress(FileNotFoundError):
                path.with_name(path.name + sidecar).rename(target.with_name(target.name + sidecar))
        path.rename(target)
    except OSError as error:
        raise StorageError(f"{path}: is damaged and cannot be renamed ({error.strerror}); move it away") from error
    return target


def _refuse_what_is_no_database(path: Path) -> None:
    """Distinguish a file that never was a database (refused) from a damaged one."""
    if not path.parent.is_dir():
        raise StorageError(f"{path}: no folder '{path.parent}' for the journal: create it")
    if path.is_dir():
        raise StorageError(f"{path}: is a folder: name a file for the journal")
    try:
        with path.open("rb") as file:
            head = file.read(len(_MAGIC))
    except FileNotFoundError:
        return
    except OSError as error:
        raise StorageError(f"{path}: cannot be opened as journal: {error.strerror}") from error
    if head and not any(head):
        raise DamagedError("begins with zeros")
    if head and not _MAGIC.startswith(head) and head != _MAGIC:
        raise StorageError(f"{path}: is no database, so no journal: name another file")


def _prepare(path: Path, connection: sqlite3.Connection) -> None:
    application, version = (
        connection.execute(f"PRAGMA {name}").fetchone()[0] for name in ("application_id", "user_version")
    )
    tables = connection.execute("SELECT count(*) FROM sqlite_schema").fetchone()[0]
    if tables and application != APPLICATION_ID:
        raise StorageError(f"{path}: is the database of another program, not a journal: name another file")
    if tables and version > SCHEMA_VERSION:
        raise StorageError(f"{path}: journal of version {version}, written by a newer fauio: update, or move it away")
    connection.execute("PRAGMA journal_mode = WAL")
    connection.execute("PRAGMA synchronous = FULL")
    connection.execute(f"PRAGMA wal_autocheckpoint = {WAL_PAGES}")
    page_bytes = connection.execute("PRAGMA page_size").fetchone()[0]
    connection.execute(f"PRAGMA journal_size_limit = {2 * WAL_PAGES * page_bytes}")
    if not tables:
        connection.executescript(_SCHEMA)
        return
    trouble = connection.execute("PRAGMA quick_check(1)").fetchone()[0]
    if trouble != "ok":
        raise DamagedError(" ".join(trouble.split()))
    # a read-only file can be opened; only writing fails
    connection.execute("BEGIN IMMEDIATE")
    connection.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")
    connection.execute("COMMIT")


def _explain(path: Path, error: sqlite3.DatabaseError) -> None:
    """Raise the error that explains SQLite's to a user; return if it may pass by itself."""
    code = (getattr(error, "sqlite_errorcode", None) or 0) & 0xFF
    if code in _PASSING:
        return
    if code in _DAMAGE:
        raise DamagedError(str(error)) from error
    raise StorageError(f"{path}: cannot be written as journal: {error}; may this user write there?") from error
