"""``fauio notify``: sends a message by hand, so that nobody finds out at the first alarm that none comes."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Any


def add_notify(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        "notify",
        help="try the notifications of a configuration",
        description="Send a test message to everything that [notify] of a configuration names, and say what became of "
        "it. Exit status 2 where one was not delivered.",
        epilog="example: fauio notify --config run.toml --test",
    )
    parser.add_argument("--config", type=Path, required=True, metavar="FILE.toml", help="configuration of the daemon")
    parser.add_argument("--test", action="store_true", required=True, help="send it")
    parser.set_defaults(handler=run_notify)


def run_notify(args: argparse.Namespace) -> int:
    """Send a test message to each outlet; return 2 where one fails."""
    from adapters.errors import UsageError, printable
    from monitor.configuration.config import read_config
    from monitor.event import fixed_rule_event
    from monitor.notify.notices import Notice
    from monitor.notify.outlets import DeliveryError, make_outlets

    notify = read_config(args.config, links_only=True).notify
    outlets = make_outlets(notify.urls_file, notify.exec, notify.exec_timeout_s)
    if not outlets:
        raise UsageError(f"{args.config}: [notify] names neither urls_file nor exec; nobody would be told")
    details: dict[str, Any] = {"kind": "system", "state": "raised", "unit": "", "threshold": 0.0, "vehicle_time_ms": 0}
    message = "a test of fauio's notifications: no alarm"
    event = fixed_rule_event("test", "monitor", "test", time_ns=time.time_ns(), message=message, **details)
    failed = False
    for outlet in outlets:
        try:
            outlet.send([Notice("raised", event)])
        except DeliveryError as error:
            failed = True
            sys.stdout.write(printable(f"{outlet.name}: FAILED: {error}") + "\n")
        else:
            sys.stdout.write(f"{outlet.name}: delivered\n")
    return 2 if failed else 0
