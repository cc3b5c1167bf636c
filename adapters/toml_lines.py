"""On which line of a TOML text each key stands; the standard library's parser does not tell."""

from __future__ import annotations

import re
import tomllib
from bisect import bisect_right

KeyPath = tuple[str | int, ...]
"""Keys and indices that lead to a value: ``("vehicle", 0, "name")``."""

_BLANK = re.compile(r"(?:[ \t\r\n]+|#[^\n]*)*")
_KEY = re.compile(r"""[ \t]*("(?:[^"\\\n]|\\.)*"|'[^'\n]*'|[A-Za-z0-9_-]+)[ \t]*(\.?)""")
_STRING = re.compile(
    r'"""(?:[^\\]|\\.)*?"{3,5}|' + r"'''.*?'{3,5}|" + r'"(?:[^"\\\n]|\\.)*"|' + r"'[^'\n]*'",
    re.DOTALL,
)
_DEEPEST = 100
"""Nesting. Chosen: far more than any of our files, far below the limit of the interpreter."""
_SCALAR = re.compile(r"[^,\]}#\r\n]*")


def key_lines(text: str) -> dict[KeyPath, int]:
    """Return the line, from 1, of every table, key and element of a list in a valid TOML text.

    An array of tables and its first table share a line. Of a text that is not valid the lines up to the first mistake
    are right, and where tables and lists are nested more than 100 levels deep those up to there.
    """
    return _Scanner(text).scan()


def line_of(lines: dict[KeyPath, int], path: KeyPath) -> int | None:
    """Return the line of the innermost part of a path that stands in the text, None where none does."""
    return next((lines[path[:end]] for end in range(len(path), 0, -1) if path[:end] in lines), None)


class _Scanner:
    """Reads a text once from start to end; it looks for keys and does not judge values."""

    def __init__(self, text: str) -> None:
        self._text = text
        self._at = 0
        self._starts = [0, *(match.end() for match in re.finditer("\n", text))]
        self._lines: dict[KeyPath, int] = {}
        self._tables: dict[KeyPath, int] = {}

    def scan(self) -> dict[KeyPath, int]:
        table: KeyPath = ()
        before = -1
        while before < self._at:
            self._skip_blank()
            before = self._at
            if self._text.startswith("[", self._at):
                table = self._header()
            else:
                self._assignment(table)
        return self._lines

    def _header(self) -> KeyPath:
        line = self._line()
        array = self._text.startswith("[[", self._at)
        self._at += 2 if array else 1
        path: KeyPath = ()
        for key in self._keys():
            path = (*self._last(path), key)
            self._lines.setdefault(path, line)
        if array:
            self._tables[path] = self._tables.get(path, -1) + 1
            path = self._last(path)
            self._lines[path] = line
        self._at += 2 if array else 1
        return path

    def _last(self, path: KeyPath) -> KeyPath:
        """Return where the tables below a path go: into the last of an array of tables."""
        return (*path, self._tables[path]) if path in self._tables else path

    def _assignment(self, table: KeyPath) -> None:
        line = self._line()
        path = table
        for key in self._keys():
            path = (*path, key)
            self._lines.setdefault(path, line)
        if path != table and self._text.startswith("=", self._at):
            self._at += 1
            self._value(path)

    def _keys(self) -> list[str]:
        keys: list[str] = []
        while match := _KEY.match(self._text, self._at):
            try:
                keys += tomllib.loads(f"{match[1]} = 0")
            except tomllib.TOMLDecodeError:
                break
            self._at = match.end()
            if not match[2]:
                break
        return keys

    def _value(self, path: KeyPath) -> None:
        if len(path) > _DEEPEST:
            self._at = len(self._text)
            return
        self._skip_blank()
        opening = self._text[self._at : self._at + 1]
        # Below, an element that was not understood leaves the place where it is, and ends its list or table.
        if opening == "[":
            self._at += 1
            index, before = 0, -1
            while self._more("]") and self._at > before:
                before = self._at
                self._lines[(*path, index)] = self._line()
                self._value((*path, index))
                index += 1
        elif opening == "{":
            self._at += 1
            before = -1
            while self._more("}") and self._at > before:
                before = self._at
                self._assignment(path)
        else:
            match = _STRING.match(self._text, self._at) or _SCALAR.match(self._text, self._at)
            self._at = match.end() if match else self._at

    def _more(self, closing: str) -> bool:
        """Skip what separates elements; return whether another one follows, else go past the end."""
        self._skip_blank()
        while self._text.startswith(",", self._at):
            self._at += 1
            self._skip_blank()
        if self._text.startswith(closing, self._at) or self._at >= len(self._text):
            self._at += 1
            return False
        return True

    def _skip_blank(self) -> None:
        match = _BLANK.match(self._text, self._at)
        self._at = match.end() if match else self._at

    def _line(self) -> int:
        return bisect_right(self._starts, self._at)
