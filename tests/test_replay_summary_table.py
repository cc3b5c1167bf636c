"""The table of many logs: a row each, the same as CSV and as Parquet, whatever became of the log."""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import pyarrow.parquet
import pytest
from loopback import START_NS, event

from adapters.errors import UsageError
from adapters.logs.damage import Damage
from replay.runs.one_log import LogOutcome
from replay.runs.summary_table import COLUMNS, SummaryTable, summary_row

FOUND = LogOutcome(
    log="a.tlog",
    kind="tlog",
    events=(event(2_000_000_000), event(3_000_000_000, "motor2", severity="critical"), event(4, state="cleared")),
    start_ns=START_NS,
    end_ns=START_NS + 10_000_000_000,
    samples=1000,
    evidence=900,
    watched_s=9.0,
    lacking={"inertial": ("GPS_RAW_INT",)},
    damage=(Damage("flight.tlog", ("breaks off at byte 4711",), 4711),),
    processor_s=0.1,
)
FAILED = LogOutcome(log='b, "c".tlog', error='b, "c".tlog: holds nothing')


def test_a_row_says_what_was_found() -> None:
    row = summary_row(FOUND)
    assert list(row) == list(COLUMNS)
    assert (row["status"], row["alarms"], row["worst_severity"]) == ("ok", 2, "critical")
    assert (row["first_alarm"], row["first_alarm_after_s"], row["first_alarm_estimate"]) == (
        "motors/motor1",
        2.0,
        -0.02,
    )
    assert (row["duration_s"], row["times_real_time"]) == (10.0, 100.0)
    assert row["lacking"] == "inertial: GPS_RAW_INT"
    assert row["damage"] == "flight.tlog: breaks off at byte 4711"
    assert summary_row(LogOutcome(log="a", samples=5))["status"] == "unwatched"


def test_csv_and_parquet_say_the_same(tmp_path: Path) -> None:
    outcomes = [FOUND, FAILED] * 600
    for suffix in (".csv", ".parquet"):
        with SummaryTable(tmp_path / f"table{suffix}") as table:
            for outcome in outcomes:
                table.add(outcome)
    parquet = pyarrow.parquet.read_table(tmp_path / "table.parquet").to_pylist()
    assert parquet == [summary_row(outcome) for outcome in outcomes]
    with (tmp_path / "table.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert rows == [{key: "" if value is None else str(value) for key, value in row.items()} for row in parquet]


def test_rows_of_a_csv_file_are_there_at_once(tmp_path: Path) -> None:
    with SummaryTable(tmp_path / "table.csv") as table:
        table.add(FOUND)
        assert (tmp_path / "table.csv").read_text().count("\n") == 2


def test_another_kind_of_table_and_a_missing_library_get_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(UsageError, match=r"use \.csv or \.parquet"):
        SummaryTable(tmp_path / "table.xlsx")
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(UsageError, match=r"pip install 'fauio\[parquet\]'"):
        SummaryTable(tmp_path / "table.parquet")
