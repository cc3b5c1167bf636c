"""Commands of the monitor: ``fauio run``, ``fauio alarms`` and what goes with it, ``fauio schema`` and ``doctor``."""

from __future__ import annotations

import argparse
import functools
from pathlib import Path

from monitor.console.alarm_commands import add_alarms, add_schema
from monitor.diagnosis.doctor import add_doctor


def add_parsers(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the commands of this package."""
    _add_run(subparsers)
    add_alarms(subparsers)
    add_schema(subparsers)
    add_doctor(subparsers)


def _add_run(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    run = subparsers.add_parser(
        "run",
        help="monitor a live vehicle: the daemon",
        description="Listen to a vehicle's telemetry, estimate its faults, publish alarms on Zenoh. Sends nothing to "
        "the vehicle unless the configuration allows it. Ends on SIGTERM or Ctrl-C; SIGHUP reloads.",
        epilog="example: fauio run quad/ --mavlink udpin:127.0.0.1:14550 --record flight.mcap",
    )
    run.add_argument(
        "profile",
        type=Path,
        nargs="?",
        metavar="PROFILE",
        help="profile folder, made by 'fauio fit'; may be left out where --config names profiles",
    )
    source = run.add_mutually_exclusive_group()
    source.add_argument(
        "--mavlink",
        metavar="URL",
        help="udpin:HOST:PORT (the vehicle sends to us), udpout:HOST:PORT, "
        "tcp:HOST:PORT, tcpin:HOST:PORT or serial:DEVICE:BAUD",
    )
    source.add_argument("--zenoh", metavar="KEYEXPR", help="telemetry over Zenoh on these keys")
    run.add_argument("--config", type=Path, metavar="FILE.toml", help="configuration; options given here override it")
    run.add_argument("--vehicle", metavar="NAME", help="name in topics (default: the profile's)")
    run.add_argument(
        "--listen", metavar="ENDPOINT", action="append", help="Zenoh endpoint to listen on (tcp/127.0.0.1:7447)"
    )
    run.add_argument("--connect", metavar="ENDPOINT", action="append", help="Zenoh endpoint to connect to")
    run.add_argument(
        "--allow-public", action="store_true", help="let MAVLink, Zenoh and metrics listen beyond this machine"
    )
    run.add_argument("--prefix", metavar="KEY", help="what the keys begin with (fauio)")
    run.add_argument("--record", type=Path, metavar="OUT.mcap", help="record telemetry, estimates and alarms")
    run.add_argument(
        "--rerun",
        nargs="?",
        const="spawn",
        choices=["spawn", "serve"],
        help="show it live in Rerun: start a viewer, or serve one that connects to port 9876 of this machine",
    )
    run.add_argument("--json", action="store_true", help="log lines on stderr as JSON, also on a terminal")
    run.set_defaults(handler=run_run)


def run_run(args: argparse.Namespace) -> int:
    """Run the daemon until it is told to stop."""
    from monitor.configuration.config import read_config
    from monitor.service.live import run_live

    names = ("profile", "vehicle", "listen", "connect", "prefix", "record")
    given = {name: getattr(args, name) for name in names if getattr(args, name) is not None}
    if args.mavlink is not None or args.zenoh is not None:
        given |= {"mavlink": args.mavlink or (), "zenoh": args.zenoh or ()}
    if args.allow_public:
        given["allow_public"] = True
    if args.rerun is not None:
        given["rerun"] = {"mode": args.rerun}
    read = functools.partial(read_config, args.config, given)
    return run_live(read(), read, as_json=args.json)
