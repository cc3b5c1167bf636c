"""Vectors and matrices over names, read from the tables of a model file; zeros replace mistakes, which are recorded."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from adapters.errors import ModelError
from adapters.toml_tables import KeyPath, Table
from gains.plants.plant import FloatArray, checked_array
from gains.plants.slopes import Interval


def one_line(text: str) -> None:
    """Refuse a text that is not one printable line."""
    if not text.isprintable():
        raise ValueError("is not one line of text in quotes")


def read_vector(table: Table, key: str, names: Sequence[str]) -> FloatArray:
    """Return a vector (len(names),) from a list, a table by name, or one name, whose entry then is 1."""
    return _vector(table, (key,), _present(table, key, {}), names)


def read_matrix(table: Table, key: str, rows: Sequence[str], columns: Sequence[str]) -> FloatArray:
    """Return a matrix (len(rows), len(columns)) from a list of rows or a table of rows by name."""
    value = _present(table, key, {})
    matrix = np.zeros((len(rows), len(columns)))
    if isinstance(value, list):
        for k, row in enumerate(value):
            _numbers(table, (key, k), row)
        try:
            return checked_array(value, matrix.shape, key) if value and table.good(key) else matrix
        except ModelError as error:
            table.file.mistake((*table.path, key), str(error), named=False)
            return matrix
    if not isinstance(value, Mapping):
        table.mistake(key, "is neither a list of rows nor a table of rows by name")
        return matrix
    for row, entries in value.items():
        index = _index(table, (key, row), row, rows)
        if index is not None:
            matrix[index] = _vector(table, (key, row), entries, columns)
    return matrix


def read_rows(table: Table, key: str, columns: Sequence[str]) -> tuple[tuple[str, ...], FloatArray]:
    """Return the names in the file and the rows (names, len(columns)) of a table of rows by name."""
    value = _present(table, key, {})
    if not isinstance(value, Mapping) or not value:
        table.mistake(key, "is not a table of rows by name: { v = { state = 1.0 } }")
        return (), np.zeros((0, len(columns)))
    return tuple(value), np.array([_vector(table, (key, name), row, columns) for name, row in value.items()])


def read_by_name(table: Table, key: str, names: Sequence[str], default: Sequence[float]) -> list[tuple[float, ...]]:
    """Return a list of numbers for each name: one list for all, or a table by name."""
    value = _present(table, key, list(default))
    if not isinstance(value, Mapping):
        return [_numbers(table, (key,), value)] * len(names)
    for name in value:
        _index(table, (key, name), name, names)
    return [_numbers(table, (key, name), value.get(name, list(default))) for name in names]


def read_intervals(table: Table, key: str, arguments: Sequence[str], default: Interval | None) -> list[Interval]:
    """Return [low, high] for each argument from a table by argument; without a default all have to be there."""
    value = _present(table, key, {})
    if not isinstance(value, Mapping):
        table.mistake(key, "is not a table of [low, high] by argument")
        value = {}
    for argument in value if arguments else ():
        _index(table, (key, argument), argument, arguments)
    return [_interval(table, (key, argument), value.get(argument, default)) for argument in arguments]


def _interval(table: Table, at: KeyPath, pair: Any) -> Interval:
    if pair is None:
        table.mistake(at, "is missing; give [low, high] for every argument or for none")
    elif not isinstance(pair, list | tuple) or len(pair) != 2 or not all(type(x) in (int, float) for x in pair):
        table.mistake(at, "is not [low, high]")
    else:
        low, high = map(_bound, pair)
        if low <= high:
            return low, high
        table.mistake(at, f"is [{low:g}, {high:g}]; the lower bound comes first")
    return -math.inf, math.inf


def _bound(value: float) -> float:
    """Return a bound as a float; it may be infinite, and becomes so if it is a whole number too large for a float."""
    try:
        return float(value)
    except OverflowError:
        return math.inf if value > 0 else -math.inf


def _present(table: Table, key: str, default: Any) -> Any:
    value = table.raw(key)
    return default if value is None else value


def _vector(table: Table, at: KeyPath, value: Any, names: Sequence[str]) -> FloatArray:
    vector = np.zeros(len(names))
    if isinstance(value, str | Mapping):
        for name, number in {value: 1.0}.items() if isinstance(value, str) else value.items():
            entry = at if isinstance(value, str) else (*at, name)
            index = _index(table, entry, name, names)
            if index is not None:
                vector[index] = table.finite(entry, number)
        return vector
    numbers = _numbers(table, at, value)
    if len(numbers) == len(names):
        vector[:] = numbers
    elif table.good(*map(str, at[:1])):
        table.mistake(at, f"has {len(numbers)} numbers for {', '.join(names) or 'no names'}")
    return vector


def _index(table: Table, at: KeyPath, name: str, names: Sequence[str]) -> int | None:
    if name in names:
        return names.index(name)
    # each matrix would report again a state that is missing above
    table.file.mistake((*table.path, *at), f": there is no '{name}'; there are {', '.join(names) or 'none'}", once=True)
    return None


def _numbers(table: Table, at: KeyPath, value: Any) -> tuple[float, ...]:
    if not isinstance(value, list):
        table.mistake(at, "is not a list of numbers")
        return ()
    return tuple(table.finite((*at, k), item) for k, item in enumerate(value))
