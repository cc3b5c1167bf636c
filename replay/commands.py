"""Commands of this package: demo, fit, convert, info; replay, inject and detectability have modules of their own."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from adapters.errors import StorageError
from monitor.vehicles.kinds import KINDS, fit_reading
from replay import attack_commands
from replay.runs.replay_command import LOG_HELP, MAPPING_HELP, add_replay

if TYPE_CHECKING:
    from adapters.batch import Batch
    from adapters.logs.damage import Damage


def add_parsers(subparsers: Any) -> None:
    """Add the commands to the command line."""
    _add_demo(subparsers)
    _add_fit(subparsers)
    add_replay(subparsers)
    _add_convert(subparsers)
    _add_info(subparsers)
    attack_commands.add_parsers(subparsers)


def _add_demo(subparsers: Any) -> None:
    parser = subparsers.add_parser(
        "demo",
        help="simulator or recorded flight, MAVLink, monitor, alarms on Zenoh",
        description="Run a monitor, feed it over real MAVLink UDP, subscribe to its alarms over real Zenoh, and "
        "leave a recording, a Rerun file and a plot.",
        epilog="example: fauio demo copter --out /tmp/demo",
    )
    parser.add_argument(
        "vehicle", nargs="?", choices=["arm", "copter"], default="arm", help="simulated arm, or recorded flight (arm)"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("demo-out"), metavar="DIR", help="folder for the results (demo-out)"
    )
    parser.add_argument(
        "--speed", type=float, metavar="X", help="times real time (default: 2 for the arm, 4 for the copter)"
    )
    parser.set_defaults(handler=run_demo)


def _add_fit(subparsers: Any) -> None:
    parser = subparsers.add_parser(
        "fit",
        help="learn a vehicle from healthy recordings: model, certified gains, thresholds",
        description="Identify a vehicle from healthy flights, design its observer, and calibrate its alarms.",
        epilog="example: fauio fit --vehicle multirotor monday.tlog tuesday.tlog -o quad/",
    )
    parser.add_argument("--vehicle", required=True, choices=[kind.name for kind in KINDS], help="kind of vehicle")
    parser.add_argument("--model", type=Path, metavar="MODEL.toml", help="model with free parameters (custom only)")
    parser.add_argument("logs", nargs="+", type=Path, metavar="LOG", help=LOG_HELP)
    parser.add_argument("-o", "--out", required=True, type=Path, metavar="PROFILE", help="profile folder to write")
    parser.add_argument("--mapping", type=Path, metavar="FILE.toml", help=MAPPING_HELP)
    parser.add_argument("--name", metavar="NAME", help="name of the vehicle in topics (default: the folder's name)")
    parser.add_argument(
        "--force",
        action="store_true",
        help="go on where a log says it is of another kind of vehicle, or of another vehicle than the first",
    )
    parser.add_argument("--json", action="store_true", help="print the report as one JSON object")
    parser.set_defaults(handler=run_fit)


def _add_convert(subparsers: Any) -> None:
    parser = subparsers.add_parser(
        "convert",
        help="convert a recording to MCAP",
        description="Convert a recording to MCAP with typed messages, for Foxglove, Rerun and any MCAP tool.",
        epilog="example: fauio convert flight.tlog -o flight.mcap",
    )
    parser.add_argument("log", type=Path, metavar="LOG", help=LOG_HELP)
    parser.add_argument("-o", "--out", required=True, type=Path, metavar="OUT.mcap", help="file to write")
    parser.add_argument("--json", action="store_true", help="print the result as one JSON object")
    parser.set_defaults(handler=run_convert)


def _add_info(subparsers: Any) -> None:
    parser = subparsers.add_parser(
        "info",
        help="what is in a recording, profile, model or gains file",
        description="Say what is in a recording (vehicles, messages, what could be watched with them, alarms, damage), "
        "a profile, a model or a gains file.",
        epilog="example: fauio info flight.tlog",
    )
    parser.add_argument("file", type=Path, metavar="FILE", help="recording, profile folder, MODEL.toml or GAINS.json")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(handler=run_info)


def run_demo(args: argparse.Namespace) -> int:
    """Run ``fauio demo``."""
    from replay.demonstration.demo import demo

    return demo(args.vehicle, args.out, args.speed)


def run_fit(args: argparse.Namespace) -> int:
    """Run ``fauio fit``."""
    from adapters.errors import InfeasibleError, ModelError, TelemetryError
    from adapters.logs.recordings import Recording, recording_kind
    from monitor.fitting.progress import track
    from monitor.profile import PROFILE_FILE
    from replay.fit import fit_profile
    from replay.runs.log_list import check_output_folder

    for path in args.logs:
        recording_kind(path)
    check_output_folder(args.out)
    name = args.name or args.out.resolve().name

    wanted, types = fit_reading(args.model)

    def log(path: Path) -> Iterator[Batch]:
        recording = Recording(path, wanted, args.mapping, types)
        batches = track(recording.batches(), f"reading {path.name}", weigh=lambda batch: batch.count)
        yield from batches
        damage[path] = recording.damage()

    damage: dict[Path, tuple[Damage, ...]] = {}
    logs = [lambda path=path: log(path) for path in args.logs]
    try:
        names = [str(path) for path in args.logs]
        report = fit_profile(args.vehicle, logs, args.out, name, args.model, log_names=names, force=args.force)
    except (TelemetryError, ModelError, InfeasibleError) as error:
        raise type(error)(_about_logs(str(error), args.logs, args.model)) from error
    found = _warn(one for path in args.logs for one in damage.get(path, ()))
    for warning in report.warnings:
        sys.stderr.write(f"fauio: {warning}\n")
    if report.set_aside is not None:
        was = args.out / PROFILE_FILE
        sys.stderr.write(f"fauio: {was} is written anew; what stood there, edited or not, is {report.set_aside}\n")
    if args.json:
        _say(json.dumps(report.to_json() | {"damage": found}))
        return 0
    _say(f"{args.out}: profile of '{name}' from {len(args.logs)} logs")
    for line in report.text():
        _say(line)
    _say("Thresholds stand in profile.toml and may be edited; fit.txt and fit.png tell what the fit is worth.")
    return 0


def run_convert(args: argparse.Namespace) -> int:
    """Run ``fauio convert``."""
    from adapters.logs.recordings import Recording, onboard_source
    from monitor.fitting.progress import recording_bytes, track
    from replay.convert import convert

    recording, onboard = Recording(args.log), onboard_source(args.log)
    if args.out.exists() and args.out.samefile(args.log):
        raise StorageError(f"{args.out}: is the recording itself; give -o another name")
    size = recording_bytes(args.log)
    entries = track(
        recording.entries(), args.log.name, total_bytes=size, weigh=lambda entry: getattr(entry, "count", 1)
    )
    count = convert(entries, args.log.name, args.out, onboard)
    damage = _warn(recording.damage())
    if args.json:
        _say(json.dumps({"log": str(args.log), "out": str(args.out), "messages": count, "damage": damage}))
    else:
        _say(f"{args.out}: {count} messages")
    return 0


def run_info(args: argparse.Namespace) -> int:
    """Run ``fauio info``."""
    from replay.inspection.info import info
    from replay.inspection.info_text import info_text

    found = info(args.file)
    sys.stdout.write(json.dumps(found) + "\n" if args.json else info_text(found))
    return 0


def _about_logs(line: str, logs: Sequence[Path], model: Path | None) -> str:
    """Return an error line that names the recordings, where it does not name the file it is about."""
    if any(str(path) in line for path in (*logs, *([model] if model else []))):
        return line
    rest = f" and {len(logs) - 3} more" if len(logs) > 3 else ""
    return f"{', '.join(path.name for path in logs[:3])}{rest}: {line}"


def _warn(found: Iterable[Damage]) -> list[dict[str, Any]]:
    """Say on stderr what of recordings could not be read, a line for each file; return it for JSON."""
    damage = list(found)
    for one in damage:
        sys.stderr.write(f"fauio: {one.line()}; all else was read\n")
    return [one.to_json() for one in damage]


def _say(text: str) -> None:
    sys.stdout.write(text + "\n")
