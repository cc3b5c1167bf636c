"""``fauio replay``: one log or thousands, in this process, in several or on a cluster, or paced as if live."""

from __future__ import annotations

import argparse
import json
from collections.abc import Generator, Iterable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from adapters.command_line import option, remark, say, say_json
from adapters.errors import UsageError
from adapters.output_file import naming

if TYPE_CHECKING:
    from monitor.profile import Profile
    from replay.runs.live_replay import LiveReplay
    from replay.runs.log_list import LogFile
    from replay.runs.one_log import LogOutcome, LogTask

ALARMS_RAISED = 4
"""Exit status of --fail-on-alarm: docs/reference/exit-status.md."""
FAILED = 2
"""Exit status if a log could not be replayed: docs/reference/exit-status.md."""
LOG_HELP = (
    "recording: .tlog, .mcap, .ulg (PX4) or .bin (ArduPilot), also compressed (.xz, .gz), or the folder of a session"
)
MAPPING_HELP = "how records of a .ulg or .bin become MAVLink messages, if the default is wrong"
_FILE_OR_FOLDER = "; for several logs a folder, or a name with {log} in it"


def add_replay(subparsers: Any) -> None:
    """Add the command to the command line."""
    parser = subparsers.add_parser(
        "replay",
        help="run recordings through a profile's monitor",
        description="Run recordings through the pipeline of the live monitor, and print a line for each alarm. Exit "
        "status: 0 all logs were replayed, 2 a log could not be replayed, 4 an alarm was raised (with --fail-on-alarm, "
        "even if a log failed), 130 interrupted.",
        epilog="example: fauio replay quad/ flight.tlog --report flight.html\n"
        "example: fauio replay quad/ flights/ --jobs 4 --table summary.csv",
    )
    option(parser, "profile PROFILE", "profile folder", Path)
    option(parser, "logs LOG", f"{LOG_HELP}; any other folder: all recordings in it", Path, nargs="+")
    option(parser, "-o --out OUT.mcap", f"record telemetry, estimates and alarms{_FILE_OR_FOLDER}")
    option(
        parser,
        "--alarms OUT.jsonl",
        "write the alarm events as JSON lines; for several logs in their order, each with the key 'log'",
        Path,
    )
    option(parser, "--plot OUT.png", f"plot estimates, thresholds and alarms{_FILE_OR_FOLDER}")
    option(parser, "--dark", "plot on a dark background")
    option(parser, "--report OUT.html", f"write a page: alarms, their certainty, what was not checked{_FILE_OR_FOLDER}")
    option(parser, "--rrd OUT.rrd", f"write a Rerun recording{_FILE_OR_FOLDER}")
    option(parser, "--table OUT.csv", "write a table with a row for each log; .csv or .parquet", Path)
    option(parser, "--vehicle NAME", "name in events (default: the recording's, otherwise the profile's)")
    option(parser, "--mapping FILE.toml", MAPPING_HELP, Path)
    where = parser.add_mutually_exclusive_group()
    option(where, "--jobs N", "replay logs in N processes, 1 or more (default: in this process)", int)
    option(
        where,
        "--dask ADDRESS",
        "replay logs on the Dask cluster of this scheduler; its workers have to reach logs and outputs under the "
        "same paths",
    )
    option(parser, "--force", "replay a log even if it is of another vehicle than the profile's")
    option(parser, "--fail-on-alarm", "exit with status 4 if an alarm was raised")
    option(parser, "--verbose", "print every event too: raised, updated, cleared")
    option(parser, "--json", "print one JSON object per log")
    live = parser.add_argument_group("as if live")
    option(
        live, "--speed X", "speed relative to real time, by the times of arrival (default: as fast as possible)", float
    )
    option(live, "--publish", "publish alarms, estimates and status as the daemon does")
    option(live, "--listen ENDPOINT", "Zenoh endpoint to listen on (tcp/127.0.0.1:7447)", action="append")
    option(live, "--connect ENDPOINT", "Zenoh endpoint to connect to", action="append")
    option(live, "--allow-public", "let Zenoh listen beyond this machine")
    option(live, "--prefix KEY", "first part of the Zenoh keys (fauio)", default="fauio")
    option(live, "--udp URL", "send the packets of a .tlog to udp:HOST:PORT, in real time unless --speed is given")
    parser.set_defaults(handler=run_replay)


def run_replay(args: argparse.Namespace) -> int:
    """Run ``fauio replay``."""
    from monitor.fitting.progress import track
    from monitor.profile import read_profile
    from replay.reports.levels import worn_channels
    from replay.runs.log_list import find_logs
    from replay.runs.summary_table import SummaryTable

    _check(args)
    profile = read_profile(args.profile)
    logs = find_logs(args.logs)
    many = len(logs) > 1
    tasks = _tasks(args, logs)
    failed = raised = 0
    with ExitStack() as stack:
        # a file that cannot be written is reported before the first log
        alarms = stack.enter_context(_Lines(args.alarms)) if args.alarms else None
        table = stack.enter_context(SummaryTable(args.table, worn_channels(profile))) if args.table else None
        live = stack.enter_context(_live(args)) if args.publish or args.udp or args.speed is not None else None
        outcomes = _outcomes(args, profile, tasks, live)
        stack.callback(outcomes.close)
        for outcome in track(outcomes, "replaying", "logs", total=len(logs)) if many else outcomes:
            failed += outcome.error is not None
            raised += len(outcome.raised)
            _tell(outcome, as_json=args.json, with_events=many and args.verbose)
            if alarms is not None:
                origin = {"log": outcome.log} if many else {}
                alarms.add(json.dumps(event.to_json() | origin) for event in outcome.events)
            if table is not None:
                table.add(outcome)
    if args.fail_on_alarm and raised:
        return ALARMS_RAISED
    return FAILED if failed else 0


def _check(args: argparse.Namespace) -> None:
    """Refuse options that contradict each other."""
    from monitor.configuration.config_values import listens_beyond_loopback

    if args.jobs is not None and args.jobs < 1:
        raise UsageError(f"--jobs {args.jobs}: has to be at least 1")
    is_live = args.publish or args.udp is not None or args.speed is not None
    if is_live and (args.jobs is not None or args.dask is not None):
        raise UsageError("--speed, --publish and --udp replay one log after the other, without --jobs or --dask")
    if (args.listen or args.connect) and not args.publish:
        raise UsageError("--listen and --connect go with --publish only")
    for endpoint in args.listen or ():
        if listens_beyond_loopback(endpoint) and not args.allow_public:
            raise UsageError(f"--listen {endpoint}: other machines reach it; use 127.0.0.1, or --allow-public")


def _tasks(args: argparse.Namespace, logs: Sequence[LogFile]) -> list[LogTask]:
    """Return the task for each log."""
    from replay.runs.log_list import check_outputs, target
    from replay.runs.one_log import LogTask

    many = len(logs) > 1 or logs[0].path != args.logs[0]
    tasks = []
    for log in logs:
        files = {
            "path": log.path,
            "record": target("-o", args.out, log, ".mcap", many=many),
            "plot": target("--plot", args.plot, log, ".png", many=many),
            "rrd": target("--rrd", args.rrd, log, ".rrd", many=many),
            "report": target("--report", args.report, log, ".html", many=many),
            "mapping": args.mapping,
            "folder": args.profile,
        }
        if args.dask is not None:
            # workers have other working directories
            files = {name: path and path.absolute() for name, path in files.items()}
        tasks.append(LogTask(log=str(log.path), vehicle=args.vehicle, dark=args.dark, force=args.force, **files))
    targets = [path for task in tasks for path in task.targets]
    outputs = [*targets, *(path for path in (args.alarms, args.table) if path is not None)]
    options = "-o, --plot, --rrd, --report, --alarms or --table"
    check_outputs(logs, outputs, f"{options} name the same file twice; give each output a name of its own")
    return tasks


def _live(args: argparse.Namespace) -> LiveReplay:
    from adapters.zenoh.zenoh_session import DEFAULT_ENDPOINT
    from replay.runs.live_replay import LiveReplay

    listen, connect = args.listen or (), args.connect or ()
    if args.publish and not (listen or connect):
        listen = (DEFAULT_ENDPOINT,)
    # as fast as possible is too fast for any receiver of datagrams
    speed = 1.0 if args.udp is not None and args.speed is None else args.speed
    return LiveReplay(speed, connect=connect, listen=listen, prefix=args.prefix, udp=args.udp)


def _outcomes(
    args: argparse.Namespace, profile: Profile, tasks: Sequence[LogTask], live: LiveReplay | None
) -> Generator[LogOutcome, None, None]:
    """Return the result of each log, in their order."""
    if args.dask is not None:
        from replay.runs.many_logs import replay_on_dask

        yield from replay_on_dask(profile, tasks, args.dask)
    elif args.jobs is not None and args.jobs > 1 and len(tasks) > 1:
        from replay.runs.many_logs import replay_in_processes

        yield from replay_in_processes(profile, tasks, args.jobs)
    else:
        from monitor.bus.alarm_text import alarm_line
        from replay.runs.one_log import replay_log

        alone = len(tasks) == 1
        shown = alone and args.verbose and not args.json
        on_event = (lambda event: say(alarm_line(event))) if shown else None
        for task in tasks:
            yield replay_log(profile, task, on_event, live=live, progress=alone)


class _Lines:
    """A text file; each added line is written at once."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file = path.open("w", encoding="utf-8")

    def add(self, lines: Iterable[str]) -> None:
        with naming(self._path):
            self._file.writelines(f"{line}\n" for line in lines)
            self._file.flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with naming(self._path):
            self._file.close()


def _tell(outcome: LogOutcome, *, as_json: bool, with_events: bool) -> None:
    """Print the result of a log."""
    from monitor.bus.alarm_text import alarm_line, utc

    damage = [part.line() for part in outcome.damage]
    if outcome.error is not None:
        remark("; ".join([outcome.error, *damage]))
    else:
        remark(*(f"{line}; all else was read" for line in damage))
    if as_json:
        say_json(outcome.to_json())
    elif outcome.error is None:
        say(
            *(map(alarm_line, outcome.events) if with_events else ()),
            *outcome.alarms,
            *(f"{utc(condition.since_ns)[:19]}Z no fault: {condition.text}" for condition in outcome.conditions),
            outcome.verdict,
        )
