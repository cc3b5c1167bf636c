"""``fauio trend``: its options, the source of its flights, and its output."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from adapters.command_line import option, remark, say, say_json

if TYPE_CHECKING:
    from replay.wear.trend import LoggedFlight


def add_trend(subparsers: Any) -> None:
    """Add the command to the command line."""
    parser = subparsers.add_parser(
        "trend",
        help="wear across flights: what will need service, and when",
        description="Fit a line over hours of flight to the mean of each flight: effectiveness, speed and current of "
        "motors, the battery's resistance, vibration, as far as the profile watches them. Reports what will need "
        "service, and when, with a 95 % interval, or that these flights show no trend. Service is due when the "
        "monitor would raise an alarm.",
        epilog="example: fauio trend flights/ --profile quad/ --plot wear.png",
    )
    option(
        parser,
        "flights FOLDER|TABLE",
        "tables of fauio replay --table (.csv, .parquet), or logs and folders with logs (with --profile)",
        Path,
        nargs="*",
    )
    option(parser, "--profile PROFILE", "profile folder to replay logs with; its fitted flights count too", Path)
    option(
        parser,
        "--since UTC",
        "leave out flights before this time, for instance a service: 2026-11-23 or 2026-11-23T08:00",
    )
    option(parser, "--plot OUT.png", "draw the trends", Path)
    option(parser, "--json", "print one JSON object")
    parser.set_defaults(handler=run_trend)


def run_trend(args: argparse.Namespace) -> int:
    """Run ``fauio trend``."""
    from adapters.errors import TelemetryError, UsageError
    from adapters.output_file import check_suffix
    from replay.runs.log_list import check_output
    from replay.wear.trend import SUFFIXES, find_wear, read_table, trend_line, wear_sentences

    tables = [path for path in args.flights if path.suffix.lower() in SUFFIXES]
    logs = [path for path in args.flights if path not in tables]
    if not args.flights and args.profile is None:
        raise UsageError("no flights: give tables, or --profile PROFILE, with logs or for its own flights alone")
    if logs and args.profile is None:
        raise UsageError(f"{logs[0]}: logs are replayed by a profile; add --profile PROFILE, or give a table")
    _check_since(args.since)
    if args.plot is not None:
        if args.plot in tables:
            raise UsageError(f"--plot {args.plot}: is one of the tables")
        check_suffix(args.plot, ".png")
        check_output(args.plot)
    flights = [flight for path in tables for flight in read_table(path)]
    flights += _kept(args.profile) if args.profile is not None else []
    flights += _replayed(args.profile, logs) if logs else []
    flights = [flight for flight in flights if not args.since or flight.start_utc >= args.since]
    if not flights:
        since = f" since {args.since}" if args.since else ""
        raise TelemetryError(f"{(*args.flights, args.profile)[0]}: no flight that was watched{since}")
    wear = find_wear(flights)
    if args.plot is not None:
        from replay.wear.trend_plot import plot_trends

        plot_trends(args.plot, wear)
    remark(*(f"{log}: left out; another log covers the same time" for log in wear.doubled))
    if args.json:
        say_json(wear.to_json())
    else:
        say(*wear_sentences(wear), *map(trend_line, wear.trends))
    return 0


def _check_since(since: str | None) -> None:
    from datetime import datetime

    from adapters.errors import UsageError

    try:
        datetime.fromisoformat(since or "2000-01-01")
    except ValueError:
        raise UsageError(f"--since {since}: is no date; write it as 2026-11-23 or 2026-11-23T08:00") from None


def _kept(folder: Path) -> Iterator[LoggedFlight]:
    """Yield the levels of wear in the flights that a profile was fitted to, if the profile keeps them."""
    from monitor.bus.alarm_text import utc
    from monitor.fitting.kept_flights import FOLDER, read_kept
    from monitor.fitting.progress import track
    from monitor.profile import read_profile
    from replay.player import play_batches
    from replay.reports.levels import flight_levels
    from replay.runs.one_log import FEW_ROWS
    from replay.wear.trend import LoggedFlight

    profile = read_profile(folder)
    kept = read_kept(folder).flights if (folder / FOLDER).is_dir() else ()
    for flight in track(kept, "replaying", "fitted flights", total=len(kept)):
        found = play_batches(profile, flight.batches(folder), keep_traces=True, trace_rows=FEW_ROWS)
        if not found.evidence:
            continue
        duration_s = (flight.span.last_ns - flight.span.first_ns) / 1e9
        levels = tuple(flight_levels(profile, found.events, found.traces))
        yield LoggedFlight(flight.name, utc(flight.span.first_ns), duration_s, found.watched_s, levels)


def _replayed(folder: Path, arguments: Sequence[Path]) -> Iterator[LoggedFlight]:
    """Yield the levels of wear in logs; a log that cannot be replayed is reported on stderr and left out."""
    from monitor.bus.alarm_text import utc
    from monitor.fitting.progress import track
    from monitor.profile import read_profile
    from replay.runs.log_list import find_logs
    from replay.runs.one_log import LogTask, replay_log
    from replay.wear.trend import LoggedFlight

    profile, logs = read_profile(folder), find_logs(arguments)
    for log in track(logs, "replaying", "logs", total=len(logs)):
        outcome = replay_log(profile, LogTask(log=str(log.path), path=log.path, folder=folder))
        if outcome.error is not None or not outcome.evidence:
            remark(f"{outcome.error or outcome.verdict}; left out")
            continue
        duration_s = (outcome.end_ns - outcome.start_ns) / 1e9
        yield LoggedFlight(outcome.log, utc(outcome.start_ns), duration_s, outcome.watched_s, outcome.levels)
