"""``fauio alarms`` and the commands on an alarm: ack, shelve, unshelve, reset; ``fauio schema``."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from adapters.command_line import option, remark, say
from adapters.zenoh.zenoh_session import DEFAULT_ENDPOINT, endpoints, open_session

if TYPE_CHECKING:
    import zenoh

    from monitor.bus.status_watch import StatusWatch
    from monitor.bus.subscriber import AlarmSubscriber
    from monitor.event import AlarmEvent

NOBODY_AFTER_S = 1.0
"""Seconds after which a message tells that no monitor was found. Chosen: a monitor on the network is discovered well
before, and a person waits that long without a message."""

_VERBS = {
    "ack": "confirm that you have seen an alarm",
    "shelve": "keep an alarm silent for a while",
    "unshelve": "end the shelving of an alarm",
    "reset": "end an alarm and restart its observer",
}


def add_alarms(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``fauio alarms`` and its commands."""
    alarms = subparsers.add_parser(
        "alarms",
        help="watch alarms as they happen; acknowledge, shelve, reset them",
        description="Show a live table of the active alarms, with keys to acknowledge and shelve them. In a pipe, "
        "print one JSON object per event, the current state of every alarm first.",
        epilog="example: fauio alarms --history",
    )
    _add_where(alarms, vehicle="only this vehicle (default: all)")
    option(alarms, "--history", "begin with the past events in the monitor's journal")
    option(alarms, "--json", "print JSON lines, on a terminal too")
    option(alarms, "--for S", "stop after this many seconds (default: never)", float, dest="seconds")
    alarms.set_defaults(handler=run_alarms)
    commands = alarms.add_subparsers(dest="verb", metavar="COMMAND", title="commands")
    for verb, what in _VERBS.items():
        command = commands.add_parser(
            verb,
            help=what,
            description=f"{what[0].upper()}{what[1:]}; the monitor's configuration has to allow it.",
            epilog=f"example: fauio alarms {verb} motors/motor1 --reason 'landing'",
        )
        option(command, "target ID|CHANNEL", "the alarm: its id, motors/motor1, or motor1")
        if verb == "shelve":
            option(command, "--minutes N", "minutes to shelve (default: the monitor's setting)", float)
        option(command, "--reason TEXT", "reason, kept in the journal")
        option(command, "--by NAME", "operator, kept in the journal (default: your user name)")
        option(command, "--json", "print the reply as JSON", default=argparse.SUPPRESS)
        # these options are also accepted before the command: a default here must not override a value given there
        _add_where(command, vehicle="vehicle of the alarm (default: found by the alarm)", default=argparse.SUPPRESS)
        command.set_defaults(handler=run_command)


def add_schema(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``fauio schema``."""
    schema = subparsers.add_parser(
        "schema",
        help="print the JSON Schemas of published payloads",
        description="Print the JSON Schema of one kind of payload; without a name, all of them by name.",
        epilog="example: fauio schema alarm",
    )
    option(
        schema,
        "name NAME",
        "alarm, alarms, estimate, status, command_request, command_reply or command_error (default: all)",
        nargs="?",
    )
    schema.set_defaults(handler=run_schema)


def _add_where(parser: argparse.ArgumentParser, vehicle: str, default: str | None = None) -> None:
    option(parser, "--vehicle NAME", vehicle, default=default or "*")
    add_endpoints(parser, default)


def add_endpoints(parser: argparse.ArgumentParser, default: str | None = None) -> None:
    """Add the options that tell where monitors are reached over Zenoh."""
    option(
        parser,
        "--connect ENDPOINT",
        f"Zenoh endpoint of a monitor or a router, may be repeated (default: {DEFAULT_ENDPOINT})",
        action="append",
        default=default,
    )
    option(
        parser,
        "--zenoh-config FILE",
        "Zenoh configuration with certificates or password, for a secured monitor; its endpoints are used",
        Path,
        default=default,
    )
    option(parser, "--prefix KEY", "first part of the Zenoh keys (default: fauio)", default=default or "fauio")


@contextmanager
def monitors(args: argparse.Namespace) -> Iterator[tuple[zenoh.Session, Sequence[str]]]:
    """Open a session with the monitors that the command line names; yield it and their endpoints."""
    connect = args.connect or [DEFAULT_ENDPOINT]
    where = endpoints("connect", connect, args.zenoh_config)
    # a session left open would keep the process alive for ever
    with open_session(connect=connect, config_file=args.zenoh_config) as session:
        yield session, where


def run_alarms(args: argparse.Namespace) -> int:
    """Show alarms until interrupted or for the given time: a table on a terminal, JSON lines in a pipe."""
    from monitor.bus.alarm_text import alarm_line
    from monitor.bus.payload import to_json
    from monitor.bus.status_watch import StatusWatch
    from monitor.bus.subscriber import AlarmSubscriber

    named = "" if args.vehicle == "*" else f" of '{args.vehicle}'"
    until = float("inf") if args.seconds is None else time.monotonic() + args.seconds
    with monitors(args) as (session, where):
        nobody = f"no monitor{named} at {', '.join(where)}"
        subscriber = AlarmSubscriber(session, args.vehicle, args.prefix, args.history)
        statuses = StatusWatch(session, args.vehicle, args.prefix)
        if args.json or not sys.stdout.isatty():
            _print_lines(subscriber, statuses, nobody, until, lambda event: to_json(event.to_json()).decode())
            return 0
        from monitor.bus.estimate_watch import EstimateWatch
        from monitor.console.alarm_view import can_redraw, watch
        from monitor.console.operator_client import send_command

        if can_redraw():

            def ask(verb: str, vehicle: str, request: Mapping[str, Any]) -> None:
                send_command(session, args.prefix, vehicle, verb, {"by": _user(), **request})

            watch(subscriber, statuses, EstimateWatch(session, args.vehicle, args.prefix), ask, where, until)
        else:
            _print_lines(subscriber, statuses, nobody, until, alarm_line)
    return 0


def _print_lines(
    subscriber: AlarmSubscriber,
    statuses: StatusWatch,
    nobody: str,
    until: float,
    as_text: Callable[[AlarmEvent], str],
) -> None:
    started = time.monotonic()
    live: frozenset[str] = frozenset()
    said: dict[str, tuple[str, ...]] = {}
    silent = True
    while (now := time.monotonic()) < until:
        event = subscriber.receive(min(0.2, until - now))
        if event is not None:
            sys.stdout.write(as_text(event) + "\n")
            sys.stdout.flush()
        before, live = live, subscriber.live
        for vehicle in sorted(live - before):
            remark(f"monitor of {vehicle} is there")
        for vehicle in sorted(before - live):
            remark(f"monitor of {vehicle} is gone; waiting for it")
        for status in statuses.latest():
            if status.kind != said.get(status.vehicle) and (not status.well or status.vehicle in said):
                said[status.vehicle] = status.kind
                remark(status.line())
        if silent and not live and now - started >= NOBODY_AFTER_S:
            remark(f"{nobody} yet; waiting (start one with 'fauio run')")
        silent = silent and not live and now - started < NOBODY_AFTER_S


def run_command(args: argparse.Namespace) -> int:
    """Send a command on an alarm to its monitor, print the result."""
    from monitor.bus.alarm_text import alarm_line
    from monitor.bus.payload import to_json
    from monitor.console.operator_client import find_target, send_command
    from monitor.event import valid_event

    details = {"by": args.by or _user(), "reason": args.reason, "minutes": getattr(args, "minutes", None)}
    with monitors(args) as (session, where):
        target = find_target(session, args.target, args.prefix, args.vehicle, where)
        request = target.request | {key: value for key, value in details.items() if value is not None}
        reply = send_command(session, args.prefix, target.vehicle, args.verb, request)
    if args.json:
        sys.stdout.write(to_json(reply).decode() + "\n")
    else:
        event = valid_event(reply.get("event"))
        say(f"{args.verb} {args.target}: done" if event is None else alarm_line(event))
    return 0


def run_schema(args: argparse.Namespace) -> int:
    """Print one JSON Schema, or all."""
    from monitor.bus.schemas import schema_text

    sys.stdout.write(schema_text(args.name))
    return 0


def _user() -> str:
    import getpass

    try:
        return getpass.getuser()
    except (KeyError, OSError):  # no such user, as in many containers
        return "unknown"
