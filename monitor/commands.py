"""Commands of the monitor: ``fauio run`` and ``fauio alarms``."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

DEFAULT_CONNECT = "tcp/127.0.0.1:7447"
NOBODY_AFTER_S = 1.0


def add_parsers(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the commands of this package."""
    _add_run(subparsers)
    alarms = subparsers.add_parser(
        "alarms",
        help="print alarms as they happen",
        description="Prints the current state of every alarm and then each change, one line per event.",
    )
    alarms.add_argument("--vehicle", metavar="NAME", default="*", help="only this vehicle (default: all)")
    alarms.add_argument("--history", action="store_true", help="begin with past events the monitor still knows")
    alarms.add_argument("--json", action="store_true", help="one JSON object per line")
    alarms.add_argument(
        "--connect",
        metavar="ENDPOINT",
        action="append",
        help=f"Zenoh endpoint of the monitor or a router, may be repeated (default: {DEFAULT_CONNECT})",
    )
    alarms.add_argument("--prefix", default="fauio", help="what the keys begin with (default: fauio)")
    alarms.add_argument(
        "--for", dest="seconds", metavar="SECONDS", type=float, help="stop after this time (default: never)"
    )
    alarms.set_defaults(handler=run_alarms)


def _add_run(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    run = subparsers.add_parser(
        "run",
        help="monitor a live vehicle: the daemon",
        description="Listen to a vehicle's telemetry, estimate its faults, publish alarms on Zenoh. Sends nothing to "
        "the vehicle. Ends on SIGTERM or Ctrl-C.",
        epilog="example: fauio run quad/ --mavlink udpin:127.0.0.1:14550 --record flight.mcap",
    )
    run.add_argument("profile", type=Path, metavar="PROFILE", help="profile folder, made by 'fauio fit'")
    source = run.add_mutually_exclusive_group()
    source.add_argument(
        "--mavlink", metavar="URL", help="udpin:HOST:PORT, udpout:..., tcp:HOST:PORT or serial:DEVICE:BAUD"
    )
    source.add_argument("--zenoh", metavar="KEYEXPR", help="telemetry as JSON on these keys")
    run.add_argument("--config", type=Path, metavar="FILE.toml", help="configuration; options given here override it")
    run.add_argument("--vehicle", metavar="NAME", help="name in topics (default: the profile's)")
    run.add_argument(
        "--listen", metavar="ENDPOINT", action="append", help="Zenoh endpoint to listen on (tcp/127.0.0.1:7447)"
    )
    run.add_argument("--connect", metavar="ENDPOINT", action="append", help="Zenoh endpoint to connect to")
    run.add_argument("--prefix", help="what the keys begin with (fauio)")
    run.add_argument("--record", metavar="OUT.mcap", help="record telemetry, estimates and alarms")
    run.add_argument("--json", action="store_true", help="log lines on stderr as JSON, also on a terminal")
    run.set_defaults(handler=run_run)


def run_run(args: argparse.Namespace) -> int:
    """Run the daemon until it is told to stop."""
    from dataclasses import replace

    from monitor.config import Config, read_config
    from monitor.live import run_live

    config = read_config(args.config) if args.config is not None else Config()
    if args.mavlink is not None or args.zenoh is not None:
        config = replace(config, mavlink=args.mavlink, zenoh=args.zenoh)
    given = {name: getattr(args, name) for name in ("vehicle", "prefix", "record")}
    given |= {name: tuple(getattr(args, name)) for name in ("listen", "connect") if getattr(args, name)}
    config = replace(config, **{name: value for name, value in given.items() if value is not None})
    return run_live(args.profile, config, as_json=args.json)


def run_alarms(args: argparse.Namespace) -> int:
    """Print alarm events until interrupted or for the time asked."""
    from adapters.zenoh_session import open_session
    from monitor.alarm_text import alarm_line
    from monitor.payload import to_json
    from monitor.subscriber import AlarmSubscriber

    endpoints = args.connect or [DEFAULT_CONNECT]
    started = time.monotonic()
    until = float("inf") if args.seconds is None else started + args.seconds
    # a session left open would keep the process alive for ever
    with open_session(connect=endpoints) as session:
        subscriber = AlarmSubscriber(session, args.vehicle, args.prefix, args.history)
        live: frozenset[str] = frozenset()
        silent = True
        while (now := time.monotonic()) < until:
            event = subscriber.receive(min(0.2, until - now))
            if event is not None:
                text = to_json(event.to_json()).decode() if args.json else alarm_line(event)
                sys.stdout.write(text + "\n")
                sys.stdout.flush()
            before, live = live, subscriber.live
            for vehicle in sorted(live - before):
                _say(f"monitor of {vehicle} is there")
            for vehicle in sorted(before - live):
                _say(f"monitor of {vehicle} is gone; waiting for it")
            if silent and not live and now - started >= NOBODY_AFTER_S:
                _say(f"no monitor at {', '.join(endpoints)} yet; waiting (start one with 'fauio run')")
            silent = silent and not live and now - started < NOBODY_AFTER_S
    return 0


def _say(text: str) -> None:
    sys.stderr.write(f"fauio: {text}\n")
    sys.stderr.flush()
