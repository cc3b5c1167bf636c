"""Rows of the journal's tables (events, alarms, shelved channels): how they are written and pruned."""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping
from dataclasses import dataclass

PRUNED_AT_ONCE = 64
"""Events deleted at most with each new one. Any number above 1 brings a journal back to its bound; 64 take
0.25 ms (measured), which an alarm can wait for."""
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
    """Return the nearest number of 64 bits."""
    return max(-LARGEST, min(number, LARGEST))
