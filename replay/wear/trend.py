"""Wear across flights: tables with the levels of each actuator in each flight, and lines through them.

A trend is reported if its slope towards wear is so certain that, over all channels together and without any wear, at
most one vehicle in 40 has a reported trend (Bonferroni). An actuator's loss shows in its neighbours' estimates, too: of
one observer's trends the most certain one is named, and others are reported as possibly part of it. A line is
extrapolated no further than the time over which it was observed: nobody knows how wear continues after that.
"""

from __future__ import annotations

import csv
import math
import re
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any, Literal

import numpy as np

from adapters.errors import TelemetryError, UsageError
from monitor.alarms.alarm import LOG_TIMES
from monitor.display import number_text
from replay.reports.levels import WearLevel, WornChannel, level_columns
from replay.wear.line import COVERED, LEAST_FLIGHTS, Line, fit_line

SUFFIXES = (".csv", ".parquet")
_VALUE = re.compile(r"(?P<observer>[^/ ]+)/(?P<channel>[^/ ]+) \((?P<unit>.+)\)")


def read_table(path: Path) -> list[LoggedFlight]:
    """Return the flights of a table that could be replayed, in its order.

    Raises
    ------
    TelemetryError
        The file is no such table, has no columns of wear, or a cell is not a number.
    """
    rows = list(_rows(path))
    columns = {name: match for name in (rows[0] if rows else ()) if (match := _VALUE.fullmatch(name))}
    if not columns:
        raise TelemetryError(
            f"{path}: has no rows with columns of wear; write it anew: fauio replay PROFILE LOG... --table {path.name}"
        )
    flights = []
    for number, row in enumerate(rows, start=1):
        where = f"{path}: row {number}"
        if row.get("status") != "ok":
            continue
        levels = []
        for name, match in columns.items():
            of = WornChannel(**match.groupdict())
            value, sd, limit = (_cell(row, column, where) for column in (name, *level_columns(of)[1:]))
            if value is not None and sd is not None and limit:
                levels.append(WearLevel(of, value, sd, limit))
        start = str(row.get("start_utc") or "")
        duration_s, watched_s = (_cell(row, name, where) or 0.0 for name in ("duration_s", "watched_s"))
        flights.append(LoggedFlight(str(row.get("log")), start, duration_s, watched_s, tuple(levels)))
    return flights


def _cell(row: Mapping[str, Any], name: str, where: str) -> float | None:
    """Return the number in a row's cell; None if it is empty."""
    cell = row.get(name)
    if cell is None or cell == "":
        return None
    try:
        value = float(cell)
    except (TypeError, ValueError):
        value = math.nan
    if not math.isfinite(value):
        raise TelemetryError(f"{where}: '{name}' is no number: {cell!r}; mend the table")
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


_FALSE_CLAIMS = 0.5 * (1.0 - COVERED)
"""Share of vehicles without wear for which any trend is reported: one end of an interval that contains
:data:`COVERED`."""
AHEAD = 1.0
"""How far a line is extrapolated beyond the last flight, in times of the flown hours. Chosen: as long again."""
_LEAST_ERROR = 1e-3
"""Smallest standard deviation of a flight's level, relative to the level that raises an alarm: a thousandth decides
nothing, and keeps weights finite."""

_CLOCK_SET = 2000
"""First year of a log's begin that shows that the vehicle's clock was set."""

Judged = Literal["due", "worn", "part", "unclear", "few"]


@dataclass(frozen=True, slots=True)
class LoggedFlight:
    """One flight of a vehicle, with the levels of its channels."""

    log: str
    start_utc: str  # empty if unknown
    duration_s: float
    watched_s: float
    levels: tuple[WearLevel, ...]


@dataclass(frozen=True, slots=True)
class TrendPoint:
    """The level of a channel in one flight."""

    log: str
    hours: float  # hours of flight up to its middle
    value: float
    sd: float


@dataclass(frozen=True, slots=True)
class Trend:
    """The trend of one channel over all flights, in its unit and hours of flight."""

    of: WornChannel
    limit: float  # the level at which the monitor raises an alarm, median over the flights
    points: tuple[TrendPoint, ...]
    # due: at the limit already; worn: a certain trend towards it; part: a trend that may be another channel's
    state: Judged
    line: Line | None = None  # None if there are too few flights
    due_h: tuple[float, float, float] | None = None  # hours from the last flight to the limit: earliest, best, latest
    beyond: bool = False  # whether the earliest is further ahead than the line is extrapolated
    part_of: str = ""  # the channel whose wear may cause this trend

    @property
    def certainty(self) -> float:
        """The slope towards wear, in its standard errors."""
        if self.line is None:
            return -math.inf
        return math.copysign(1.0, self.limit) * self.line.slope / max(self.line.slope_error, 1e-300)

    def to_json(self) -> dict[str, Any]:
        """Return the JSON object for ``--json``."""
        said: dict[str, Any] = {**self.of._asdict(), "limit": self.limit, "state": self.state}
        if self.line is not None:
            half = self.line.quantile() * self.line.slope_error
            last = max(point.hours for point in self.points)
            (level,), (error,) = self.line.at(np.array([last]))
            said |= {
                "slope_per_hour": [self.line.slope - half, self.line.slope, self.line.slope + half],
                "level": [level - self.line.quantile() * error, float(level), level + self.line.quantile() * error],
                "between_flights_sd": self.line.between,
            }
        said["due_in_hours"] = None if self.due_h is None or self.beyond else list(self.due_h)
        said["part_of"] = self.part_of or None
        return said | {"points": [asdict(point) for point in self.points]}


@dataclass(frozen=True, slots=True)
class Wear:
    """The wear of a vehicle over all its flights."""

    flights: tuple[LoggedFlight, ...]  # in their order
    doubled: tuple[str, ...]  # logs of a time that another log covers
    trends: tuple[Trend, ...]

    @property
    def hours(self) -> float:
        """Hours of watched flight."""
        return sum(flight.watched_s for flight in self.flights) / 3600.0

    def to_json(self) -> dict[str, Any]:
        """Return the JSON object for ``--json``."""
        return {
            "verdict": " ".join(wear_sentences(self)),
            "flights": len(self.flights),
            "hours": self.hours,
            "left_out": list(self.doubled),
            "trends": [trend.to_json() for trend in self.trends],
        }


def find_wear(flights: Sequence[LoggedFlight]) -> Wear:
    """Return the trends of all channels; flights are sorted by time if all of their times are known."""
    kept, doubled = _in_order(flights)
    series: dict[WornChannel, list[tuple[TrendPoint, float]]] = defaultdict(list)
    hours = 0.0
    for flight in kept:
        middle = hours + 0.5 * flight.watched_s / 3600.0
        hours += flight.watched_s / 3600.0
        for level in flight.levels:
            series[level.of].append((TrendPoint(flight.log, middle, level.value, level.sd), level.limit))
    told = sum(len(points) >= LEAST_FLIGHTS for points in series.values())
    trends = [_trend(of, points, hours, told) for of, points in series.items()]
    return Wear(tuple(kept), tuple(doubled), tuple(_with_parts(trends)))


def _in_order(flights: Sequence[LoggedFlight]) -> tuple[list[LoggedFlight], list[str]]:
    """Return flights sorted by their begins, and the logs of flights that another log covers."""
    starts = [_start_s(flight.start_utc) for flight in flights]
    if None in starts:
        return list(flights), []
    kept: list[LoggedFlight] = []
    doubled: list[str] = []
    end = -math.inf
    for flight, start in sorted(zip(flights, starts, strict=True), key=lambda flown: flown[1] or 0.0):
        if start is None or start < end:
            doubled.append(flight.log)
            continue
        kept.append(flight)
        end = start + flight.duration_s
    return kept, doubled


def _start_s(start_utc: str) -> float | None:
    """Return a Unix time; None if the vehicle did not know the date and counted from its own start."""
    try:
        start = datetime.fromisoformat(start_utc)
    except ValueError:
        return None
    return start.timestamp() if start.year >= _CLOCK_SET else None


def _trend(of: WornChannel, points: Sequence[tuple[TrendPoint, float]], hours: float, told: int) -> Trend:
    """Return a channel's trend; ``told`` is the number of channels with enough flights for a trend."""
    shown = tuple(point for point, _ in points)
    limit = float(np.median([limit for _, limit in points]))
    bare = Trend(of, limit, shown, "few")
    if len(points) < LEAST_FLIGHTS:
        return bare
    x, y, sd = (np.array([getattr(point, name) for point in shown]) for name in ("hours", "value", "sd"))
    line = fit_line(x, y, np.maximum(sd, _LEAST_ERROR * abs(limit)))
    certain = line.quantile(1.0 - 2.0 * _FALSE_CLAIMS / told)
    sign = math.copysign(1.0, limit)
    (level,), (error,) = line.at(np.array([hours]))
    if sign * (level - limit) > certain * error:
        return Trend(of, limit, shown, "due", line)
    if not sign * line.slope > certain * line.slope_error:
        return Trend(of, limit, shown, "unclear", line)
    crossing = line.crossing(limit)
    assert crossing is not None  # noqa: S101 - the slope is more certain than that
    first, best, last = (max(0.0, at - hours) for at in crossing)
    return Trend(of, limit, shown, "worn", line, (first, best, last), first > AHEAD * hours)


def _with_parts(trends: Iterable[Trend]) -> list[Trend]:
    """Return the trends, the most certain ones first; only the first of each observer is named."""
    named: dict[str, str] = {}
    ordered = []
    for trend in sorted(trends, key=lambda trend: (trend.state not in ("due", "worn"), -trend.certainty)):
        state, of = trend.state, trend.of
        if state in ("due", "worn") and named.setdefault(of.observer, of.channel) != of.channel:
            ordered.append(replace(trend, state="part", part_of=named[of.observer], due_h=None))
        else:
            ordered.append(trend)
    return ordered


def wear_sentences(wear: Wear) -> list[str]:
    """Return a sentence for each channel that will need service, with the time; or that no trend can be told."""
    flown = f"{len(wear.flights)} flights, {hours_text(wear.hours)}"
    said = [
        f"{trend.of.channel} {_service(trend, wear.hours)}." for trend in wear.trends if trend.state in ("due", "worn")
    ]
    if said:
        return said
    if all(trend.state == "few" for trend in wear.trends):
        return [f"These flights show no trend ({flown}): {LEAST_FLIGHTS} are needed that show a channel."]
    return [f"These flights show no trend ({flown}): none is larger than the differences between flights."]


def _service(trend: Trend, hours: float) -> str:
    assert trend.line is not None  # noqa: S101 - of a channel that is named
    half = trend.line.quantile() * trend.line.slope_error
    limit = level_text(trend.limit, trend.of.unit)
    if trend.state == "due":
        level = level_text(float(trend.line.at(np.array([hours]))[0][0]), trend.of.unit)
        return f"needs service now: it is at {level}, and {limit} raises an alarm"
    slope = slope_text(trend.line.slope, half, trend.of.unit)
    assert trend.due_h is not None  # noqa: S101 - of a channel that wears
    first, best, last = trend.due_h
    if trend.beyond:
        return f"wears, {slope}, but needs no service within the next {hours_text(AHEAD * hours)} of flight"
    when = f"in {hours_text(best)} of flight ({hours_text(first)} to {hours_text(last)})"
    when = when if first > 0.0 else f"within {hours_text(last)} of flight"
    return f"will need service {when}: {slope}, and {limit} raises an alarm"


def trend_line(trend: Trend) -> str:
    """Return a line about a channel: its slope, the scatter between flights, and the judgement."""
    name = f"{trend.of.observer}/{trend.of.channel}"
    if trend.line is None:
        return f"{name}: no trend, as only {len(trend.points)} of the {LEAST_FLIGHTS} flights needed measured it"
    half = trend.line.quantile() * trend.line.slope_error
    judged: Mapping[Judged, str] = {
        "due": "needs service",
        "worn": "wears",
        "part": f"may be part of {trend.part_of}'s",
        "unclear": f"no trend, though one of {number_text(half, 2)} would be seen",
    }
    return (
        f"{name}: {slope_text(trend.line.slope, half, trend.of.unit)}; differs by {number_text(trend.line.between, 2)} "
        f"between flights; {judged[trend.state]}"
    )


def slope_text(slope: float, half: float, unit: str) -> str:
    """Return a slope and half of its interval for people."""
    said = "log times" if unit == LOG_TIMES else unit
    low, high = number_text(slope - half, 2, signed=True), number_text(slope + half, 2, signed=True)
    return f"{number_text(slope, 2, signed=True)} {said} each hour ({low} to {high})"


def level_text(level: float, unit: str) -> str:
    """Return a level for people."""
    if unit == LOG_TIMES:
        return f"{number_text(math.exp(min(level, 50.0)), 2)} times"
    return f"{number_text(level, 2, signed=True)} {unit}"


def hours_text(hours: float) -> str:
    """Return a time of flight for people."""
    return f"{number_text(60.0 * hours, 2)} min" if hours < 1.0 else f"{number_text(hours, 2)} h"
