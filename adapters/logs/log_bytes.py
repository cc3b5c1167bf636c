"""What readers of onboard logs share: a window onto a file's bytes, and what was found in it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from adapters.logs.compressed import CompressedFile


@dataclass(frozen=True, slots=True)
class LogStatistics:
    """What was found in an onboard log.

    Parameters
    ----------
    records : int
        Records of the log's own kinds, wanted or not.
    unknown : int
        Whole records of kinds that the format did not know when this was written.
    damaged : int
        Places where the log was damaged.
    skipped_bytes : int
        Bytes that belong to no record.
    broken_off : bool
        Whether the log ends within a record, or its compressed data early.
    """

    records: int
    unknown: int
    damaged: int
    skipped_bytes: int
    broken_off: bool

    @property
    def unreadable(self) -> str:
        """What could not be read, as the rest of a sentence; empty where all could."""
        said = []
        if self.damaged:
            places = "1 place" if self.damaged == 1 else f"{self.damaged} places"
            said.append(f"damaged in {places}")
        if self.broken_off:
            said.append("ends early")
        if self.skipped_bytes:
            said.append(f"{self.skipped_bytes} bytes unreadable")
        if self.unknown:
            said.append(f"{self.unknown} records of unknown kinds")
        return ", ".join(said)


class Window:
    """The bytes of a file from a place on, as many as were asked for, plain or decompressed.

    Parameters
    ----------
    path : Path
        The file; ``.xz`` and ``.gz`` are decompressed.

    Attributes
    ----------
    data : bytes
        What is held of the file.
    at : int
        The place, as an index of ``data``; the reader moves it on.
    """

    def __init__(self, path: Path) -> None:
        self._source = CompressedFile(path)
        self._pieces = iter(self._source)
        self._dropped = 0
        self._ended = False
        self.data = b""
        self.at = 0

    def fill(self, count: int) -> bool:
        """Hold at least ``count`` bytes from the place on; return whether the file has as many.

        Raises
        ------
        TelemetryError
            The file cannot be opened.
        """
        missing = self.at + count - len(self.data)
        if missing <= 0 or self._ended:
            return missing <= 0
        pieces = [self.data[self.at :]]
        while missing > 0 and (piece := next(self._pieces, None)) is not None:
            pieces.append(piece)
            missing -= len(piece)
        self._dropped += self.at
        self._ended = missing > 0
        self.data, self.at = b"".join(pieces), 0
        return missing <= 0

    @property
    def offset(self) -> int:
        """The place as a number of bytes from the start of the (decompressed) file."""
        return self._dropped + self.at

    @property
    def left(self) -> int:
        """How many bytes are held from the place on."""
        return len(self.data) - self.at

    @property
    def cut(self) -> bool:
        """Whether the compressed data was damaged, as far as was read."""
        return self._source.damaged


def text(data: bytes) -> str:
    """Return bytes as text, as UTF-8 where they are that, else one character for each byte: nothing is lost."""
    try:
        return data.decode()
    except UnicodeDecodeError:
        return data.decode("latin-1")
