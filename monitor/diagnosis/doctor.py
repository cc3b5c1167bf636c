"""``fauio doctor``: checks whether a monitor will run on this machine, and tells what to do if not."""

from __future__ import annotations

import argparse
import platform
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from adapters.command_line import option, say_json

if TYPE_CHECKING:
    from monitor.configuration.config import Config

FAILED = 2
"""Exit status, as for any other mistake: docs/reference/exit-status.md."""

DoctorVerdict = Literal["ok", "warning", "failed"]
VERDICTS: tuple[DoctorVerdict, ...] = ("ok", "warning", "failed")
_OF_DEVELOPERS = ("bench", "dev", "docs", "fuzz")
"""Extras that no command asks for."""


@dataclass(frozen=True, slots=True)
class DoctorCheck:
    """The result of one check of the machine."""

    name: str
    # ``failed``: the monitor will not run, or not here; ``warning``: it will run, but not with everything
    verdict: DoctorVerdict
    found: str  # the result, for people
    advice: str = ""  # what to do about it; empty if nothing has to be done


def add_doctor(subparsers: Any) -> None:
    """Add the command to the command line."""
    parser = subparsers.add_parser(
        "doctor",
        help="check whether a monitor can run here: ports, permissions, Zenoh, clock, versions",
        description="Check ports, permissions, Zenoh, clock, disk, receive buffers and versions, and report remedies. "
        "Exit status: 0 no check failed, 2 a check failed.",
        epilog="example: fauio doctor --mavlink udpin:127.0.0.1:14550 --folder recordings/",
    )
    option(parser, "profile PROFILE", "profile folder, as for 'fauio run'", Path, nargs="?")
    option(parser, "--config FILE.toml", "check what this configuration uses", Path)
    option(parser, "--listen ENDPOINT", "Zenoh endpoint to listen on (tcp/127.0.0.1:7447)", action="append")
    option(parser, "--mavlink URL", "MAVLink link to listen on (udpin:127.0.0.1:14550)", action="append")
    option(parser, "--folder DIR", "folder to write to (the current folder)", Path, action="append")
    option(parser, "--json", "print one JSON object")
    parser.set_defaults(handler=run_doctor)


def run_doctor(args: argparse.Namespace) -> int:
    """Run ``fauio doctor``."""
    checks = diagnose(*_needs(args))
    if args.json:
        say_json({"status": worst(checks), "checks": [asdict(check) for check in checks]})
    else:
        sys.stdout.write(checks_text(checks))
    return FAILED if worst(checks) == "failed" else 0


def diagnose(config: Config, folders: Sequence[Path]) -> list[DoctorCheck]:
    """Check all that a monitor of this configuration needs, and folders to write to, which need not exist yet."""
    from monitor.diagnosis import doctor_machine as machine
    from monitor.diagnosis import doctor_network as network

    profiles = dict.fromkeys([*(vehicle.profile for vehicle in config.vehicles), config.new_vehicles.profile])
    checks = [*version_checks(), *(profile_check(folder) for folder in profiles if folder is not None)]
    if config.zenoh_config is None:
        checks += [network.zenoh_port_check(endpoint) for endpoint in config.listen]
    else:
        checks.append(network.zenoh_file_check(config.zenoh_config, config.connect, config.listen, config.zenoh_mode))
    serial = [url for url in config.mavlink if url.startswith("serial:")]
    checks += [network.mavlink_check(url) for url in config.mavlink if url not in serial]
    if config.metrics.listen is not None:
        checks.append(network.metrics_check(config.metrics.listen))
    checks += [network.round_trip_check(), *machine.serial_checks(serial)]
    for folder in folders:
        checks += [machine.folder_check(folder), machine.disk_check(folder)]
    return [*checks, machine.buffer_check(), *machine.clock_checks()]


def version_checks() -> list[DoctorCheck]:
    """Check that libraries are installed and new enough, and list the installed extras."""
    from importlib.metadata import version

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
    extras = dict.fromkeys(library.extra for library in known if library.extra not in ("", *_OF_DEVELOPERS))
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
    """Return the results for people: a line for each check, and another if something has to be done."""
    width = max((len(check.name) for check in checks), default=0)
    lines = []
    for check in checks:
        lines.append(f"{check.verdict:<8} {check.name:<{width}}  {check.found}")
        if check.advice:
            lines.append(f"{'':<{9 + width}}  -> {check.advice}")
    counts = [sum(check.verdict == verdict for check in checks) for verdict in VERDICTS]
    lines.append(f"{counts[0]} ok, {counts[1]} to look at, {counts[2]} failed")
    return "\n".join(lines) + "\n"


def _needs(args: argparse.Namespace) -> tuple[Config, Sequence[Path]]:
    """Return the configuration of a monitor, and the folders that it writes to."""
    from monitor.configuration.config import Config, read_config

    given = {"profile": args.profile, "listen": args.listen, "mavlink": args.mavlink}
    given = {name: value for name, value in given.items() if value is not None}
    if args.config is None:
        return Config(**{"mavlink": ("udpin:127.0.0.1:14550",)} | given), args.folder or (Path(),)
    # as 'fauio run' does with the values of its command line
    config = read_config(args.config, given)
    if args.listen:
        # an endpoint given on the command line is checked as it stands
        config = replace(config, zenoh_config=None)
    places = [config.recording.folder, config.black_box.folder]
    places += [path.parent for path in (config.record, config.journal.path) if path is not None]
    return config, args.folder or [place for place in dict.fromkeys(places) if place is not None]
