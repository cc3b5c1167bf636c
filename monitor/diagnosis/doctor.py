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
from typing import TYPE_CHECKING, Any

from monitor.diagnosis.doctor_check import VERDICTS, DoctorCheck, DoctorVerdict

if TYPE_CHECKING:
    from adapters.zenoh.zenoh_session import Mode

FAILED = 2
"""Exit status, as for any other mistake: docs/reference/exit-status.md."""


@dataclass(frozen=True, slots=True)
class Needs:
    """What a monitor needs of the machine."""

    listen: Sequence[str] = ("tcp/127.0.0.1:7447",)  # Zenoh endpoints to listen on
    mavlink: Sequence[str] = ("udpin:127.0.0.1:14550",)  # MAVLink links
    folders: Sequence[Path] = (Path(),)  # folders to write to; they need not exist yet
    metrics: str | None = None  # HOST:PORT to serve metrics at
    connect: Sequence[str] = ()  # Zenoh endpoints to connect to, where ``zenoh_config`` names none
    zenoh_config: Path | None = None  # Zenoh's own configuration, with which to listen
    zenoh_mode: Mode = "peer"  # Zenoh's mode where that does not say
    profiles: Sequence[Path] = ()


def add_doctor(subparsers: Any) -> None:
    """Add the command to the command line."""
    parser = subparsers.add_parser(
        "doctor",
        help="will a monitor run here: ports, permissions, Zenoh, clock, versions",
        description="Check ports, permissions, Zenoh, clock, disk, receive buffers and versions, and say what to do. "
        "Exit status: 0; 2 where a check failed.",
        epilog="example: fauio doctor --mavlink udpin:127.0.0.1:14550 --folder recordings/",
    )
    parser.add_argument("profile", type=Path, nargs="?", metavar="PROFILE", help="profile folder, as for 'fauio run'")
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
        report = {"status": worst(checks), "checks": [asdict(check) for check in checks]}
        sys.stdout.write(json.dumps(report) + "\n")
    else:
        sys.stdout.write(checks_text(checks))
    return FAILED if worst(checks) == "failed" else 0


def diagnose(needs: Needs) -> list[DoctorCheck]:
    """Run all checks."""
    from monitor.diagnosis.doctor_machine import buffer_check, clock_checks, disk_check, folder_check, serial_checks
    from monitor.diagnosis.doctor_network import (
        mavlink_check,
        metrics_check,
        round_trip_check,
        zenoh_file_check,
        zenoh_port_check,
    )

    checks = [*version_checks(), *(profile_check(folder) for folder in needs.profiles)]
    if needs.zenoh_config is None:
        checks += [zenoh_port_check(endpoint) for endpoint in needs.listen]
    else:
        checks.append(zenoh_file_check(needs.zenoh_config, needs.connect, needs.listen, needs.zenoh_mode))
    checks += [mavlink_check(url) for url in needs.mavlink if not url.startswith("serial:")]
    if needs.metrics is not None:
        checks.append(metrics_check(needs.metrics))
    checks.append(round_trip_check())
    checks += serial_checks([url for url in needs.mavlink if url.startswith("serial:")])
    for folder in needs.folders:
        checks += [folder_check(folder), disk_check(folder)]
    return [*checks, buffer_check(), *clock_checks()]


def version_checks() -> list[DoctorCheck]:
    """Check that libraries are there and new enough, and say which extras are."""
    from monitor.diagnosis.versions import libraries

    known = libraries()
    needed = [library for library in known if not library.extra]
    installed = ", ".join(f"{library.name} {library.installed}" for library in needed if library.installed)
    checks = [
        DoctorCheck("version", "ok", f"fauio {version('fauio')}, Python {platform.python_version()}"),
        DoctorCheck("libraries", "ok", installed),
    ]
    for library in needed:
        if not library.will_do:
            what = "is not installed" if library.installed is None else f"{library.installed} is too old"
            advice = (
                f"pip install '{library.name}>={library.least}'" if library.least else f"pip install {library.name}"
            )
            checks.append(DoctorCheck("libraries", "failed", f"{library.name} {what}", advice))
    extras = dict.fromkeys(library.extra for library in known if library.extra)
    for extra in extras:
        missing = [library.name for library in known if library.extra == extra and not library.will_do]
        state = f"without {', '.join(missing)}: pip install 'fauio[{extra}]' where it is wanted" if missing else "there"
        checks.append(DoctorCheck("extra", "ok", f"{extra}: {state}"))
    return checks


def profile_check(folder: Path) -> DoctorCheck:
    """Check that a profile can be used."""
    from monitor.profile import read_profile

    try:
        read_profile(folder)
    except (ValueError, OSError) as error:
        mistakes = "; ".join(str(error).splitlines())
        return DoctorCheck("profile", "failed", mistakes, "name the folder that 'fauio fit' made, or make it anew")
    return DoctorCheck("profile", "ok", f"{folder} can be used")


def worst(checks: Sequence[DoctorCheck]) -> DoctorVerdict:
    """Return the worst verdict."""
    return max((check.verdict for check in checks), key=VERDICTS.index, default="ok")


def checks_text(checks: Sequence[DoctorCheck]) -> str:
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
    profiles = () if args.profile is None else (args.profile,)
    if args.config is None:
        usual = Needs()
        places = folders or usual.folders
        return Needs(listen or usual.listen, mavlink or usual.mavlink, places, profiles=profiles)
    from monitor.configuration.config import read_config

    # as 'fauio run' does with what its command line gives
    given = {"profile": args.profile, "listen": args.listen, "mavlink": args.mavlink}
    config = read_config(args.config, {name: value for name, value in given.items() if value is not None})
    files = [path for path in (config.record, config.journal.path) if path is not None]
    places = [path for path in (config.recording.folder, config.black_box.folder) if path is not None]
    known = [*(vehicle.profile for vehicle in config.vehicles), config.new_vehicles.profile]
    return Needs(
        config.listen,
        config.mavlink,
        folders or tuple(dict.fromkeys([*places, *(path.parent for path in files)])),
        config.metrics.listen,
        config.connect,
        # an endpoint that was asked for is checked as it stands
        None if listen else config.zenoh_config,
        config.zenoh_mode,
        tuple(dict.fromkeys(folder for folder in known if folder is not None)),
    )
