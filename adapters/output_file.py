"""Writes files whole or not at all: a full disk leaves an existing file as it was, and the error names the file."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from adapters.errors import UsageError

_IN_PLACE_ONLY = (errno.EACCES, errno.EPERM, errno.EBUSY)
"""A file may be writable although its folder is not, or be a mount of its own."""


def check_suffix(path: Path, suffix: str) -> None:
    """Raise UsageError if a file's suffix does not fit what is written to it."""
    if path.suffix and path.suffix.lower() != suffix and not path.is_dir():
        raise UsageError(f"{path}: the format is {suffix[1:].upper()}; name it {path.with_suffix(suffix)}")


def write_file(path: str | os.PathLike[str], content: str | bytes) -> None:
    """Write a file; an existing one is replaced only when all of it is on the disk. Text is written as UTF-8.

    A link is followed. A target that is not a regular file (``/dev/stdout``, a pipe) is written to directly.

    Raises
    ------
    OSError
        It cannot be written; ``filename`` is the path as given.
    """
    data = content.encode() if isinstance(content, str) else content
    given = Path(path).absolute()
    with naming(path):
        if given.parts[1] in ("dev", "proc") or (given.exists() and not given.is_file()):
            given.write_bytes(data)
            return
        try:
            _replace(given.resolve(), data)
        except OSError as error:
            if error.errno not in _IN_PLACE_ONLY or not given.exists():
                raise
            given.write_bytes(data)


def _replace(target: Path, data: bytes) -> None:
    beside = target.with_name(f".{target.name}.{os.getpid()}")
    try:
        with beside.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        if target.exists():
            shutil.copymode(target, beside)
        beside.replace(target)
    finally:
        beside.unlink(missing_ok=True)


@contextlib.contextmanager
def naming(path: str | os.PathLike[str]) -> Iterator[None]:
    """Add the file's name to any OSError raised inside: errors of a write or a close lack it."""
    try:
        yield
    except OSError as error:
        if error.errno is None:
            raise
        raise OSError(error.errno, error.strerror, os.fspath(path)) from error
