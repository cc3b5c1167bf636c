"""Commands beside a vehicle: ``fauio record``, ``run``, ``recover``, ``alarms`` and its subcommands, and others."""

from __future__ import annotations

import argparse
import functools
import math
import time
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from adapters.command_line import option, say, say_json
from monitor.console.alarm_commands import add_alarms, add_schema
from monitor.console.web_commands import add_console
from monitor.diagnosis.doctor import add_doctor
from monitor.recording.recover import add_recover


def add_parsers(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the commands of this package."""
    _add_record(subparsers)
    _add_run(subparsers)
    add_recover(subparsers)
    add_alarms(subparsers)
    add_console(subparsers)
    add_schema(subparsers)
    _add_notify(subparsers)
    add_doctor(subparsers)


def _add_record(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    record = subparsers.add_parser(
        "record",
        help="record live telemetry, for a first fit",
        description="Record a vehicle's telemetry without a profile, for instance a healthy flight for a fit. "
        "All senders on the link are recorded. Sends nothing to the vehicle unless the configuration allows it; then "
        "it requests the rates of [send]. Ends on Ctrl-C, SIGTERM or after --seconds.",
        epilog="example: fauio record --mavlink udpin:127.0.0.1:14550 -o monday.mcap",
    )
    _add_source(record)
    option(record, "-o --out OUT.mcap", "file to write", Path, required=True)
    option(record, "--seconds S", "end this long after the first message (default: on Ctrl-C)", _seconds)
    option(record, "--config FILE.toml", "configuration: links, signing, message rates, Zenoh", Path)
    _add_endpoints(record)
    option(record, "--json", "print a summary as one JSON object")
    record.set_defaults(handler=run_record)


def _add_run(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    run = subparsers.add_parser(
        "run",
        help="monitor a live vehicle (the daemon)",
        description="Receive a vehicle's telemetry, estimate its faults, and publish alarms on Zenoh. Sends nothing to "
        "the vehicle unless the configuration allows it. Ends on SIGTERM or Ctrl-C; SIGHUP reloads the configuration.",
        epilog="example: fauio run quad/ --mavlink udpin:127.0.0.1:14550 --record flight.mcap",
    )
    option(
        run,
        "profile PROFILE",
        "profile folder, made by 'fauio fit'; may be left out if --config names profiles",
        Path,
        nargs="?",
    )
    _add_source(run)
    option(run, "--config FILE.toml", "configuration; options given here override it", Path)
    option(run, "--vehicle NAME", "name in topics (default: the profile's)")
    _add_endpoints(run)
    option(run, "--force", "watch a vehicle even if it is another one than the profile's")
    option(run, "--prefix KEY", "first part of the Zenoh keys (fauio)")
    option(run, "--record OUT.mcap", "record telemetry, estimates and alarms", Path)
    run.add_argument(
        "--rerun",
        nargs="?",
        const="spawn",
        choices=["spawn", "serve"],
        help="show estimates live in Rerun: start a viewer, or serve viewers on a port of this machine",
    )
    option(run, "--rerun-port PORT", "port of '--rerun serve' (9876)", int)
    option(run, "--json", "write log lines to stderr as JSON, on a terminal too")
    run.set_defaults(handler=run_run)


def _add_notify(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = subparsers.add_parser(
        "notify",
        help="send a test message to the services of a configuration",
        description="Send a test message to all services and programs of [notify] in a configuration, and report "
        "which were delivered. Exit status 2 if one was not.",
        epilog="example: fauio notify --config run.toml --test",
    )
    option(parser, "--config FILE.toml", "configuration of the daemon", Path, required=True)
    option(parser, "--test", "send the test message", required=True)
    parser.set_defaults(handler=run_notify)


def _add_source(command: argparse.ArgumentParser) -> None:
    source = command.add_mutually_exclusive_group()
    option(
        source,
        "--mavlink URL",
        "udpin:HOST:PORT (the vehicle sends to this address), udpout:HOST:PORT, "
        "tcp:HOST:PORT, tcpin:HOST:PORT or serial:DEVICE:BAUD",
    )
    option(source, "--zenoh KEYEXPR", "telemetry over Zenoh on these keys")


def _add_endpoints(command: argparse.ArgumentParser) -> None:
    option(command, "--listen ENDPOINT", "Zenoh endpoint to listen on (tcp/127.0.0.1:7447)", action="append")
    option(command, "--connect ENDPOINT", "Zenoh endpoint to connect to", action="append")
    option(command, "--allow-public", "let MAVLink, Zenoh and metrics listen beyond this machine")


def _seconds(text: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not 0.0 < seconds < math.inf:
        raise argparse.ArgumentTypeError(f"'{text}' is no time in seconds above 0")
    return seconds


def _given(args: argparse.Namespace, names: Iterable[str]) -> dict[str, Any]:
    """Return the part of the configuration that the command line gives."""
    given = {name: getattr(args, name) for name in names if getattr(args, name) is not None}
    if args.mavlink is not None or args.zenoh is not None:
        given |= {"mavlink": args.mavlink or (), "zenoh": args.zenoh or ()}
    return given | ({"allow_public": True} if args.allow_public else {})


def run_record(args: argparse.Namespace) -> int:
    """Record until a signal ends it."""
    from monitor.configuration.config import read_config
    from monitor.service.record_live import record_live

    config = read_config(args.config, _given(args, ("listen", "connect")), links_only=True)
    recording = record_live(config, args.out, args.seconds, as_json=args.json)
    if args.json:
        say_json({"file": str(args.out)} | asdict(recording))
    else:
        senders = f", from system {', '.join(map(str, recording.systems))}" if recording.systems else ""
        lost = f"; {recording.dropped} more came too fast" if recording.dropped else ""
        counts = f"{recording.messages} messages of {recording.names} kinds in {recording.seconds:.1f} s"
        say(f"{args.out}: {counts}{senders}{lost}", f"See what can be fitted to it: fauio info {args.out}")
    return 130 if recording.interrupted else 0


def run_run(args: argparse.Namespace) -> int:
    """Run the daemon until a signal ends it."""
    from monitor.configuration.config import read_config
    from monitor.service.live import run_live

    names = ("profile", "vehicle", "listen", "connect", "prefix", "record")
    given = _given(args, names)
    rerun = {"mode": args.rerun, "port": args.rerun_port}
    if shown := {key: value for key, value in rerun.items() if value is not None}:
        given["rerun"] = shown
    if args.force:
        given["force"] = True
    read = functools.partial(read_config, args.config, given)
    return run_live(read(), read, as_json=args.json, refuse=args.config is None)


def run_notify(args: argparse.Namespace) -> int:
    """Send a test message to each outlet, so that a broken outlet is found before the first alarm."""
    from adapters.errors import UsageError
    from monitor.configuration.config import read_config
    from monitor.event import fixed_rule_event
    from monitor.notify.notices import Notice
    from monitor.notify.outlets import DeliveryError, make_outlets

    notify = read_config(args.config, links_only=True).notify
    outlets = make_outlets(notify.urls_file, notify.exec, notify.exec_timeout_s)
    if not outlets:
        raise UsageError(f"{args.config}: [notify] names neither urls_file nor exec; nobody would be notified")
    details: dict[str, Any] = {"kind": "system", "state": "raised", "unit": "", "threshold": 0.0, "vehicle_time_ms": 0}
    message = "a test of fauio's notifications: no alarm"
    event = fixed_rule_event("test", "monitor", "test", time_ns=time.time_ns(), message=message, **details)
    failed = False
    for outlet in outlets:
        try:
            outlet.send([Notice("raised", event)])
        except DeliveryError as error:
            failed = True
            say(f"{outlet.name}: FAILED: {error}")
        else:
            say(f"{outlet.name}: delivered")
    return 2 if failed else 0
