"""``fauio doctor``: whether a monitor will run on this machine, check by check, and what to do where it will not."""

from __future__ import annotations

import argparse
import json
import platform
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from monitor.diagnosis.doctor_check import VERDICTS, Check, Verdict

FAILED = 2


@dataclass(frozen=True, slots=True)
class Needs:
    """What a monitor needs of the machine.

    Parameters
    ----------
    listen : Sequence[str]
        Zenoh endpoints to listen on.
    mavlink : Sequence[str]
        MAVLink links.
    folders : Sequence[Path]
        Folders to write to; they need not exist yet.
    metrics : str | None
        HOST:PORT to serve metrics at.
    """

    listen: Sequence[str] = ("tcp/127.0.0.1:7447",)
    mavlink: Sequence[str] = ("udpin:127.0.0.1:14550",)
    folders: Sequence[Path] = (Path(),)
    metrics: str | None = None


def add_doctor(subparsers: Any) -> None:
    """Add the command to the command line."""
    parser = subparsers.add_parser(
        "doctor",
        help="will a monitor run here: ports, permissions, Zenoh, clock, versions",
        description="Check ports, permissions, Zenoh, clock, disk, receive buffers and versions, and say what to do. "
        "Exit status: 0; 2 where a check failed.",
        epilog="example: fauio doctor --mavlink udpin:127.0.0.1:14550 --folder recordings/",
    )
    parser.add_argument("--config", type=Path, metavar="FILE.toml", help="check what this configuration needs")
    parser.add_argument(
        "--listen", metavar="ENDPOINT", action="append", help="Zenoh endpoint to listen on (tcp/127.0.0.1:7447)"
    )
    parser.add_argument(
        "--mavlink", metavar="URL", action="append", help="MAVLink link to listen on (udpin:127.0.0.1:14550)"
    )
    parser.add_argument(
        "--folder", metavar="DIR", type=Path, action="append", help="folder to write to (the present one)"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(handler=run_doctor)


def run_doctor(args: argparse.Namespace) -> int:
    """Run ``fauio doctor``."""
    checks = diagnose(_needs(args))
    if args.json:
        said = {"status": worst(checks), "checks": [asdict(check) for check in checks]}
        sys.stdout.write(json.dumps(said) + "\n")
    else:
        sys.stdout.write(checks_text(checks))
    return FAILED if worst(checks) == "failed" else 0


def diagnose(needs: Needs) -> list[Check]:
    """Return what all checks found."""
    from monitor.diagnosis.doctor_machine import buffer_check, clock_checks, disk_check, folder_check, serial_checks
    from monitor.diagnosis.doctor_network import mavlink_check, metrics_check, round_trip_check, zenoh_port_check

    checks = [*version_checks()]
    checks += [zenoh_port_check(endpoint) for endpoint in needs.listen]
    checks += [mavlink_check(url) for url in needs.mavlink if not url.startswith("serial:")]
    if needs.metrics is not None:
        checks.append(metrics_check(needs.metrics))
    checks.append(round_trip_check())
    checks += serial_checks([url for url in needs.mavlink if url.startswith("serial:")])
    for folder in needs.folders:
        checks += [folder_check(folder), disk_check(folder)]
    return [*checks, buffer_check(), *clock_checks()]


def version_checks() -> list[Check]:
    """Check that libraries are there and new enough, and say which extras are."""
    from monitor.diagnosis.versions import libraries

    found = libraries()
    needed = [one for one in found if not one.extra]
    said = ", ".join(f"{one.name} {one.installed}" for one in needed if one.installed)
    checks = [
        Check("version", "ok", f"fauio {version('fauio')}, Python {platform.python_version()}"),
        Check("libraries", "ok", said),
    ]
    for one in needed:
        if not one.will_do:
            what = "is not installed" if one.installed is None else f"{one.installed} is too old"
            advice = f"pip install '{one.name}>={one.least}'" if one.least else f"pip install {one.name}"
            checks.append(Check("libraries", "failed", f"{one.name} {what}", advice))
    extras = dict.fromkeys(one.extra for one in found if one.extra)
    for extra in extras:
        missing = [one.name for one in found if one.extra == extra and not one.will_do]
        state = f"without {', '.join(missing)}: pip install 'fauio[{extra}]' where it is wanted" if missing else "there"
        checks.append(Check("extra", "ok", f"{extra}: {state}"))
    return checks


def worst(checks: Sequence[Check]) -> Verdict:
    """Return the worst verdict."""
    return max((check.verdict for check in checks), key=VERDICTS.index, default="ok")


def checks_text(checks: Sequence[Check]) -> str:
    """Return what was found for people: a line for each check, and one more where something is to be done."""
    width = max((len(check.name) for check in checks), default=0)
    lines = []
    for check in checks:
        lines.append(f"{check.verdict:<8} {check.name:<{width}}  {check.found}")
        if check.advice:
            lines.append(f"{'':<{9 + width}}  -> {check.advice}")
    counts = [sum(check.verdict == verdict for check in checks) for verdict in VERDICTS]
    lines.append(f"{counts[0]} ok, {counts[1]} to look at, {counts[2]} failed")
    return "\n".join(lines) + "\n"


def _needs(args: argparse.Namespace) -> Needs:
    listen, mavlink, folders = args.listen or (), args.mavlink or (), args.folder or ()
    if args.config is not None:
        from monitor.configuration.config import read_config

        config = read_config(args.config, {})
        listen, mavlink = listen or config.listen, mavlink or config.mavlink
        files = [path for path in (config.record, config.journal.path) if path is not None]
        places = [path for path in (config.recording.folder, config.black_box.folder) if path is not None]
        folders = folders or tuple(dict.fromkeys([*places, *(path.parent for path in files)]))
        return Needs(listen, mavlink, folders, config.metrics.listen)
    usual = Needs()
    return Needs(listen or usual.listen, mavlink or usual.mavlink, folders or usual.folders)
