"""The result of a detectability sweep as a table for people and as JSON for programs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from replay.sensitivity.detectability import Detectability, Row

_HEADER = ("channel", "kind", "size", "unit", "missed", "median", "90 %", "only it", "error of estimate", "also raised")


def result_json(found: Detectability) -> dict[str, Any]:
    """Return the result as one JSON object."""
    rows = [{**asdict(row), "miss_rate": row.missed / row.trials if row.trials else None} for row in found.rows]
    return {**asdict(found), "rows": rows}


def result_lines(found: Detectability) -> list[str]:
    """Return the result as lines of text."""
    before_s, after_s = found.window_s
    trials = max((row.trials + row.void for row in found.rows), default=0)
    lines = [
        f"{found.profile} on {found.log}: {trials} onsets each, {before_s:g} s before and {after_s:g} s after; "
        "delays from onset to alarm"
    ]
    if found.healthy_alarms:
        alarms = "1 alarm" if found.healthy_alarms == 1 else f"{found.healthy_alarms} alarms"
        lines.append(f"the log itself raises {alarms}; is it healthy? Windows around them were left out")
    lines += _table([_HEADER, *(_cells(row) for row in found.rows)])
    void = sum(row.void for row in found.rows)
    if void:
        lines.append(f"{void} trials do not count: an alarm was raised before the onset")
    return lines + [f"left out: {reason}" for reason in found.skipped]


def _cells(row: Row) -> tuple[str, ...]:
    return (
        row.channel,
        row.kind,
        "" if row.size is None else f"{row.size:g}",
        row.unit,
        f"{row.missed} of {row.trials}",
        _seconds(row.delay_median_s),
        _seconds(row.delay_90_s),
        "" if row.isolated is None else f"{100 * row.isolated:.0f} %",
        "" if row.estimate_error is None else f"{row.estimate_error:.2g}",
        ", ".join(row.others),
    )


def _seconds(delay: float | None) -> str:
    return "never" if delay is None else f"{delay:.2f} s"


def _table(rows: Sequence[Sequence[str]]) -> list[str]:
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
