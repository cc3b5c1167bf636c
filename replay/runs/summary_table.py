"""A table with a row for each replayed log, written row by row: CSV, or Parquet where the file is called so."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, Self

from adapters.errors import UsageError
from adapters.output_file import naming
from monitor.bus.alarm_text import utc
from replay.reports.levels import WornChannel, level_columns
from replay.runs.one_log import LogOutcome

COLUMNS: Mapping[str, type] = {
    "log": str,
    "status": str,
    "error": str,
    "kind": str,
    "start_utc": str,
    "duration_s": float,
    "watched_s": float,
    "samples": int,
    "evidence": int,
    "alarms": int,
    "first_alarm": str,
    "first_alarm_utc": str,
    "first_alarm_after_s": float,
    "first_alarm_estimate": float,
    "first_alarm_unit": str,
    "first_alarm_display": str,
    "worst_severity": str,
    "lacking": str,
    "mismatch": str,
    "damage": str,
    "processor_s": float,
    "times_real_time": float,
}
_ROWS_AT_ONCE = 1000
"""Rows of a Parquet row group. Chosen: enough to compress, little to lose."""


def summary_row(outcome: LogOutcome) -> dict[str, Any]:
    """Return a log's row; values that are not known are None.

    ``status`` is ``ok``, ``unwatched`` (nothing wrong with the log, but the vehicle was never in flight) or ``failed``.
    """
    raised = outcome.raised
    first = raised[0] if raised else None
    severities = {event.severity for event in outcome.events}
    duration_s = max(0, outcome.end_ns - outcome.start_ns) / 1e9
    status = "failed" if outcome.error is not None else "ok" if outcome.evidence else "unwatched"
    lacking = [f"{name}: {', '.join(lacks)}" for name, lacks in outcome.lacking.items()]
    worn = {
        name: float(f"{value:.6g}")
        for level in outcome.levels
        for name, value in zip(level_columns(level.of), (level.value, level.sd, level.limit), strict=True)
    }
    return {
        "log": outcome.log,
        "status": status,
        "error": outcome.error,
        "kind": outcome.kind or None,
        "start_utc": utc(outcome.start_ns) if outcome.start_ns else None,
        "duration_s": round(duration_s, 3),
        "watched_s": round(outcome.watched_s, 3),
        "samples": outcome.samples,
        "evidence": outcome.evidence,
        "alarms": len(raised),
        "first_alarm": f"{first.observer}/{first.channel}" if first else None,
        "first_alarm_utc": utc(first.time_ns) if first else None,
        "first_alarm_after_s": round((first.time_ns - outcome.start_ns) / 1e9, 3) if first else None,
        "first_alarm_estimate": first.estimate if first else None,
        "first_alarm_unit": first.unit if first else None,
        "first_alarm_display": first.display if first else None,
        "worst_severity": max(severities, key=("warning", "critical").index) if severities else None,
        "lacking": "; ".join(lacking) or None,
        "mismatch": outcome.mismatch,
        "damage": "; ".join(part.line() for part in outcome.damage) or None,
        "processor_s": round(outcome.processor_s, 3),
        "times_real_time": round(duration_s / outcome.processor_s, 1) if duration_s and outcome.processor_s else None,
        **worn,
    }


class SummaryTable:
    """Writes the table, ``.csv`` or ``.parquet``; rows are in the file after :meth:`close`, in a CSV file at once.

    Behind :data:`COLUMNS` there are three for each channel that shows wear.

    Raises UsageError for another suffix, or for Parquet without pyarrow; any method OSError where it cannot be written.
    """

    def __init__(self, path: Path, worn: Iterable[WornChannel] = ()) -> None:
        kinds: Mapping[str, Callable[[Path, Mapping[str, type]], _Csv | _Parquet]] = {
            ".csv": _Csv,
            ".parquet": _Parquet,
        }
        if path.suffix.lower() not in kinds:
            raise UsageError(f"--table {path}: unknown kind of table; use .csv or .parquet")
        self._path = path
        columns = {**COLUMNS, **{name: float for of in worn for name in level_columns(of)}}
        with naming(path):
            self._rows = kinds[path.suffix.lower()](path, columns)

    def add(self, outcome: LogOutcome) -> None:
        """Add a log's row."""
        with naming(self._path):
            self._rows.add(summary_row(outcome))

    def close(self) -> None:
        """Finish the file."""
        with naming(self._path):
            self._rows.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class _Csv:
    def __init__(self, path: Path, columns: Mapping[str, type]) -> None:
        self._file = path.open("w", newline="", encoding="utf-8", errors="backslashreplace")
        self._writer = csv.DictWriter(self._file, list(columns))
        self._writer.writeheader()

    def add(self, row: Mapping[str, Any]) -> None:
        self._writer.writerow(row)
        self._file.flush()

    def close(self) -> None:
        self._file.close()


class _Parquet:
    def __init__(self, path: Path, columns: Mapping[str, type]) -> None:
        try:
            import pyarrow
            import pyarrow.parquet
        except ImportError as error:
            raise UsageError(
                f"--table {path}: pyarrow is not installed; run: pip install 'fauio[parquet]', or write .csv"
            ) from error
        types = {str: pyarrow.string(), int: pyarrow.int64(), float: pyarrow.float64()}
        self._schema = pyarrow.schema([(name, types[kind]) for name, kind in columns.items()])
        self._table = pyarrow.Table
        self._writer = pyarrow.parquet.ParquetWriter(path, self._schema)
        self._pending: list[Mapping[str, Any]] = []

    def add(self, row: Mapping[str, Any]) -> None:
        self._pending.append(row)
        if len(self._pending) >= _ROWS_AT_ONCE:
            self._write()

    def close(self) -> None:
        if self._pending:
            self._write()
        self._writer.close()

    def _write(self) -> None:
        self._writer.write_table(self._table.from_pylist(self._pending, self._schema))
        self._pending = []
