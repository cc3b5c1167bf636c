"""Flights as rows of the table that ``fauio replay --table`` writes: their columns of wear, written and read."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from adapters.errors import TelemetryError, UsageError
from replay.reports.levels import WearLevel, WornChannel, level_columns
from replay.wear.trend import LoggedFlight

SUFFIXES = (".csv", ".parquet")
_VALUE = re.compile(r"(?P<observer>[^/ ]+)/(?P<channel>[^/ ]+) \((?P<unit>.+)\)")


def read_table(path: Path) -> list[LoggedFlight]:
    """Return the flights of a table that could be replayed, in its order.

    Raises
    ------
    TelemetryError
        It is no such table, has no columns of wear, or a cell is no number.
    """
    rows = list(_rows(path))
    columns = {name: match for name in (rows[0] if rows else ()) if (match := _VALUE.fullmatch(name))}
    if not columns:
        raise TelemetryError(
            f"{path}: has no rows with columns of wear; write it anew: fauio replay PROFILE LOG... --table {path.name}"
        )
    flights = []
    for number, row in enumerate(rows, start=1):
        cells = _Cells(path, number, row)
        if row.get("status") != "ok":
            continue
        levels = []
        for name, match in columns.items():
            of = WornChannel(**match.groupdict())
            value, sd, limit = (cells.number(column) for column in (name, *level_columns(of)[1:]))
            if value is not None and sd is not None and limit:
                levels.append(WearLevel(of, value, sd, limit))
        start = str(row.get("start_utc") or "")
        duration_s, watched_s = cells.number("duration_s") or 0.0, cells.number("watched_s") or 0.0
        flights.append(LoggedFlight(str(row.get("log")), start, duration_s, watched_s, tuple(levels)))
    return flights


class _Cells:
    """A row of a table, whose cells are read one by one."""

    def __init__(self, path: Path, number: int, row: Mapping[str, Any]) -> None:
        self._path, self._number, self._row = path, number, row

    def number(self, name: str) -> float | None:
        """Return a cell's number; None where it is empty."""
        cell = self._row.get(name)
        if cell is None or cell == "":
            return None
        try:
            value = float(cell)
        except (TypeError, ValueError):
            value = math.nan
        if not math.isfinite(value):
            raise TelemetryError(f"{self._path}: row {self._number}: '{name}' is no number: {cell!r}; mend the table")
        return value


def _rows(path: Path) -> Iterable[Mapping[str, Any]]:
    if path.suffix.lower() == ".csv":
        try:
            with path.open(newline="", encoding="utf-8") as file:
                return list(csv.DictReader(file))
        except (UnicodeDecodeError, csv.Error) as error:
            raise TelemetryError(f"{path}: is no CSV table: {error}") from None
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise UsageError(f"{path}: pyarrow is not installed; run: pip install 'fauio[parquet]'") from error
    try:
        rows: list[dict[str, Any]] = pyarrow.parquet.read_table(path).to_pylist()
    except pyarrow.ArrowInvalid as error:
        raise TelemetryError(f"{path}: is no Parquet table: {' '.join(str(error).split())}") from None
    return rows
