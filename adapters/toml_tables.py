"""Typed reading of TOML files: all mistakes of a file at once, each with its line, its key and what to do.

A reader asks a :class:`Table` for one key after the other. If a value is wrong, the table records a mistake and returns
a stand-in (NaN, an empty text), so that reading continues and finds the others; :meth:`TomlFile.check` then raises them
together. Code that compares values with each other asks :meth:`Table.good` first.
"""

from __future__ import annotations

import math
import re
import tomllib
from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from adapters.errors import FauioError
from adapters.output_file import filled

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

_Choice = TypeVar("_Choice", bound=str)

KeyPath = tuple[str | int, ...]
"""Keys and indices that lead to a value: ``("vehicle", 0, "name")``."""

LARGEST_BYTES = 1 << 20
"""Largest file that is read, bytes. Chosen: fifty times the largest model or configuration here, and parsed in a
second."""
_SHOWN = 60
"""Characters of a wrong value that an error shows: with file and key the error still fits two lines of a terminal."""
_NEAR = 0.7
"""Likeness (difflib's ratio) from which an unknown key is taken for a mistyped one: two letters of six may differ."""
_DEEPEST = 32
"""Most levels of tables and lists: nothing here needs more than six, and Python's recursion ends at 1000."""
_AT_LINE = re.compile(r" \(at line (\d+), column (\d+)\)")


class TomlFile:
    """A parsed file and the mistakes found in it so far.

    Use :func:`read_toml` for a file on the disk; the class itself for tables that come from elsewhere. ``error`` is the
    class that :meth:`check` raises; without the ``text`` mistakes have no lines. ``overrides`` are keys of the top
    level that the command line gave instead of the file's; for a table, some of its keys.
    """

    def __init__(
        self,
        name: str,
        content: Mapping[str, Any],
        error: type[FauioError],
        text: str = "",
        overrides: Mapping[str, Any] | None = None,
    ) -> None:
        self.name = name
        self._overrides = overrides or {}
        self._content = {**content, **self._overrides}
        for key, value in self._overrides.items():
            if isinstance(value, Mapping) and isinstance(content.get(key), Mapping):
                self._content[key] = {**content[key], **value}
        self._error = error
        self._text = text
        self._mistakes: list[tuple[KeyPath, str]] = []
        self._broken: list[KeyPath] = []

    @property
    def root(self) -> Table:
        """The table of the top level."""
        return Table(self, (), self._content)

    def changed(self, content: Mapping[str, Any]) -> TomlFile:
        """Return the file with other values at the same keys, to be read as if they were in the file."""
        return TomlFile(self.name, content, self._error, self._text)

    def mistake(
        self, path: KeyPath, what: str, *, named: bool = True, once: bool = False, also: Iterable[KeyPath] = ()
    ) -> None:
        """Record a mistake.

        If ``named``, the key is put before ``what`` in quotes. With ``once`` the mistake is left out if another key has
        the same words; ``also`` are further keys that are not judged because of it.
        """
        path = _present(path, self._content)
        key = "'" + _dotted(path) + "'" + ("" if what.startswith(":") else " ") if named else ""
        self._broken += [path, *also]
        if not once or not any(message.endswith(what) for _, message in self._mistakes):
            self._mistakes.append((path, key + what))

    def good(self, path: KeyPath, *, keys_below: bool = True) -> bool:
        """Return whether no mistake concerns the value at a path, its parts or the tables around it.

        Without ``keys_below`` only elements of a list count as parts: a table may be judged although a key of it is
        wrong.
        """
        return not any(
            path[: len(broken)] == broken
            or (broken[: len(path)] == path and (keys_below or isinstance(broken[-1], int)))
            for broken in self._broken
        )

    def check(self) -> None:
        """Raise all mistakes so far, one line each, in the order of the file."""
        if not self._mistakes:
            return
        placed = [(*self._place(path), message) for path, message in self._mistakes]
        placed.sort(key=lambda item: item[0])
        raise self._error(*(f"{place}: {message}" for _, place, message in placed))

    def _place(self, path: KeyPath) -> tuple[int, str]:
        if path and path[0] in self._overrides:
            return 0, "command line"
        line = line_of(self._text, path)
        return (0, self.name) if line is None else (line, f"{self.name}:{line}")


class Table:
    """A table of a file, which knows its path and which of its keys were asked for."""

    def __init__(self, file: TomlFile, path: KeyPath, content: Mapping[str, Any]) -> None:
        self.file = file
        self.path = path
        self.examples: Mapping[str, Any] = {}
        self._content = content
        self._known: set[str] = set()

    def __iter__(self) -> Iterator[str]:
        """Return the keys in the order of the file."""
        return iter(self._content)

    def has(self, key: str) -> bool:
        """Return whether a key is there."""
        self._known.add(key)
        return key in self._content

    def raw(self, key: str) -> Any:
        """Return a value as parsed, or None if it is absent; use it if no method below fits."""
        self._known.add(key)
        return self._content.get(key)

    def good(self, *keys: str) -> bool:
        """Return whether no mistake was found at any of these keys; without keys, in the whole table."""
        return all(self.file.good((*self.path, key)) for key in keys) if keys else self.file.good(self.path)

    def mistake(self, key: str | KeyPath, what: str) -> None:
        """Record that something is wrong with a key of this table: ``what`` follows the key's name."""
        self.file.mistake((*self.path, *((key,) if isinstance(key, str) else key)), what)

    def done(self, homes: Mapping[str, Sequence[str]] | None = None) -> None:
        """Record a mistake for each key that was not asked for: a typing error would otherwise go unnoticed.

        ``homes`` are the tables that have a key of this name, ``""`` for the top level: for a key in the wrong table.
        """
        for key in self._content:
            if key not in self._known:
                what, meant = self._unknown(key, (homes or {}).get(key, ()))
                self.file.mistake((*self.path, key), f"is not a key of this table{what}", also=meant)

    def table(self, key: str) -> Table:
        """Return the table at a key, empty if it is absent."""
        value = self._get(key, {})
        if not isinstance(value, Mapping):
            self._wrong((key,), value, "a table")
            value = {}
        return Table(self.file, (*self.path, key), value)

    def tables(self, key: str) -> list[Table]:
        """Return the tables of an array ``[[key]]``, an empty list if there is no such key."""
        value = self._get(key, [])
        if isinstance(value, Mapping):
            self.mistake(key, f"is a single table; write [[{key}]]")
            return []
        tables = []
        for k, item in enumerate(self._list(key, value)):
            if isinstance(item, Mapping):
                tables.append(Table(self.file, (*self.path, key, k), item))
            else:
                self._wrong((key, k), item, "a table")
        return tables

    def text(self, key: str, default: str | None = None, check: Callable[[str], Any] | None = None) -> str:
        """Return a text; ``check`` raises a ValueError that says what is wrong with it."""
        value = self._get(key, default)
        return "" if value is None else self._text((key,), value, check)

    def optional_text(self, key: str) -> str | None:
        """Return a text, or None if the key is absent."""
        return self.text(key) if self.has(key) else None

    def texts(self, key: str, check: Callable[[str], Any] | None = None, *, single: bool = False) -> tuple[str, ...]:
        """Return a list of texts, empty if the key is absent; with ``single`` one text may replace its list."""
        value = self._get(key, [])
        if single and isinstance(value, str):
            return (self._text((key,), value, check),)
        return tuple(self._text((key, k), item, check) for k, item in enumerate(self._list(key, value)))

    def choice(self, key: str, choices: Sequence[_Choice], default: _Choice | None = None) -> _Choice:
        """Return a text that has to be one of the given ones."""
        value = self._get(key, default)
        return choices[0] if value is None else self._choice((key,), value, choices)

    def choices(self, key: str, choices: Sequence[_Choice]) -> tuple[_Choice, ...]:
        """Return a list of texts from the given ones, empty if the key is absent."""
        value = self._list(key, self._get(key, []))
        return tuple(self._choice((key, k), item, choices) for k, item in enumerate(value))

    def boolean(self, key: str, default: bool | None = None) -> bool:
        """Return true or false."""
        value = self._get(key, default)
        if value is not None and not isinstance(value, bool):
            self._wrong((key,), value, "true or false")
        return value is True

    def integer(
        self, key: str, default: int | None = None, *, at_least: float = -math.inf, at_most: float = math.inf
    ) -> int:
        """Return a whole number within bounds."""
        value = self._get(key, default)
        if value is None:
            return 0
        if type(value) is not int:
            self._wrong((key,), value, "a whole number")
            return 0
        return value if self._bounded((key,), value, at_least=at_least, at_most=at_most) else 0

    def number(self, key: str, default: float | None = None, **bounds: float) -> float:
        """Return a finite number within bounds: ``at_least``, ``above``, ``at_most``. A default may be anything."""
        if not self.has(key) and default is not None:
            return default
        value = self._get(key, None)
        return math.nan if value is None else self.finite((key,), value, **bounds)

    def numbers(self, key: str, default: Sequence[float] | None = None, **bounds: float) -> tuple[float, ...]:
        """Return a list of at least one finite number within bounds, which are those of :meth:`number`."""
        value = self._get(key, default if default is None else list(default))
        if value is None:
            return ()
        if value == []:
            self.mistake(key, "is empty; give at least one number")
        return tuple(self.finite((key, k), item, **bounds) for k, item in enumerate(self._list(key, value)))

    def matrix(self, key: str, rows: int, columns: int) -> NDArray[np.float64]:
        """Return a finite matrix (rows, columns) from a list of rows, or NaN if it is invalid."""
        # the command line reads no matrix, and starts without NumPy
        import numpy as np

        value = self._get(key, None)
        try:
            matrix = np.array(value, dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            matrix = np.empty(0)
        if value is not None and (matrix.shape != (rows, columns) or not np.isfinite(matrix).all()):
            self.mistake(key, f"is not a {rows} x {columns} matrix of finite numbers; give a list of rows")
        return matrix if self.good(key) else np.full((rows, columns), math.nan)

    def _get(self, key: str, default: Any) -> Any:
        """Return a value; if it is absent the default, and without a default a mistake."""
        self._known.add(key)
        value = self._content.get(key, default)
        if value is None:
            self.mistake(key, "is missing" + self._example(key))
        return value

    def _list(self, key: str, value: Any) -> Sequence[Any]:
        if isinstance(value, list | tuple):
            return value
        self._wrong((key,), value, "a list")
        return ()

    def _text(self, at: KeyPath, value: Any, check: Callable[[str], Any] | None) -> str:
        if not isinstance(value, str):
            self._wrong(at, value, "text in quotes")
            return ""
        try:
            if check is not None:
                check(value)
        except ValueError as error:
            self.mistake(at, str(error))
            return ""
        return value

    def _choice(self, at: KeyPath, value: Any, choices: Sequence[_Choice]) -> _Choice:
        if value in choices:
            return choices[choices.index(value)]
        quoted = [f"'{choice}'" for choice in choices]
        known = " or ".join([", ".join(quoted[:-1])] * (len(quoted) > 1) + quoted[-1:])
        self.mistake(at, f"is {_shown(value)}; it must be {known}")
        return choices[0]

    def finite(self, at: KeyPath, value: Any, **bounds: float) -> float:
        """Return a value at a path in this table as a finite number within bounds, or NaN if it is invalid."""
        if isinstance(value, bool) or not isinstance(value, int | float):
            self._wrong(at, value, "a number")
        elif not is_number(value):
            self._wrong(at, value, "a finite number")
        elif self._bounded(at, value, **bounds):
            return float(value)
        return math.nan

    def _bounded(
        self,
        at: KeyPath,
        value: float,
        *,
        at_least: float = -math.inf,
        above: float = -math.inf,
        at_most: float = math.inf,
    ) -> bool:
        for within, words, bound in (
            (value >= at_least, "at least", at_least),
            (value > above, "more than", above),
            (value <= at_most, "at most", at_most),
        ):
            if not within:
                self.mistake(at, f"is {_shown(value)}; it must be {words} {bound:g}")
                return False
        return True

    def _wrong(self, at: KeyPath, value: Any, kind: str) -> None:
        """Record that a value is of the wrong kind."""
        example = self._example(at[0]) if len(at) == 1 else ""
        self.mistake(at, f"is {_shown(value)}, which is not {kind}{example or '; write it as one'}")

    def _example(self, key: str | int) -> str:
        return f"; write for example {key} = {toml_value(self.examples[str(key)])}" if key in self.examples else ""

    def _unknown(self, key: str, homes: Sequence[str]) -> tuple[str, tuple[KeyPath, ...]]:
        """Return the keys that an unknown key may stand for, in words and as paths."""
        if "" in homes:
            return ", but one of the top level; move it above the first [table]", ((key,),)
        if near := get_close_matches(key, self._known, 1, _NEAR):
            return f"; did you mean '{near[0]}'?", ((*self.path, near[0]),)
        if homes:
            return f"; it belongs into {' or '.join(f'[{home}]' for home in homes)}", ((homes[0], key),)
        return f"; known here: {', '.join(sorted(self._known))}" if self._known else "", ()


def read_toml(
    path: str | Path | None, error: type[FauioError], *, overrides: Mapping[str, Any] | None = None, mend: str = ""
) -> TomlFile:
    """Read and parse a file.

    Without a path the command line gives everything: ``overrides``, keys of the top level. ``mend`` says what to do if
    there is no such file.

    Raises
    ------
    FauioError
        Of the given class: the file cannot be read, is too large or is not TOML.
    """
    if path is None:
        return TomlFile("command line", {}, error, overrides=overrides)
    file = Path(path)
    try:
        if file.exists() and not file.is_file():
            raise error(f"{path}: not a file")
        if file.exists() and file.stat().st_size > LARGEST_BYTES:
            raise error(f"{path}: {file.stat().st_size} bytes is more than the {LARGEST_BYTES} that are read")
        with file.open("rb") as opened:
            content = opened.read(LARGEST_BYTES)
    except FileNotFoundError as missing:
        raise error(f"{path}: no such file{mend and '; ' + mend}") from missing
    except OSError as unread:
        raise error(f"{path}: cannot be read: {unread.strerror}") from unread
    return parse_toml(str(path), content, error, overrides=overrides)


def parse_toml(
    name: str, data: bytes, error: type[FauioError], *, overrides: Mapping[str, Any] | None = None
) -> TomlFile:
    """Parse the bytes of a file, as :func:`read_toml` does.

    Raises
    ------
    FauioError
        Of the given class: it is not TOML, or nested too deeply.
    """
    text = ""
    try:
        text = data.decode().removeprefix("\ufeff")  # some editors begin with this mark
        content = tomllib.loads(text)
    except UnicodeDecodeError as wrong:
        raise error(f"{name}: not valid TOML: byte {wrong.start} is no UTF-8; save it as UTF-8") from wrong
    except tomllib.TOMLDecodeError as wrong:
        at = _AT_LINE.search(str(wrong))
        line = at[1] if at else str(text.count("\n") + 1)
        what = _AT_LINE.sub("", str(wrong)).removesuffix(" (at end of document)")
        column = f"column {at[2]}" if at else "end of file"
        raise error(f"{name}:{line}: not valid TOML at {column}: {what}") from wrong
    except RecursionError as wrong:
        raise error(f"{name}: not valid TOML: nested too deeply") from wrong
    except ValueError as wrong:
        raise error(f"{name}: not valid TOML: a number in it is too long") from wrong
    level: list[Any] = [content]
    for _ in range(_DEEPEST):
        level = [inner for outer in level for inner in (outer.values() if isinstance(outer, dict) else outer)]
        level = [value for value in level if isinstance(value, dict | list)]
    if level:
        raise error(f"{name}: nested more than {_DEEPEST} levels deep; nothing here needs that")
    return TomlFile(name, content, error, text, overrides)


def is_number(value: object) -> bool:
    """Return whether a value of a TOML table is a finite number, whole or not."""
    try:
        return type(value) in (int, float) and math.isfinite(value)  # type: ignore[arg-type]
    except OverflowError:
        return False


def toml_text(content: Mapping[str, Any]) -> str:
    """Return a document for people: see :func:`adapters.output_file.filled`."""
    import tomli_w

    return filled(tomli_w.dumps(content, multiline_strings=False))


def toml_value(value: Any) -> str:
    """Return a value as TOML, on one line."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{_toml_key(key)} = {toml_value(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(toml_value(item) for item in value) + "]"
    return f"{value:g}" if isinstance(value, float) and value.is_integer() and abs(value) < 1e6 else str(value)


def _toml_key(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else toml_value(key)


def _shown(value: Any) -> str:
    text = toml_value(value)
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]} ..."


def _dotted(path: KeyPath) -> str:
    """Return a path as it is written: ``vehicle[0].name``."""
    dotted = ""
    for key in path:
        dotted += f"[{key}]" if isinstance(key, int) else f".{_toml_key(key)}" if dotted else _toml_key(key)
    return dotted


_TOKEN = re.compile(
    r'"""(?:[^\\]|\\.)*?"{3,5}|' + r"'''.*?'{3,5}|" + r'"(?:[^"\\\n]|\\.)*"|' + r"'[^'\n]*'|#[^\n]*|[\[\]{}\n]",
    re.DOTALL,
)
"""Tokens that decide where a statement ends: texts and comments, which are skipped, brackets and line ends."""


def line_of(text: str, path: KeyPath) -> int | None:
    """Return the line, from 1, of the statement that gives the innermost part of a path, or None if there is none.

    The standard library's parser does not report lines. Any text that ends with a statement is valid, and the shortest
    one that has the key ends with the statement that gives it.
    """
    starts, depth = [0], 0
    for token in _TOKEN.finditer(text):
        depth += (token[0] in "[{") - (token[0] in "]}")
        if token[0] == "\n" and not depth:
            starts.append(token.end())
    inner = path[: _found(path, tomllib.loads(text))]
    if not inner:
        return None
    at = bisect_left(starts[1:], True, key=lambda end: _found(inner, tomllib.loads(text[:end])) == len(inner))
    return text.count("\n", 0, starts[at]) + 1


def _found(path: KeyPath, content: Any) -> int:
    """Return how many keys of a path exist in a content."""
    for count, key in enumerate(path):
        try:
            content = content[key]
        except (LookupError, TypeError):
            return count
    return len(path)


def _present(path: KeyPath, content: Any) -> KeyPath:
    """Return the part of a path that the content has, and the key after it: a single text counts as its own list."""
    for k, key in enumerate(path):
        if isinstance(content, Mapping):
            content = content.get(key) if isinstance(key, str) else None
        elif isinstance(content, list | tuple) and isinstance(key, int) and key < len(content):
            content = content[key]
        else:
            return path[:k]
    return path
