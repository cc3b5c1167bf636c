"""Writes files whole or not at all, and lays out JSON and TOML for people.

A full disk leaves an existing file as it was, and the error names the file.
"""

import contextlib
import errno
import json
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

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


_ELEMENT = r"(?P<inside> ++)(?!\})[^\[\]\n]*+(?<!\{)\n"
_INNERMOST = re.compile(rf"(?P<begin>[\[{{])\n(?P<elements>(?:{_ELEMENT})++)(?P<outside> *+)(?P<end>[\]}}])")
"""An array or object of JSON or TOML that has a line for each element, and no element of several lines.

Nothing matched is given back (``++``): otherwise the time would grow exponentially with the lines before an inner one.
"""
_WIDTH = 120
"""Longest line that is written. Chosen: as long as lines of code here."""


def filled(text: str) -> str:
    """Return JSON or TOML for people: innermost arrays and objects on one line, long arrays on as few as hold them."""

    def fill(part: re.Match[str]) -> str:
        elements = [element.strip() for element in part["elements"][:-1].split("\n")]
        line = " ".join(elements)
        if len(line) < _WIDTH:
            return part["begin"] + line.removesuffix(",") + part["end"]
        if part["begin"] == "{":
            return part[0]
        lines = [part["inside"] + elements[0]]
        for element in elements[1:]:
            if len(lines[-1]) + 1 + len(element) <= _WIDTH:
                lines[-1] += f" {element}"
            else:
                lines.append(part["inside"] + element)
        return "\n".join([part["begin"], *lines, part["outside"] + part["end"]])

    return _INNERMOST.sub(fill, text)


def json_text(content: Any) -> str:
    """Return a JSON document for people."""
    return filled(json.dumps(content, indent=1)) + "\n"


@contextlib.contextmanager
def naming(path: str | os.PathLike[str]) -> Iterator[None]:
    """Add the file's name to any OSError raised inside: errors of a write or a close lack it."""
    try:
        yield
    except OSError as error:
        if error.errno is None:
            raise
        raise OSError(error.errno, error.strerror, os.fspath(path)) from error
