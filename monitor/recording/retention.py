"""Keeps a folder's files of one kind within a budget of bytes: the oldest are deleted, files of others are not."""

from __future__ import annotations

import contextlib
import os
import re
import threading
from collections.abc import Container, Sequence
from pathlib import Path

from adapters.errors import StorageError


def file_stem(name: str) -> str:
    """Return a vehicle's name as a file name's beginning: characters but letters, digits and ``._-`` become ``_``."""
    return re.sub(r"[^\w.-]", "_", name) or "_"


class Retention:
    """The files of a folder whose names match, the oldest first.

    Parameters
    ----------
    folder : Path
        The folder.
    name : re.Pattern[str]
        Matches the whole names of these files; their lexical order is that of their age.
    budget_bytes : int
        Bytes that they may take together.
    """

    def __init__(self, folder: Path, name: re.Pattern[str], budget_bytes: int) -> None:
        self._folder = folder
        self._name = name
        self._budget_bytes = budget_bytes
        self._deleted = 0
        self._deleting: threading.Thread | None = None

    @property
    def deleted(self) -> int:
        """Files deleted so far."""
        return self._deleted

    def files(self) -> list[Path]:
        """Return the files in order of age; none where the folder cannot be read."""
        try:
            return sorted(path for path in self._folder.iterdir() if self._name.fullmatch(path.name))
        except OSError:
            return []

    def make_room(self, room_bytes: int = 0, keep: Container[Path] = ()) -> None:
        """Delete the oldest files until ``room_bytes`` more fit into the budget, those to ``keep`` excepted.

        A thread deletes them: a large file takes the disk tens of milliseconds.
        """
        self.wait()
        sizes = {}
        for path in self.files():
            with contextlib.suppress(OSError):
                sizes[path] = path.stat().st_size
        excess = sum(sizes.values()) + room_bytes - self._budget_bytes
        excessive = []
        for path, size in sizes.items():
            if excess > 0 and path not in keep:
                excessive.append(path)
                excess -= size
        if excessive:
            self._deleting = threading.Thread(target=self._delete, args=(excessive,), daemon=True)
            self._deleting.start()

    def wait(self) -> None:
        """Wait for files that are being deleted."""
        if self._deleting is not None:
            self._deleting.join()
            self._deleting = None

    def _delete(self, paths: Sequence[Path]) -> None:
        for path in paths:
            with contextlib.suppress(OSError):
                path.unlink()
                self._deleted += 1


def writable_folder(folder: str | os.PathLike[str]) -> Path:
    """Return a folder for recordings, created where it does not exist.

    Raises
    ------
    StorageError
        It cannot be created, or not be written to.
    """
    path = Path(folder)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        advice = "name a folder that this user may write to"
        raise StorageError(f"{path}: cannot hold recordings: {error.strerror}; {advice}") from error
    if not os.access(path, os.W_OK | os.X_OK):
        raise StorageError(f"{path}: cannot hold recordings: it may not be written to")
    return path
