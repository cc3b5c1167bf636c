"""The commands demo, fit, convert and info. The commands replay, inject and detectability have modules of their own."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from adapters.command_line import option, remark, say, say_json
from adapters.errors import StorageError, UsageError
from adapters.output_file import check_suffix
from monitor.vehicles.kinds import KINDS
from replay import attack_commands
from replay.review.review_command import add_review
from replay.runs.replay_command import LOG_HELP, MAPPING_HELP, add_replay
from replay.watch.watch_command import add_watch
from replay.wear.trend_command import add_trend

if TYPE_CHECKING:
    from adapters.batch import Batch
    from adapters.logs.damage import Damage
    from replay.fit import FitReport


_FASTEST_HZ = 1000.0
"""Highest rate of an observer. Chosen: no telemetry is faster, and a finer grid would only cost memory."""


def add_parsers(subparsers: Any) -> None:
    """Add the commands to the command line."""
    _add_demo(subparsers)
    _add_fit(subparsers)
    add_replay(subparsers)
    add_review(subparsers)
    add_watch(subparsers)
    add_trend(subparsers)
    _add_convert(subparsers)
    _add_info(subparsers)
    attack_commands.add_parsers(subparsers)


def _add_demo(subparsers: Any) -> None:
    parser = subparsers.add_parser(
        "demo",
        help="a demonstration: simulator or recorded flight, monitor, alarms",
        description="Run a monitor with telemetry over MAVLink UDP, subscribe to its alarms over Zenoh, and "
        "write a recording, a Rerun file and a plot.",
        epilog="example: fauio demo copter --out /tmp/demo",
    )
    parser.add_argument(
        "vehicle", nargs="?", choices=["arm", "copter"], default="arm", help="simulated arm, or recorded flight (arm)"
    )
    option(parser, "-o --out DIR", "folder for the results (demo-out)", Path, default=Path("demo-out"))
    option(
        parser,
        "--speed X",
        "speed relative to real time (default: 2 for the arm, 4 for the copter; 1 with --console)",
        float,
    )
    option(parser, "--console", "show it as a web page until Ctrl-C, and open a browser if there is one")
    parser.set_defaults(handler=run_demo)


def _add_fit(subparsers: Any) -> None:
    parser = subparsers.add_parser(
        "fit",
        help="fit a profile to healthy recordings: model, certified gains, thresholds",
        description="Identify a vehicle from healthy flights, design its observer, and calibrate its alarms.",
        epilog="example: fauio fit --vehicle multirotor monday.tlog tuesday.tlog -o quad/\n"
        "example: fauio fit --update quad/ wednesday.tlog\n"
        "example: fauio fit --vehicle multirotor --start 60 --end 400 long.ulg -o quad/",
    )
    parser.add_argument("--vehicle", choices=[kind.name for kind in KINDS], help="kind of vehicle")
    option(
        parser,
        "--update PROFILE",
        "add flights to those that this profile keeps, and fit again; edits of profile.toml are kept",
        Path,
    )
    option(parser, "--model MODEL.toml", "model with free parameters (custom only)", Path)
    option(parser, "logs LOG", LOG_HELP, Path, nargs="+")
    option(parser, "-o --out PROFILE", "profile folder to write (default with --update: that profile)", Path)
    option(parser, "--start S", "leave out the first S seconds of each log", float, default=0.0)
    option(parser, "--end S", "leave out each log after its first S seconds", float)
    option(parser, "--rate HZ", "samples per second of the observer (default: the rate of the messages)", float)
    option(parser, "--mapping FILE.toml", MAPPING_HELP, Path)
    option(parser, "--name NAME", "name of the vehicle in topics (default: the folder's name)")
    option(
        parser, "--force", "fit even if a log is of another kind of vehicle, or of another vehicle than the first log"
    )
    option(parser, "--json", "print the report as one JSON object")
    parser.set_defaults(handler=run_fit)


def _add_convert(subparsers: Any) -> None:
    parser = subparsers.add_parser(
        "convert",
        help="convert a recording to MCAP",
        description="Convert a recording to MCAP with typed messages, for Foxglove, Rerun and any MCAP tool.",
        epilog="example: fauio convert flight.tlog -o flight.mcap",
    )
    option(parser, "log LOG", LOG_HELP, Path)
    option(parser, "-o --out OUT.mcap", "file to write", Path, required=True)
    option(parser, "--json", "print the result as one JSON object")
    parser.set_defaults(handler=run_convert)


def _add_info(subparsers: Any) -> None:
    parser = subparsers.add_parser(
        "info",
        help="show what a recording, profile, model or gains file contains",
        description="Show what a recording contains (vehicles, messages, what they allow to watch, alarms, damage), "
        "or a profile, a model or a gains file.",
        epilog="example: fauio info flight.tlog",
    )
    option(parser, "file FILE", "recording, profile folder, MODEL.toml or GAINS.json", Path)
    option(parser, "--json", "print one JSON object")
    parser.set_defaults(handler=run_info)


def run_demo(args: argparse.Namespace) -> int:
    """Run ``fauio demo``."""
    from replay.demonstration.demo import demo

    if args.speed is not None and args.speed <= 0.0:
        raise UsageError(f"--speed {args.speed:g}: has to be positive")
    if args.out.is_file():
        raise StorageError(f"--out {args.out}: is a file; name a folder")
    return demo(args.vehicle, args.out, args.speed, args.console)


def run_fit(args: argparse.Namespace) -> int:
    """Run ``fauio fit``."""
    from adapters.errors import InfeasibleError, ModelError, TelemetryError
    from adapters.logs.recordings import Recording, recording_kind
    from monitor.fitting.flights import part_of
    from monitor.fitting.kept_flights import kept_model
    from monitor.fitting.progress import Stages, track
    from monitor.profile import read_profile
    from monitor.vehicles.kinds import fit_reading
    from replay.fit import drawings, fit_profile, name_by_folder
    from replay.runs.log_list import check_output_folder

    _check_fit(args)
    for path in args.logs:
        recording_kind(path)
    out = args.out or args.update
    check_output_folder(out)
    name = args.name or (read_profile(args.update).name if args.update else name_by_folder(out))
    wanted, types = fit_reading(args.model or (kept_model(args.update) if args.update else None))

    def log(path: Path) -> Iterator[Batch]:
        recording = Recording(path, wanted, args.mapping, types)
        batches = track(recording.batches(), f"reading {path.name}", weigh=lambda batch: batch.count)
        whole = not args.start and args.end is None
        yield from batches if whole else part_of(batches, args.start, args.end, str(path))
        damage[path] = recording.damage()

    damage: dict[Path, tuple[Damage, ...]] = {}
    logs = [lambda path=path: log(path) for path in args.logs]
    stages = Stages()
    try:
        report = fit_profile(
            args.vehicle or "",
            logs,
            out,
            name,
            args.model,
            log_names=[str(path) for path in args.logs],
            force=args.force,
            rate_hz=args.rate,
            stage=stages.done,
            update=args.update,
        )
    except (TelemetryError, ModelError, InfeasibleError) as error:
        raise type(error)(_about_logs(str(error), args.logs, args.model)) from error
    stages.flush()
    damaged = _warn(part for path in args.logs for part in damage.get(path, ()))
    _remark_on(report, out, updated=bool(args.update))
    if args.json:
        say_json(report.to_json() | {"damage": damaged})
        return 0
    more = "updated with" if args.update else "from"
    say(f"{out}: profile of '{name}' {more} {len(args.logs)} logs")
    say(*report.text())
    files = ", ".join(["fit.txt", *drawings(report)])
    say(f"The thresholds are in profile.toml and may be edited. How good the fit is: {files}")
    return 0


def _remark_on(report: FitReport, out: Path, updated: bool) -> None:
    """Write to stderr why the profile is worse than it could be, and what it replaced."""
    from monitor.profile import PROFILE_FILE

    remark(*report.warnings)
    if report.set_aside is not None:
        was, kept = out / PROFILE_FILE, f" but for {', '.join(report.edits)}" if report.edits else ""
        edited = "as it was" if updated else "edited or not"
        remark(f"{was} is written anew{kept}; what stood there, {edited}, is {report.set_aside}")
    for left_out in report.left_out:
        remark(f"{out}: {left_out} is kept no longer, there is room for the newest flights only")


def _check_fit(args: argparse.Namespace) -> None:
    """Refuse options of ``fauio fit`` that contradict each other."""
    if args.update is None and args.vehicle is None:
        raise UsageError(f"--vehicle is missing: one of {', '.join(kind.name for kind in KINDS)}")
    if args.update is None and args.out is None:
        raise UsageError("-o PROFILE is missing: the folder to write")
    if args.start < 0.0 or (args.end is not None and not args.start < args.end):
        raise UsageError("--start and --end are seconds into each log, the first from 0 on and before the second")
    if args.rate is not None and not 0.0 < args.rate <= _FASTEST_HZ:
        raise UsageError(f"--rate {args.rate:g}: has to be above 0 and at most {_FASTEST_HZ:g} samples a second")


def run_convert(args: argparse.Namespace) -> int:
    """Run ``fauio convert``."""
    from adapters.logs.recordings import Recording, onboard_source
    from monitor.fitting.progress import recording_bytes, track
    from replay.convert import convert

    recording, onboard = Recording(args.log), onboard_source(args.log)
    if args.out.exists() and args.out.samefile(args.log):
        raise StorageError(f"{args.out}: is the recording itself; give -o another name")
    check_suffix(args.out, ".mcap")
    size = recording_bytes(args.log)
    entries = track(
        recording.entries(), args.log.name, total_bytes=size, weigh=lambda entry: getattr(entry, "count", 1)
    )
    count = convert(entries, args.log.name, args.out, onboard)
    damage = _warn(recording.damage())
    if args.json:
        say_json({"log": str(args.log), "out": str(args.out), "messages": count, "damage": damage})
    else:
        say(f"{args.out}: {count} {'messages' if onboard is None else 'records'}")
    return 0


def run_info(args: argparse.Namespace) -> int:
    """Run ``fauio info``."""
    from replay.inspection.info import info, info_lines

    content = info(args.file)
    if args.json:
        say_json(content)
    else:
        say(*info_lines(content))
    return 0


def _about_logs(line: str, logs: Sequence[Path], model: Path | None) -> str:
    """Return an error line, preceded by the recordings' names unless the line names its file already."""
    if any(str(path) in line for path in (*logs, *([model] if model else []))):
        return line
    rest = f" and {len(logs) - 3} more" if len(logs) > 3 else ""
    return f"{', '.join(path.name for path in logs[:3])}{rest}: {line}"


def _warn(damaged: Iterable[Damage]) -> list[dict[str, Any]]:
    """Write to stderr which parts of recordings could not be read, a line for each file; return them for JSON."""
    damage = list(damaged)
    remark(*(f"{part.line()}; all else was read" for part in damage))
    return [part.to_json() for part in damage]
