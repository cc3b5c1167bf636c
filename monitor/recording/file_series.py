"""Names and sizes of the files in which one vehicle is recorded for weeks: within a budget, the oldest deleted."""

from __future__ import annotations

import os
import re
from datetime import UTC, datetime
from pathlib import Path

from adapters.errors import StorageError
from monitor.recording.retention import Retention, file_stem, writable_folder

# The largest year that a file name's time can have is 9999.
_LATEST_S = 253_402_300_799


class FileSeries:
    """Files ``<folder>/<vehicle>-<UTC>-<number>.mcap``, whose lexical order is the order of recording.

    Parameters
    ----------
    folder : str | PathLike
        Folder of the files; created where it does not exist.
    vehicle : str
        The vehicle's name.
    file_bytes, file_s : int, float
        Size, and time between the arrivals of first and last telemetry, after which a new file begins. Defaults chosen:
        ten minutes, 25 MB for a copter of 500 records a second
        (measured), open at once in a viewer; the size bounds the files of faster ones.
    budget_bytes : int
        Bytes of all the vehicle's files together, the one being written included.

    Raises
    ------
    StorageError
        The folder cannot be written to, or the budget is smaller than two files.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        vehicle: str,
        *,
        file_bytes: int = 64 * 1024 * 1024,
        file_s: float = 600.0,
        budget_bytes: int = 4 * 1024 * 1024 * 1024,
    ) -> None:
        if budget_bytes < 2 * file_bytes:
            raise StorageError(
                f"{folder}: a recording budget of {budget_bytes} bytes is less than two files of {file_bytes} bytes; "
                "raise the budget or lower the size of a file"
            )
        self.file_bytes = file_bytes
        self.file_ns = round(file_s * 1e9)
        self._folder = writable_folder(folder)
        self._stem = file_stem(vehicle)
        name = re.compile(re.escape(self._stem) + r"-\d{8}T\d{6}Z-\d{6}\.mcap", re.ASCII)
        self._retention = Retention(self._folder, name, budget_bytes)
        self._newest = max((path.name for path in self._retention.files()), default="")

    @property
    def deleted(self) -> int:
        """Files deleted so far."""
        return self._retention.deleted

    def next_path(self, time_ns: int) -> Path:
        """Return the path of the next file, with room for it in the budget.

        Parameters
        ----------
        time_ns : int
            Unix time of the first telemetry in it. A clock that was set back continues with the last file's time, so
            that names stay in order.
        """
        self._retention.make_room(self.file_bytes)
        seconds = min(max(time_ns, 0) // 1_000_000_000, _LATEST_S)
        stamp = datetime.fromtimestamp(seconds, UTC).strftime("%Y%m%dT%H%M%SZ")
        number = 0
        if self._newest:
            last_stamp, last_number = self._newest.removesuffix(".mcap").rsplit("-", 2)[1:]
            stamp = max(stamp, last_stamp)
            number = int(last_number) + 1 if stamp == last_stamp else 0
        path = self._folder / f"{self._stem}-{stamp}-{number:06}.mcap"
        self._newest = path.name
        return path

    def wait(self) -> None:
        """Wait for files that are being deleted."""
        self._retention.wait()
