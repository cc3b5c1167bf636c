"""The ``fauio`` command line: gathers the commands of the packages, runs one, turns errors into one line.

Nothing heavy is imported here or in the packages' ``commands`` modules: each command loads what it uses.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from typing import Any

import adapters.commands
import gains.commands
import monitor.commands
import replay.commands
from monitor.console.completion import add_completion

INTERRUPTED = 130


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of all commands."""
    parser = argparse.ArgumentParser(
        prog="fauio",
        description="Fault and attack monitor for drones and ground vehicles: says which motor lost how much "
        "thrust, or by how many metres GPS is being walked away.",
        epilog="example: fauio fit --vehicle multirotor healthy1.tlog healthy2.tlog -o quad/ && "
        "fauio replay quad/ flight.tlog --alarms alarms.jsonl",
    )
    parser.add_argument(
        "--version", action=_PrintVersions, nargs=0, help="print the versions of fauio, Python and libraries, and exit"
    )
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for package in (replay.commands, gains.commands, monitor.commands, adapters.commands):
        package.add_parsers(commands)
    add_completion(commands, parser)
    return parser


class _PrintVersions(argparse.Action):
    """Print versions; they are looked up only when they are asked for."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        from monitor.diagnosis.versions import version_text

        sys.stdout.write(version_text())
        parser.exit()


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit status.

    Exit status: 0 done, 2 bad input or usage, 3 no feasible design, 4 alarms were raised (with
    ``--fail-on-alarm``), 130 interrupted.
    """
    args = build_parser().parse_args(argv)
    handler: Callable[[argparse.Namespace], int] = args.handler
    try:
        return handler(args)
    except KeyboardInterrupt:
        return INTERRUPTED
    except BrokenPipeError:
        sys.stderr.close()
        return 0
    except OSError as error:
        print(f"fauio: {error}", file=sys.stderr)  # noqa: T201 - the command line speaks here
        return 2
    except ValueError as error:
        status: int | None = getattr(error, "exit_status", None)
        if status is None:
            raise
        print(f"fauio: {error}", file=sys.stderr)  # noqa: T201 - the command line speaks here
        return status


if __name__ == "__main__":
    sys.exit(main())
