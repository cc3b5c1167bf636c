"""Output, arguments and sockets of commands: results on stdout, remarks on stderr, both without control characters."""

import argparse
import json
import math
import os
import socket
import sys
from collections.abc import Callable, Sequence
from typing import Any

from adapters.errors import UsageError, printable


def say(*lines: str) -> None:
    """Print lines of a result; control characters, including line ends, become question marks."""
    sys.stdout.writelines(f"{printable(line)}\n" for line in lines)
    sys.stdout.flush()


def say_json(content: Any) -> None:
    """Print a result as one line of JSON."""
    sys.stdout.write(json.dumps(content) + "\n")
    sys.stdout.flush()


def remark(*lines: str) -> None:
    """Print a remark that is not part of the result, such as a warning."""
    sys.stderr.writelines(f"fauio: {printable(line)}\n" for line in lines)
    sys.stderr.flush()


def option(parser: Any, words: str, says: str, of: Callable[[str], Any] | None = None, **more: Any) -> None:
    """Add an option or an argument as users write it: ``-o --out DIR``, ``logs LOG``; without a value it is a flag.

    ``of`` converts the value; without it the value is a text. ``more`` is passed to ``add_argument``.
    """
    *names, value = words.split()
    if value.startswith("-"):
        parser.add_argument(*names, value, action="store_true", help=says, **more)
    else:
        parser.add_argument(*names, type=of, metavar=value, help=says, **more)


def finite(text: str) -> float:
    """Read an argument that is a finite number."""
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise argparse.ArgumentTypeError(f"'{text}' is not a finite number; write it without a unit, like 12.5")
    return number


def whole(text: str) -> int:
    """Read an argument that is a whole number."""
    try:
        return int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number") from None


def natural(text: str) -> int:
    """Read an argument that is a whole number of at least 0."""
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number of 0 or more")
    return int(text)


def positive(text: str) -> int:
    """Read an argument that is a whole number of at least 1."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number of 1 or more")
    return int(text)


def several(text: str) -> Sequence[str]:
    """Read an argument of several texts with commas between them."""
    return tuple(part.strip() for part in text.split(",") if part.strip())


def host_port(name: str, address: str, example: str) -> tuple[str, int]:
    """Return host and port to listen on. The message of a UsageError begins with ``name`` and ends with ``example``."""
    host, _, port = address.rpartition(":")
    host = host.strip("[]")
    if not host or not port.isdecimal() or int(port) > 0xFFFF:
        raise UsageError(f"{name} {address}: is not HOST:PORT, for example {example}")
    return host, int(port)


def listening(name: str, address: str, example: str) -> socket.socket:
    """Return a TCP socket that listens on HOST:PORT; raise a UsageError if it cannot, see :func:`host_port`."""
    where = host_port(name, address, example)
    try:
        return socket.create_server(where, family=socket.AF_INET6 if ":" in where[0] else socket.AF_INET)
    except OSError as error:
        why = os.strerror(error.errno) if error.errno is not None and error.errno > 0 else error
        raise UsageError(f"{name} {address}: cannot listen there: {why}; take another port") from error
