"""A fuzzer's bytes as something else: numbers, choices, odd values, a file with some bytes changed."""

from __future__ import annotations

import math
import random
import struct
from collections.abc import Sequence
from typing import Any, TypeVar

T = TypeVar("T")

ODD_VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, 1, -1, 255, 65_535, (1 << 31) - 1, 1 << 31, (1 << 32) - 1, 1 << 62),
    *((1 << 63) - 1, 1 << 63, 1 << 64, -(1 << 63), -(1 << 64), 10**400, -(10**400)),
    *(0.0, -0.0, 1e-320, 0.5, -1.5, 1e18, 1e300, -1e308, math.nan, math.inf, -math.inf),
    *("", "x", "\0", "\ud800", "a/b", "*", "$*", "\x1b[31m", "ü" * 50, "1e9", "NaN"),
    *([], [[]], [0.0] * 70, {}, {"sec": {}}, {"sec": 1, "nanosec": 10**30}, [None, {}], {"": ""}),
)
NAMES = (
    *("id", "channel", "by", "reason", "minutes", "until_ns", "seq", "alarms", "latched", "out_of_service"),
    *("flood_raised", "flood_s", "observer", "vehicle", "kind", "state", "severity", "estimate", "relative", "unit"),
    *("threshold", "time_ns", "vehicle_time_ms", "since_ns", "peak", "message", "acknowledged", "shelved_until_ns"),
    *("forged", "replayed", "unsigned", "sec", "nanosec", "header", "stamp", "name", "data", "position", "slow_s"),
)


class Draw:
    """Reads a fuzzer's bytes from the start; at their end everything is zero or empty."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0

    @property
    def more(self) -> bool:
        """Whether bytes are left."""
        return self._at < len(self._data)

    def take(self, count: int) -> bytes:
        """Return the next bytes, fewer where there are not so many."""
        found = self._data[self._at : self._at + count]
        self._at += len(found)
        return found

    def rest(self) -> bytes:
        """Return all bytes that are left."""
        return self.take(len(self._data))

    def block(self) -> bytes:
        """Return some bytes; the first two say how many."""
        return self.take(self.number(2))

    def number(self, size: int = 1) -> int:
        """Return an unsigned number of so many bytes."""
        return int.from_bytes(self.take(size), "little")

    def choice(self, options: Sequence[T]) -> T:
        """Return one of some options."""
        return options[self.number(1 if len(options) <= 256 else 2) % len(options)]

    def text(self) -> str:
        """Return a short text, which may hold what UTF-8 cannot."""
        return self.take(self.number() % 40).decode("utf-8", errors="surrogateescape")

    def value(self, depth: int = 3) -> Any:
        """Return a value as JSON or a decoder may give it: odd, often of the wrong type."""
        kind = self.number() % 8
        if kind == 0:
            return struct.unpack("<d", self.take(8).ljust(8, b"\0"))[0]
        if kind == 1:
            return int.from_bytes(self.take(self.number() % 12), "little", signed=True)
        if kind == 2:
            return self.text()
        if kind == 3 and depth:
            return [self.value(depth - 1) for _ in range(self.number() % 5)]
        if kind == 4 and depth:
            return self.fields(depth - 1)
        return self.choice(ODD_VALUES)

    def fields(self, depth: int = 2) -> dict[str, Any]:
        """Return a mapping, most of its names known somewhere."""
        return {
            self.choice(NAMES) if self.number() % 4 else self.text(): self.value(depth)
            for _ in range(self.number() % 6)
        }

    def edited(self, original: bytes, most: int = 12) -> bytes:
        """Return bytes with some of them overwritten, put in, left out, or cut off at the end."""
        found = bytearray(original)
        for _ in range(self.number() % most):
            at = self.number(4) % (len(found) + 1)
            how = self.number() % 8
            piece = self.take(self.number() % 16)
            if how < 5:
                found[at : at + len(piece)] = piece
            elif how == 5:
                found[at:at] = piece
            elif how == 6:
                del found[at : at + self.number()]
            else:
                del found[at:]
        return bytes(found)


def random_inputs(count: int = 40, longest: int = 400, seed: int = 1) -> list[bytes]:
    """Return inputs to begin with where the target makes its own structure out of any bytes."""
    source = random.Random(seed)  # noqa: S311 - to begin with, not to keep a secret
    return [source.randbytes(source.randrange(1, longest)) for _ in range(count)]
