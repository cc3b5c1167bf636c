"""Keeps files of one kind within a budget, a vehicle's and all vehicles': deletes the oldest, and no other files."""

import contextlib
import os
import re
from collections.abc import Collection, Container, Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from adapters.errors import StorageError

# The largest year that a file name's time can have is 9999.
_LATEST_S = 253_402_300_799


@dataclass(frozen=True, slots=True)
class Together:
    """What the folders of all vehicles, which are beside each other, may hold.

    Beyond it the oldest files of vehicles that are not watched any more are deleted; a watched one has its own budget.
    """

    budget_bytes: int
    watched: Collection[str]  # names of the folders of the vehicles that are watched


class FileSeries:
    """Files ``<folder>/<vehicle>-<UTC>-<number>.mcap``, whose lexical order is the order of recording.

    A new file begins after a size and a time between the arrivals of first and last telemetry. Defaults chosen: ten
    minutes, 25 MB for a copter of 500 records a second (measured), open at once in a viewer; the size bounds the files
    of faster ones. ``budget_bytes`` are those of all the vehicle's files together, the one being written included,
    ``together`` those of all vehicles.
    Raises StorageError where the folder cannot be written to, or the budget is smaller than two files.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        vehicle: str,
        *,
        file_bytes: int = 64 * 1024 * 1024,
        file_s: float = 600.0,
        budget_bytes: int = 4 * 1024 * 1024 * 1024,
        together: Together | None = None,
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
        self.retention = Retention(self._folder, self._stem, r"-\d{8}T\d{6}Z-\d{6}\.mcap", budget_bytes, together)
        self._newest = max((path.name for path in self.retention.files()), default="")

    def next_path(self, time_ns: int) -> Path:
        """Return the path of the next file, whose first telemetry has this Unix time, with room for it in the budget.

        A clock that was set back continues with the last file's time, so that names stay in order.
        """
        self.retention.make_room(self.file_bytes)
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


def file_stem(name: str) -> str:
    """Return a vehicle's name as a file name's beginning: characters but letters, digits and ``._-`` become ``_``."""
    return re.sub(r"[^\w.-]", "_", name) or "_"


class Retention:
    """The files of a folder whose names are a stem and an end that a pattern matches, the oldest first."""

    def __init__(self, folder: Path, stem: str, end: str, budget_bytes: int, together: Together | None = None) -> None:
        self._folder = folder
        self._name = re.compile(re.escape(stem) + end, re.ASCII)
        self._any = re.compile(".+" + end, re.ASCII)
        self._budget_bytes = budget_bytes
        self._together = together

    def files(self) -> list[Path]:
        """Return the files in order of age; none if the folder cannot be read."""
        try:
            return sorted(path for path in self._folder.iterdir() if self._name.fullmatch(path.name))
        except OSError:
            return []

    def make_room(self, room_bytes: int = 0, keep: Container[Path] = ()) -> None:
        """Delete the oldest files until ``room_bytes`` more fit into the budgets, but never those to ``keep``."""
        own = _read(self.files())
        excess = sum(stat.st_size for stat in own.values()) + room_bytes - self._budget_bytes
        _delete({path: stat for path, stat in own.items() if path not in keep}, excess)
        if self._together is not None:
            every = _read(path for path in self._folder.parent.glob("*/*.mcap") if self._any.fullmatch(path.name))
            room_bytes *= len(self._together.watched)  # other files are being written, too
            excess = sum(stat.st_size for stat in every.values()) + room_bytes - self._together.budget_bytes
            by_age = sorted(every.items(), key=lambda one: one[1].st_mtime_ns)
            _delete({path: stat for path, stat in by_age if path.parent.name not in self._together.watched}, excess)


def _read(paths: Iterable[Path]) -> dict[Path, os.stat_result]:
    found = {}
    for path in paths:
        with contextlib.suppress(OSError):
            found[path] = path.stat()
    return found


def _delete(files: Mapping[Path, os.stat_result], excess: int) -> None:
    """Delete files in this order, so many bytes at least."""
    for path, stat in files.items():
        if excess > 0:
            excess -= stat.st_size
            with contextlib.suppress(OSError):
                path.unlink()


def writable_folder(folder: str | os.PathLike[str]) -> Path:
    """Return a folder for recordings, created if it does not exist; raise StorageError if it cannot hold any."""
    path = Path(folder)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        advice = "name a folder that this user may write to"
        raise StorageError(f"{path}: cannot hold recordings: {error.strerror}; {advice}") from error
    if not os.access(path, os.W_OK | os.X_OK):
        raise StorageError(f"{path}: cannot hold recordings: it may not be written to")
    return path
