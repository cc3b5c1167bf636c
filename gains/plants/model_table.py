"""Typed reading of a model file's tables, with one-line errors that name the key."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from adapters.errors import ModelError
from gains.plants.plant import FloatArray, checked_array
from gains.plants.slopes import Interval


class Table:
    """A TOML table that knows its key and which of its entries were taken.

    Parameters
    ----------
    content : Mapping[str, Any]
        The parsed table.
    prefix : str
        Its dotted key with a dot behind, empty for the whole document.
    """

    def __init__(self, content: Mapping[str, Any], prefix: str = "") -> None:
        self._rest = dict(content)
        self._known: list[str] = []
        self._prefix = prefix

    def key(self, name: str) -> str:
        """Return the dotted key of an entry in quotes, as errors name it."""
        return f"'{self._prefix}{name}'"

    def has(self, name: str) -> bool:
        """Return whether the entry is there and not yet taken; the name counts as known."""
        self._known.append(name)
        return name in self._rest

    def take(self, name: str, default: Any) -> Any:
        """Return an entry as parsed and count it as taken."""
        self._known.append(name)
        return self._rest.pop(name, default)

    def text(self, name: str, default: str | None = None) -> str:
        """Return one line of printable text."""
        value = self.take(name, default)
        if value is None:
            raise ModelError(f"{self.key(name)} is missing")
        if not isinstance(value, str) or not value.isprintable():
            raise ModelError(f"{self.key(name)} is not one line of text in quotes")
        return value

    def number(self, name: str, default: float) -> float:
        """Return a finite number."""
        return _number(self.take(name, default), self.key(name))

    def numbers(self, name: str, default: Sequence[float]) -> tuple[float, ...]:
        """Return a list of finite numbers."""
        return _numbers(self.take(name, list(default)), self.key(name))

    def names(self, name: str) -> tuple[str, ...]:
        """Return a list of names; empty where the entry is missing."""
        value = self.take(name, [])
        if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
            raise ModelError(f"{self.key(name)} is not a list of names")
        return tuple(value)

    def table(self, name: str) -> Table:
        """Return a table; empty where the entry is missing."""
        value = self.take(name, {})
        if not isinstance(value, Mapping):
            raise ModelError(f"{self.key(name)} is not a table")
        return Table(value, f"{self._prefix}{name}.")

    def tables(self, name: str) -> list[Table]:
        """Return an array of tables, each known in errors by its place."""
        value = self.take(name, [])
        if not isinstance(value, list) or not all(isinstance(item, Mapping) for item in value):
            raise ModelError(f"{self.key(name)} is not an array of tables: write [[{name}]]")
        return [Table(item, f"{self._prefix}{name}[{i}].") for i, item in enumerate(value, 1)]

    def vector(self, name: str, names: Sequence[str]) -> FloatArray:
        """Return a vector over ``names`` from a list, a table by name or one name; zeros where missing."""
        return _vector(self.take(name, {}), names, self.key(name))

    def matrix(self, name: str, rows: Sequence[str], columns: Sequence[str]) -> FloatArray:
        """Return a matrix from a list of rows or a table of rows by name; zeros where nothing stands."""
        value = self.take(name, {})
        shape = (len(rows), len(columns))
        if isinstance(value, list):
            for row in value:
                _numbers(row, self.key(name))
            return checked_array(value, shape, name) if value else np.zeros(shape)
        if not isinstance(value, Mapping):
            raise ModelError(f"{self.key(name)} is neither a list of rows nor a table of rows by name")
        matrix = np.zeros(shape)
        for row, entries in value.items():
            key = self.key(f"{name}.{row}")
            matrix[_index(row, rows, key)] = _vector(entries, columns, key)
        return matrix

    def rows(self, name: str, columns: Sequence[str]) -> tuple[tuple[str, ...], FloatArray]:
        """Return the names and the rows of a table of rows whose names the file chooses."""
        value = self.take(name, {})
        if not isinstance(value, Mapping) or not value:
            raise ModelError(f"{self.key(name)} is not a table of rows by name: {{ v = {{ state = 1.0 }} }}")
        rows = [_vector(row, columns, self.key(f"{name}.{row_name}")) for row_name, row in value.items()]
        return tuple(value), np.array(rows)

    def by_name(self, name: str, names: Sequence[str], default: Sequence[float]) -> list[tuple[float, ...]]:
        """Return a list of numbers for each name: one list for all, or a table by name."""
        value = self.take(name, list(default))
        if not isinstance(value, Mapping):
            return [_numbers(value, self.key(name))] * len(names)
        for item in value:
            _index(item, names, self.key(f"{name}.{item}"))
        return [_numbers(value.get(item, list(default)), self.key(f"{name}.{item}")) for item in names]

    def intervals(self, name: str, arguments: Sequence[str], default: Interval | None) -> list[Interval]:
        """Return [low, high] for each argument from a table by argument; without a default all must be there."""
        value = self.take(name, {})
        if not isinstance(value, Mapping):
            raise ModelError(f"{self.key(name)} is not a table of [low, high] by argument")
        for argument in value:
            _index(argument, arguments, self.key(f"{name}.{argument}"))
        intervals = []
        for argument in arguments:
            key, pair = self.key(f"{name}.{argument}"), value.get(argument, default)
            if pair is None:
                raise ModelError(f"{key} is missing; give [low, high] for every argument or for none")
            if not isinstance(pair, list | tuple) or len(pair) != 2 or not all(map(_is_number, pair)):
                raise ModelError(f"{key} is not [low, high]")
            low, high = _float(pair[0]), _float(pair[1])
            if not low <= high:
                raise ModelError(f"{key} is [{low:g}, {high:g}]; the lower bound comes first")
            intervals.append((low, high))
        return intervals

    def done(self) -> None:
        """Refuse what nobody took: a typing mistake that would otherwise go unnoticed."""
        for name in self._rest:
            known = ", ".join(dict.fromkeys(self._known))
            raise ModelError(f"{self.key(name)} is not a key here; there are {known}")


def _vector(value: Any, names: Sequence[str], key: str) -> FloatArray:
    vector = np.zeros(len(names))
    if isinstance(value, str):
        vector[_index(value, names, key)] = 1.0
    elif isinstance(value, Mapping):
        for name, number in value.items():
            entry = f"{key[:-1]}.{name}'"
            vector[_index(name, names, entry)] = _number(number, entry)
    else:
        numbers = _numbers(value, key)
        if len(numbers) != len(names):
            raise ModelError(f"{key} has {len(numbers)} numbers for {', '.join(names) or 'no names'}")
        vector[:] = numbers
    return vector


def _index(name: str, names: Sequence[str], key: str) -> int:
    if name not in names:
        raise ModelError(f"{key}: there is no '{name}'; there are {', '.join(names) or 'none'}")
    return list(names).index(name)


def _numbers(value: Any, key: str) -> tuple[float, ...]:
    if not isinstance(value, list):
        raise ModelError(f"{key} is not a list of numbers")
    return tuple(_number(item, key) for item in value)


def _number(value: Any, key: str) -> float:
    if not _is_number(value):
        raise ModelError(f"{key} is not a number")
    number = _float(value)
    if not math.isfinite(number):
        raise ModelError(f"{key} is not a finite number")
    return number


def _float(value: float) -> float:
    try:
        return float(value)
    except OverflowError:
        return math.inf if value > 0 else -math.inf


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
