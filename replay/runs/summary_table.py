"""A table with a row for each replayed log: CSV, written row by row, or Parquet if the file's suffix is that."""

import csv
from collections.abc import Iterable, Mapping
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


def summary_row(outcome: LogOutcome) -> dict[str, Any]:
    """Return a log's row; unknown values are None.

    ``status`` is ``ok``, ``unwatched`` (the log is intact, but the vehicle was never in flight) or ``failed``.
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
    """Writes the table, ``.csv`` or ``.parquet``; its rows are in the file after :meth:`close`, in a CSV file at once.

    :data:`COLUMNS` are followed by three columns for each channel that shows wear. Raises UsageError for another
    suffix, or for Parquet without pyarrow; any method raises OSError if the file cannot be written.
    """

    def __init__(self, path: Path, worn: Iterable[WornChannel] = ()) -> None:
        if path.suffix.lower() not in (".csv", ".parquet"):
            raise UsageError(f"--table {path}: unknown kind of table; use .csv or .parquet")
        self._columns = {**COLUMNS, **{name: float for of in worn for name in level_columns(of)}}
        self._parquet = _pyarrow(path) if path.suffix.lower() == ".parquet" else None
        self._path = path
        self._rows: list[Mapping[str, Any]] = []
        with naming(path):
            self._file = path.open("w", newline="", encoding="utf-8", errors="backslashreplace")
            self._csv = csv.DictWriter(self._file, list(self._columns))
            if self._parquet is None:
                self._csv.writeheader()

    def add(self, outcome: LogOutcome) -> None:
        """Add a log's row."""
        row = summary_row(outcome)
        if self._parquet is not None:
            self._rows.append(row)
            return
        with naming(self._path):
            self._csv.writerow(row)
            self._file.flush()

    def close(self) -> None:
        """Finish the file."""
        with naming(self._path):
            self._file.close()
            if (arrow := self._parquet) is not None:
                types = {str: arrow.string(), int: arrow.int64(), float: arrow.float64()}
                schema = arrow.schema([(name, types[kind]) for name, kind in self._columns.items()])
                arrow.parquet.write_table(arrow.Table.from_pylist(self._rows, schema), self._path)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _pyarrow(path: Path) -> Any:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise UsageError(
            f"--table {path}: pyarrow is not installed; run: pip install 'fauio[parquet]', or write .csv"
        ) from error
    return pyarrow
