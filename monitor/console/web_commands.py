"""``fauio console``: a web page of all monitors on the network."""

from __future__ import annotations

import argparse
import re
from pathlib import Path

from adapters.command_line import host_port, option, say
from adapters.errors import UsageError
from monitor.console.alarm_commands import add_endpoints, monitors

_SHORTEST = 16
"""Letters of a token. Chosen: nobody guesses so many random letters at one guess a second."""
_HOST_NAME = re.compile(r"[A-Za-z0-9.-]+")
_LOOK_S = 0.5
"""Seconds between two checks whether the server still runs."""


def add_console(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command."""
    console = subparsers.add_parser(
        "console",
        help="serve a web page of all vehicles: alarms, estimates, map, link",
        description="Serve a web page of all monitors that are reached over Zenoh: alarms, estimates with thresholds, "
        "link, track. The page only reads unless --commands is given. Ends on Ctrl-C or SIGTERM.",
        epilog="example: fauio console --commands --clips clips/",
    )
    add_endpoints(console)
    option(console, "--listen HOST:PORT", "address of the page (127.0.0.1:8600)", default="127.0.0.1:8600")
    option(
        console,
        "--commands",
        "let the page acknowledge, shelve and close alarms, if the monitor's configuration allows it",
    )
    option(
        console,
        "--token-file FILE",
        "file with the token that the page asks for; required unless --listen is on loopback",
        Path,
    )
    option(console, "--host NAME", "host name under which browsers reach the page", action="append", default=[])
    option(console, "--clips FOLDER", "folder of alarms' clips that the page offers for download", Path)
    console.set_defaults(handler=run_console)


def run_console(args: argparse.Namespace) -> int:
    """Serve the page until interrupted."""
    from monitor.bus.keys import ANY, vehicle_root
    from monitor.configuration.config_values import is_loopback
    from monitor.console.web_server import LISTEN, ConsoleOptions, ConsoleServer
    from monitor.service.caught_signals import caught_signals

    token = None if args.token_file is None else _token(args.token_file)
    host, _ = host_port("--listen", args.listen, LISTEN)
    if token is None and not is_loopback(host):
        raise UsageError(
            f"--listen {args.listen}: others could reach it, so it needs --token-file; or listen on 127.0.0.1 behind a "
            "reverse proxy that asks who it is"
        )
    if args.clips is not None and not args.clips.is_dir():
        raise UsageError(
            f"--clips {args.clips}: is no folder; name the one of [black_box] in the monitor's configuration"
        )
    for name in args.host:
        if not _HOST_NAME.fullmatch(name):
            raise UsageError(f"--host {name}: is no name of a machine; give it as browsers ask for it, without a port")
    vehicle_root(args.prefix, ANY)
    options = ConsoleOptions(args.listen, args.prefix, args.commands, token, args.host, args.clips)
    with caught_signals() as signals, monitors(args) as (session, where):
        server = ConsoleServer(session, options)
        try:
            say(f"{server.url} shows the monitors at {', '.join(where)}; Ctrl-C ends")
            while server.wait(_LOOK_S) and not signals:
                pass
        finally:
            server.close()
    return 130 if signals[:1] == [2] else 0


def _token(path: Path) -> str:
    try:
        token = path.read_text().strip()
    except (OSError, UnicodeDecodeError) as error:
        why = getattr(error, "strerror", None) or "no text"
        raise UsageError(f"--token-file {path}: {why}; make one: (umask 077; openssl rand -hex 16 > {path})") from error
    if len(token) < _SHORTEST or not token.isascii() or not token.isprintable():
        raise UsageError(
            f"{path}: holds no token of {_SHORTEST} letters or more; make one: openssl rand -hex 16 > {path}"
        )
    return token
