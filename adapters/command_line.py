"""How commands speak and take numbers: results on stdout, remarks on stderr, in neither what a terminal obeys."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Sequence
from typing import Any

from adapters.errors import printable


def say(*lines: str) -> None:
    """Print lines of a result; control characters, line ends included, become question marks."""
    sys.stdout.writelines(f"{printable(line)}\n" for line in lines)
    sys.stdout.flush()


def say_json(content: Any) -> None:
    """Print a result as one line of JSON."""
    sys.stdout.write(json.dumps(content) + "\n")
    sys.stdout.flush()


def remark(*lines: str) -> None:
    """Say what is no result, such as a warning."""
    sys.stderr.writelines(f"fauio: {printable(line)}\n" for line in lines)
    sys.stderr.flush()


def finite(text: str) -> float:
    """Read an argument that is a finite number."""
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise argparse.ArgumentTypeError(f"'{text}' is no finite number; write it without a unit, like 12.5")
    return number


def whole(text: str) -> int:
    """Read an argument that is a whole number."""
    try:
        return int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is no whole number") from None


def natural(text: str) -> int:
    """Read an argument that is a whole number from 0 on."""
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"'{text}' is no whole number from 0 on")
    return int(text)


def positive(text: str) -> int:
    """Read an argument that is a whole number from 1 on."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"'{text}' is no whole number from 1 on")
    return int(text)


def several(text: str) -> Sequence[str]:
    """Read an argument of several texts with commas between them."""
    return tuple(part.strip() for part in text.split(",") if part.strip())
