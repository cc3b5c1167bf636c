"""Keys that are pressed at a terminal, without waiting for a line or for any of them."""

from __future__ import annotations

import os
import select
import sys
import termios
import tty
from typing import Any, Self

_ARROWS = {b"\x1b[A": "up", b"\x1b[B": "down", b"\x1bOA": "up", b"\x1bOB": "down"}
_MOST_BYTES = 256
"""Chosen: more than a person presses between two looks."""


class Keyboard:
    """Reads keys as a context; the terminal is as before afterwards. Where standard input is none, no key comes."""

    def __init__(self) -> None:
        self._file: int | None = None
        self._before: list[Any] = []

    def pressed(self) -> list[str]:
        """Return the keys pressed since the last call: letters, ``up`` and ``down``."""
        if self._file is None or not select.select([self._file], [], [], 0.0)[0]:
            return []
        data = os.read(self._file, _MOST_BYTES)
        if not data:  # its other end is gone
            self._file = None
        for code, name in _ARROWS.items():
            data = data.replace(code, b"\n" + name.encode() + b"\n")
        words = data.decode("ascii", "ignore").split("\n")
        return [key for word in words for key in ([word] if word in _ARROWS.values() else word)]

    def __enter__(self) -> Self:
        if sys.stdin is not None and sys.stdin.isatty():
            self._file = sys.stdin.fileno()
            self._before = termios.tcgetattr(self._file)
            tty.setcbreak(self._file)
        return self

    def __exit__(self, *_: object) -> None:
        if self._before:
            termios.tcsetattr(sys.stdin.fileno(), termios.TCSADRAIN, self._before)
