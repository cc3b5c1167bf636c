"""Fault and attack monitor for drones and ground vehicles: the command line, and the library.

As a library, ``import fauio`` gives what ``__all__`` lists; ``docs/library.md`` shows how to use it:

======================  ================================================================================
read_batches            the messages of a recording, as batches of columns
read_recording          the same messages one by one
read_profile, Profile   the models, gains, channels and thresholds of a vehicle
replay, Replay          find faults in a recording
Pipeline                find faults in live telemetry; pack makes batches of messages
fit, FitReport          learn a vehicle from recordings of healthy flights
check, Check            which faults of a plant can be told apart
design, Gains           design an observer for a plant; read_gains and write_gains store it
open_session,           receive the alarms of running monitors over Zenoh
AlarmSubscriber
FauioError ...          errors, all subclasses of one: adapters/errors.py
======================  ================================================================================

The command line collects the commands of the packages, runs one, and turns errors into lines on stderr. Nothing
heavy is imported here or in the packages' ``commands`` modules: each command, and each name of the library, loads what
it uses.
"""

from __future__ import annotations

import argparse
import errno
import functools
import importlib
import os
import sys
import textwrap
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any, NoReturn

from adapters import commands as adapters_commands
from adapters.command_line import finite, whole
from adapters.errors import (
    ConfigError,
    FauioError,
    InaccurateError,
    InfeasibleError,
    ModelError,
    ProfileError,
    StorageError,
    TelemetryError,
    UsageError,
    printable,
)
from gains import commands as gains_commands
from monitor import commands as monitor_commands
from monitor.console.completion import add_completion
from replay import commands as replay_commands

if TYPE_CHECKING:
    from adapters.batch import Batch, pack
    from adapters.logs.recordings import read_batches, read_recording
    from adapters.message import Message
    from adapters.source import MAVLINK, ZENOH
    from adapters.zenoh.zenoh_session import open_session
    from gains.analysis.check import Check
    from gains.plants.model_file import load_model, read_model, write_model
    from gains.plants.plant import Plant
    from gains.synthesis.gains_file import Gains, read_gains, write_gains
    from monitor.bus.subscriber import AlarmSubscriber
    from monitor.estimate import Estimates
    from monitor.event import AlarmEvent
    from monitor.pipeline import Pipeline
    from monitor.profile import Profile, read_profile
    from replay.api import check, design, fit, replay
    from replay.fit import FitReport
    from replay.player import Replay

    __version__: str

__all__ = [
    "MAVLINK",
    "ZENOH",
    "AlarmEvent",
    "AlarmSubscriber",
    "Batch",
    "Check",
    "ConfigError",
    "Estimates",
    "FauioError",
    "FitReport",
    "Gains",
    "InaccurateError",
    "InfeasibleError",
    "Message",
    "ModelError",
    "Pipeline",
    "Plant",
    "Profile",
    "ProfileError",
    "Replay",
    "StorageError",
    "TelemetryError",
    "UsageError",
    "__version__",
    "check",
    "design",
    "fit",
    "load_model",
    "open_session",
    "pack",
    "read_batches",
    "read_gains",
    "read_model",
    "read_profile",
    "read_recording",
    "replay",
    "write_gains",
    "write_model",
]

_PLACES = {
    "adapters.batch": ("Batch", "pack"),
    "adapters.logs.recordings": ("read_batches", "read_recording"),
    "adapters.message": ("Message",),
    "adapters.source": ("MAVLINK", "ZENOH"),
    "adapters.zenoh.zenoh_session": ("open_session",),
    "gains.analysis.check": ("Check",),
    "gains.plants.model_file": ("load_model", "read_model", "write_model"),
    "gains.plants.plant": ("Plant",),
    "gains.synthesis.gains_file": ("Gains", "read_gains", "write_gains"),
    "monitor.bus.subscriber": ("AlarmSubscriber",),
    "monitor.estimate": ("Estimates",),
    "monitor.event": ("AlarmEvent",),
    "monitor.pipeline": ("Pipeline",),
    "monitor.profile": ("Profile", "read_profile"),
    "replay.fit": ("FitReport",),
    "replay.api": ("check", "design", "fit", "replay"),
    "replay.player": ("Replay",),
}
"""Modules of the library's names; each is imported when one of its names is first asked for."""

INTERRUPTED = 130
USAGE = 2
EXAMPLE = "example: "

_DESCRIPTION = (
    "Fault and attack monitor for drones and ground vehicles: it names the motor that lost thrust, and how much, or "
    "how many metres GPS has been pulled off course."
)
_FIRST_STEPS = """\
first steps:
  fauio demo copter                a recorded flight: no vehicle is needed
  fauio fit --vehicle multirotor monday.tlog tuesday.tlog -o quad/
                                   fit a profile to healthy flights
  fauio replay quad/ flight.tlog   find faults in a recording
  fauio run quad/ --mavlink udpin:127.0.0.1:14550
                                   watch it live
  fauio alarms                     in another terminal: its active alarms
"""
_GROUPS = {
    "your vehicle": ("record", "fit", "replay", "watch", "run", "alarms", "console", "notify"),
    "recordings": ("review", "trend", "info", "convert", "recover", "inject", "detectability"),
    "models and observers": ("check", "design", "simulate"),
    "this machine": ("demo", "doctor", "schema", "completion"),
}
_LAST_LINES = """\
'fauio help COMMAND' shows the options, defaults and an example of a command.

Exit status: 0 done, 1 something wrong found (review), 2 bad input or usage, 3 no feasible design, 4 alarms were
raised (with --fail-on-alarm), 5 something critical found (review), 130 interrupted.
"""
_ADVICE = {
    errno.ENOENT: "; does its folder exist?",
    errno.EACCES: "; name another path, or run as a user who may",
    errno.EISDIR: "; name a file",
    errno.ENOTDIR: "; a part of the path is a file",
    errno.ENOSPC: "; free some space, or write elsewhere",
    errno.EROFS: "; write elsewhere",
}


def __getattr__(name: str) -> Any:
    """Import a name of the library when it is first used."""
    if name == "__version__":
        from importlib.metadata import version

        return version("fauio")
    for module, names in _PLACES.items():
        if name in names:
            value = getattr(importlib.import_module(module), name)
            globals()[name] = value
            return value
    raise AttributeError(f"module 'fauio' has no attribute '{name}'")


def __dir__() -> list[str]:
    """Return the names of the library and of the command line."""
    return sorted({*globals(), *__all__})


@functools.cache
def build_parser() -> argparse.ArgumentParser:
    """Return the parser of all commands; who runs several in one process waits for it once."""
    parser = _Parser(prog="fauio", usage="fauio [-h] [--version] COMMAND ...", description=_DESCRIPTION)
    parser.add_argument(
        "--version", action=_PrintVersions, nargs=0, help="print the versions of fauio, Python and libraries, and exit"
    )
    commands = parser.add_subparsers(
        dest="command", metavar="COMMAND", required=True, help=argparse.SUPPRESS, prog="fauio"
    )
    for package in (replay_commands, gains_commands, monitor_commands, adapters_commands):
        package.add_parsers(commands)
    add_completion(commands, parser)
    parser.epilog = _overview((action.dest, action.help or "") for action in commands._get_subactions())
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit status.

    Without arguments the overview is printed; ``help COMMAND`` is ``COMMAND --help``. Exit status: 0 done, 1 something
    wrong found (review), 2 bad input or usage, 3 no feasible design, 4 alarms were raised (with ``--fail-on-alarm``),
    5 something critical found (review), 130 interrupted.
    """
    given = list(sys.argv[1:] if argv is None else argv)
    if not given or given[0] == "help":
        given = [*given[1:], "--help"]
    try:
        try:
            return _run(given)
        finally:
            # a closed pipe has to raise its error here, not while the interpreter ends
            sys.stdout.flush()
    except KeyboardInterrupt:
        return INTERRUPTED
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


def _run(argv: Sequence[str]) -> int:
    args = build_parser().parse_args(argv)
    handler: Callable[[argparse.Namespace], int] = args.handler
    try:
        return handler(args)
    except BrokenPipeError:
        raise
    except OSError as error:
        return _complain(_os_error_line(error), USAGE)
    except FauioError as error:
        return _complain(str(error), error.exit_status)


def _complain(line: str, status: int) -> int:
    # a file's name may hold control characters, which a terminal obeys
    sys.stderr.write("\n".join(map(printable, f"fauio: {line}".split("\n"))) + "\n")
    return status


def _os_error_line(error: OSError) -> str:
    if error.strerror is None:
        return str(error)
    named = "" if error.filename is None else f"{error.filename}: "
    return f"{named}{error.strerror}{_ADVICE.get(error.errno or 0, '')}"


class _PrintVersions(argparse.Action):
    """Print versions, which are looked up only when they are requested."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        from monitor.diagnosis.versions import version_text

        sys.stdout.write(version_text())
        parser.exit()


class _Format(argparse.HelpFormatter):
    """Help text that keeps indented lines and examples unwrapped: an example broken in two does not run."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=26)

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        lines: list[str] = []
        running: list[str] = []
        for line in [*text.splitlines(), ""]:
            as_it_is = not line or line.startswith((" ", EXAMPLE)) or line.endswith(":")
            if as_it_is and running:
                lines += textwrap.wrap(" ".join(running), width, initial_indent=indent, subsequent_indent=indent)
                running = []
            if as_it_is:
                lines.append(indent + line)
            else:
                running.append(line.strip())
        return "\n".join(lines).rstrip()


class _Parser(argparse.ArgumentParser):
    """A parser whose errors are one line: the mistake and the probable intention; commands get the same."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**({"formatter_class": _Format} | options))
        self.register("type", float, finite)
        self.register("type", int, whole)

    def error(self, message: str) -> NoReturn:
        self.exit(USAGE, f"{self.prog}: {message}; see '{self.prog} --help'\n")

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        # here and not at the end, since only the command itself knows its options
        namespace, unknown = super().parse_known_args(args, namespace)
        if unknown:
            first = unknown[0].partition("=")[0]
            if not first.startswith("-"):
                self.error(f"'{first}' is an argument too many")
            self.error(f"{first}: no such option{_meant(first, self._option_string_actions)}")
        return namespace, unknown

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is None or value in action.choices:
            return
        known = [str(choice) for choice in action.choices]
        meant = _meant(str(value), known) or f"; there are {', '.join(known)}"
        raise argparse.ArgumentError(action, f"'{value}' is unknown{meant}")


def _meant(given: str, known: Iterable[str]) -> str:
    """Return the nearest known word, as the end of a sentence."""
    from difflib import get_close_matches

    # without dashes, which all options share and which say nothing about likeness
    plain = {option.lstrip("-"): option for option in known}
    near = get_close_matches(given.lstrip("-"), list(plain), n=1)
    return f"; did you mean {plain[near[0]]}?" if near else ""


def _overview(commands: Iterable[tuple[str, str]]) -> str:
    """Return first steps and the commands in groups; commands without a group come last."""
    left = dict(commands)
    parts = [_FIRST_STEPS]
    for title, names in _GROUPS.items():
        parts.append(_listing(title, {name: left.pop(name) for name in names if name in left}))
    if left:
        parts.append(_listing("more", left))
    return "\n".join([*parts, _LAST_LINES])


def _listing(title: str, commands: dict[str, str]) -> str:
    lines = [f"{title}:"]
    for name, what in commands.items():
        lines += textwrap.wrap(what, 78, initial_indent=f"  {name:<15}", subsequent_indent=" " * 17)
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.exit(main())
