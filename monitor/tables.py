"""Typed reading of TOML tables, with one-line errors that name the file and the key."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adapters.channels import is_number
from adapters.errors import ProfileError


class Table:
    """A TOML table that remembers where it stands and which of its keys were read.

    Parameters
    ----------
    file : str
        File the table comes from.
    prefix : str
        Dotted key of the table inside the file.
    content : Mapping[str, Any]
        The parsed table.
    """

    def __init__(self, file: str, prefix: str, content: Mapping[str, Any]) -> None:
        self._file = file
        self._prefix = prefix
        self._content = content
        self._read: set[str] = set()

    def where(self, key: str) -> str:
        """Return file and dotted key, the beginning of an error about it."""
        return f"{self._file}: '{self._prefix}{key}'"

    def keys(self) -> list[str]:
        """Return the keys in the order of the file."""
        return list(self._content)

    def raw(self) -> Mapping[str, Any]:
        """Return the table as parsed and count all of it as read."""
        self._read |= set(self._content)
        return self._content

    def done(self) -> None:
        """Raise for the first key that nobody read: a typing mistake that would otherwise go unnoticed."""
        unknown = [key for key in self._content if key not in self._read]
        if unknown:
            known = f"; known here: {', '.join(sorted(self._read))}" if self._read else ""
            raise ProfileError(f"{self.where(unknown[0])} is not a key of this table{known}")

    def table(self, key: str) -> Table:
        """Return the table below ``key``, empty where there is none."""
        self._read.add(key)
        found = self._content.get(key, {})
        if not isinstance(found, Mapping):
            raise ProfileError(f"{self.where(key)} is not a table")
        return Table(self._file, f"{self._prefix}{key}.", found)

    def tables(self, key: str) -> list[Table]:
        """Return the tables of the array below ``key``, none where there is no such key."""
        found = self._get(key, [])
        if not isinstance(found, list) or not all(isinstance(item, Mapping) for item in found):
            raise ProfileError(f"{self.where(key)} is not an array of tables")
        return [Table(self._file, f"{self._prefix}{key}[{i}].", item) for i, item in enumerate(found)]

    def text(self, key: str, default: str | None = None) -> str:
        """Return a string."""
        found = self._get(key, default)
        if not isinstance(found, str):
            raise ProfileError(f"{self.where(key)} is not text in quotes")
        return found

    def optional_text(self, key: str) -> str | None:
        """Return a string, None where the key is absent."""
        self._read.add(key)
        return self.text(key) if key in self._content else None

    def texts(self, key: str, default: tuple[str, ...]) -> tuple[str, ...]:
        """Return a list of strings."""
        found = self._get(key, list(default))
        if not isinstance(found, list) or not all(isinstance(item, str) for item in found):
            raise ProfileError(f"{self.where(key)} is not a list of texts")
        return tuple(found)

    def numbers(self, key: str, default: tuple[float, ...], above: float = -math.inf) -> tuple[float, ...]:
        """Return a list of at least one finite number, all above ``above``."""
        found = self._get(key, list(default))
        if not isinstance(found, list) or not found or not all(_is_finite(item) and item > above for item in found):
            beyond = f" above {above:g}" if above > -math.inf else ""
            raise ProfileError(f"{self.where(key)} is not a list of finite numbers{beyond}")
        return tuple(float(item) for item in found)

    def boolean(self, key: str, default: bool | None = None) -> bool:
        """Return true or false."""
        found = self._get(key, default)
        if not isinstance(found, bool):
            raise ProfileError(f"{self.where(key)} is neither true nor false")
        return found

    def integer(self, key: str, default: int | None = None) -> int:
        """Return a whole number."""
        found = self._get(key, default)
        if isinstance(found, bool) or not isinstance(found, int):
            raise ProfileError(f"{self.where(key)} is not a whole number")
        return found

    def number(self, key: str, default: float | None = None, at_least: float = -math.inf) -> float:
        """Return a finite number that is not below ``at_least``."""
        found = self._get(key, default)
        if key not in self._content and default is not None:
            return default
        if not _is_finite(found):
            raise ProfileError(f"{self.where(key)} is not a finite number")
        if found < at_least:
            raise ProfileError(f"{self.where(key)} is {found:g}; it must be at least {at_least:g}")
        return float(found)

    def matrix(self, key: str, rows: int, columns: int) -> NDArray[np.float64]:
        """Return a finite matrix of the given shape."""
        try:
            found = np.array(self._get(key, None), dtype=np.float64)
        except (TypeError, ValueError):
            found = np.empty(0)
        if found.shape != (rows, columns) or not np.isfinite(found).all():
            raise ProfileError(f"{self.where(key)} is not a {rows} x {columns} matrix of finite numbers")
        return found

    def _get(self, key: str, default: Any) -> Any:
        self._read.add(key)
        found = self._content.get(key, default)
        if found is None:
            raise ProfileError(f"{self.where(key)} is missing")
        return found


def _is_finite(found: object) -> bool:
    return is_number(found)
