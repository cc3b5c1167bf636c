"""Damage of recordings, as lines for people: the same words from every reader."""

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class Damage:
    """The missing parts of one file.

    The findings are parts of a sentence: ``"breaks off at byte 4711"``, ``"2 damaged blocks"``. From byte
    ``stopped_at`` on nothing could be read; None if the file was read to its end.
    """

    file: str
    found: tuple[str, ...]
    stopped_at: int | None = None

    def line(self) -> str:
        """Return the damage as one line."""
        return f"{self.file}: {'; '.join(self.found)}"

    def to_json(self) -> dict[str, Any]:
        """Return the damage as a JSON object."""
        return {"file": self.file, "found": list(self.found), "stopped_at": self.stopped_at}


def counted(number: int, noun: str) -> str:
    """Return ``"1 damaged packet"``, ``"2 damaged packets"``."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


@dataclass(frozen=True, slots=True)
class ScanStatistics:
    """Counts of a reader that searches for the next intact record, or packet, after damage."""

    records: int = 0  # records of known kinds, wanted or not; packets of any kind
    # whole records of kinds that were unknown when this was written; packets that are not in the dialect
    unknown: int = 0
    damaged: int = 0  # places where the log was damaged
    skipped_bytes: int = 0  # bytes that belong to no intact record
    broken_off: bool = False  # whether the log ends within a record, or its compressed data ends early


def scan_damage(file: str, scan: ScanStatistics) -> Damage | None:
    """Return the damage that such a reader found, or None if it found none."""
    findings = []
    if scan.damaged:
        findings.append(f"{counted(scan.damaged, 'damaged place')}, {counted(scan.skipped_bytes, 'byte')} unreadable")
    if scan.broken_off:
        findings.append("breaks off at its end")
    return Damage(file, tuple(findings)) if findings else None
