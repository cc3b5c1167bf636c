"""``fauio completion``: a script for bash, zsh or fish that completes commands, options and files."""

import argparse
import sys
from collections.abc import Iterator
from pathlib import PurePath
from typing import Any

SHELLS = ("bash", "zsh", "fish")
# Vehicles also write names in capitals: 00000012.BIN.
_LOGS = [f"*.{kind}{packed}" for kind in ("tlog", "mcap", "ulg", "bin", "BIN") for packed in ("", ".xz", ".gz")]
_FOLDERS = ("PROFILE", "DIR", "FOLDER")


def add_completion(subparsers: Any, parser: argparse.ArgumentParser) -> None:
    """Add the command to the command line, of which ``parser`` knows all commands."""
    command = subparsers.add_parser(
        "completion",
        help="print a script that completes commands, options and files in a shell",
        description="Print a completion script; for bash keep it as "
        "~/.local/share/bash-completion/completions/fauio. The script does not start fauio, so print it again after an "
        "update.",
        epilog="example: fauio completion bash",
    )
    command.add_argument("shell", choices=SHELLS, help="shell that reads it")

    def run(args: argparse.Namespace) -> int:
        sys.stdout.write(completion_script(parser, args.shell) + "\n")
        return 0

    command.set_defaults(handler=run)


def completion_script(parser: argparse.ArgumentParser, shell: str) -> str:
    """Return the script that completes a command line in a shell.

    The metavar of an argument tells what completes it: ``LOG`` is a recording, ``PROFILE`` a folder, ``OUT.mcap`` a
    file with that suffix. The parser's arguments are marked accordingly.
    """
    import shtab

    for action in _actions(parser):
        name = action.metavar
        if name == "LOG":
            completer = shtab.glob(*_LOGS)
        elif name == "FILE":
            completer = shtab.FILE
        elif name in _FOLDERS:
            completer = shtab.DIRECTORY
        elif isinstance(name, str) and (suffix := PurePath(name).suffix):
            # zsh mistakes a pattern that stands alone in its parentheses for something else
            completer = shtab.glob(f"*{suffix}", f"*{suffix.upper()}")
        else:
            continue
        action.complete = completer  # type: ignore[attr-defined]
    return str(shtab.complete(parser, shell))


def _actions(parser: argparse.ArgumentParser) -> Iterator[argparse.Action]:
    """Yield the arguments of a parser and of its commands; give each command its line of help as description."""
    for action in parser._actions:
        yield action
        if isinstance(action, argparse._SubParsersAction):
            # shtab leaves out what help hides
            action.help = "command"
            for command in action._choices_actions:
                below = action.choices[command.dest]
                below.description = command.help
                yield from _actions(below)
