"""A folder into which logs are copied: each log becomes a report, and a page lists all reports."""

import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from adapters.errors import TelemetryError
from adapters.logs.recordings import session_files
from adapters.output_file import json_text, write_file
from monitor.bus.alarm_text import utc
from monitor.profile import read_profile
from replay.reports.report_html import element, page, table
from replay.review.review import review_log
from replay.review.review_page import review_page
from replay.runs.log_list import find_logs
from replay.runs.one_log import LogTask, replay_log
from replay.watch.watch_command import INDEX_FILE

STATE_FILE: Final = "flights.json"
"""File with the result of each log, beside the reports: a later watch of the folder continues from it."""


@dataclass(frozen=True, slots=True)
class WatchedLog:
    """A row of the page: the state of a log when it was read, and the result."""

    log: str  # path in the folder
    size: int
    changed_ns: int
    report: str  # file of the report; empty if there is none
    begin: str = ""  # UTC
    duration_s: float = 0.0
    watched_s: float = 0.0  # of a reviewed log: time in flight
    alarms: int = 0  # of a reviewed log: number of findings
    severity: str = ""  # the worst
    verdict: str = ""
    error: str = ""


class FolderWatch:
    """Writes a report of each log in a folder as soon as the log no longer changes."""

    def __init__(self, folder: Path, out: Path, profile: Path | None, *, settled_s: float) -> None:
        self._folder, self._out, self._profile_folder = folder, out, profile
        self._profile = None if profile is None else read_profile(profile)
        self._settled_ns = round(1e9 * settled_s)
        self._flights = {log.log: log for log in read_watched(out / STATE_FILE)}

    def look(self) -> list[WatchedLog]:
        """Read the logs that are new or have changed; return the result of each, and write the pages."""
        try:
            logs = find_logs([self._folder])
        except TelemetryError:
            logs = []
        read = []
        for log in logs:
            if log.path.resolve().is_relative_to(self._out.resolve()):
                continue
            path, name = log.path, str(log.path.relative_to(self._folder))
            if path == self._folder:
                # the folder is one session so far; if that is a single file, other logs may be added beside it
                files = session_files(path)
                path = files[0] if len(files) == 1 else path
                name = path.name
            size, changed_ns = _state(path)
            known = self._flights.get(name)
            if known is not None and (known.size, known.changed_ns) == (size, changed_ns):
                continue
            # A log with a time in the future was written before the clock was set back, or elsewhere.
            if 0 <= time.time_ns() - changed_ns < self._settled_ns:
                continue
            flight = self._read(path, name, size, changed_ns)
            self._flights[name] = flight
            read.append(flight)
            self._write()
        if not (self._out / INDEX_FILE).exists():
            self._write()
        return read

    def _read(self, path: Path, name: str, size: int, changed_ns: int) -> WatchedLog:
        report = f"{'_'.join(Path(name).parts)}.html"
        try:
            found = self._reviewed(path, report) if self._profile is None else self._replayed(path, name, report)
        except TelemetryError as error:
            found = {"error": str(error)}
        written = not found.get("error") and (self._out / report).is_file()
        return WatchedLog(name, size, changed_ns, report if written else "", **found)

    def _replayed(self, path: Path, name: str, report: str) -> dict[str, Any]:
        """Return the results of the profile's monitor for a log."""
        assert self._profile is not None  # noqa: S101 - without one logs are reviewed
        task = LogTask(log=name, path=path, report=self._out / report, folder=self._profile_folder)
        outcome = replay_log(self._profile, task)
        severities = {event.severity for event in outcome.events}
        return {
            "begin": utc(outcome.start_ns) if outcome.start_ns else "",
            "duration_s": round((outcome.end_ns - outcome.start_ns) / 1e9, 1),
            "watched_s": round(outcome.watched_s, 1),
            "alarms": len(outcome.raised),
            "severity": next((severity for severity in ("critical", "warning") if severity in severities), ""),
            "verdict": outcome.sentence or outcome.verdict.removeprefix(f"{path.name}: "),
            "error": outcome.error or "",
        }

    def _reviewed(self, path: Path, report: str) -> dict[str, Any]:
        """Return the results of reviewing a log by its own statements."""
        review = review_log(path)
        write_file(self._out / report, review_page(review))
        weights = [finding.judgement.weight for finding in review.findings if finding.judgement.weight != "information"]
        return {
            "begin": utc(review.facts.start_ns),
            "duration_s": round(review.facts.duration_s, 1),
            "watched_s": round(review.facts.flight_s, 1),
            "alarms": len(weights),
            "severity": next((severity for severity in ("critical", "warning") if severity in weights), ""),
            "verdict": review.sentence,
        }

    def _write(self) -> None:
        flights = sorted(self._flights.values(), key=lambda flight: (flight.begin, flight.log), reverse=True)
        write_file(self._out / STATE_FILE, json_text([asdict(flight) for flight in flights]))
        write_file(self._out / INDEX_FILE, index_page(str(self._folder), flights))


def index_page(title: str, flights: list[WatchedLog]) -> str:
    """Return the page that lists all flights, the latest first."""
    heads = ("begin", "log", "length", "watched", "alarms", "what was found")
    rows = [
        (
            flight.begin[:19].replace("T", " "),
            element("a", flight.log, href=flight.report) if flight.report else flight.log,
            f"{flight.duration_s / 60:.1f} min",
            f"{flight.watched_s / 60:.1f} min",
            element("strong", flight.alarms, class_=flight.severity) if flight.alarms else "",
            flight.error.removeprefix(f"{flight.log}: ") or flight.verdict,
        )
        for flight in flights
    ]
    shown = table(heads, rows, numbers=range(2, 5)) if rows else element("p", "No log has come yet.")
    return page(f"flights in {title}", element("h1", f"Flights in {title}"), shown)


def read_watched(path: Path) -> list[WatchedLog]:
    """Return the results of an earlier run; empty if its file is missing or malformed."""
    try:
        return [WatchedLog(**entry) for entry in json.loads(path.read_text())]
    except (OSError, ValueError, TypeError):
        return []


def _state(path: Path) -> tuple[int, int]:
    """Return the size in bytes of a recording and when it last changed (Unix time, ns)."""
    files = [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]
    states = [file.stat() for file in files]
    return sum(state.st_size for state in states), max((state.st_mtime_ns for state in states), default=0)
