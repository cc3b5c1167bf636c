"""What a fuzz target is: how it is made, what it begins with, which exceptions are its documented ones."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from adapters.errors import FauioError

Run = Callable[[bytes], None]


@dataclass(frozen=True, slots=True)
class Target:
    """One parser of outside bytes.

    Parameters
    ----------
    name, what : str
        Its name on the command line, and what is fed.
    make : Callable[[Path], Run]
        Returns what takes one input, given a folder for files.
    seeds : Callable[[], Sequence[bytes]]
        Returns the inputs to begin with.
    largest : int
        Most bytes of an input.
    slow_s : float
        Processor time from which on an input is a finding, seconds; instrumented code takes several times as long.
    """

    name: str
    what: str
    make: Callable[[Path], Run]
    seeds: Callable[[], Sequence[bytes]]
    largest: int = 4096
    slow_s: float = 1.0


@contextmanager
def only(*documented: type[Exception]) -> Iterator[None]:
    """Let pass the documented exceptions, whose message has to be printable lines for the user, and no others."""
    try:
        yield
    except documented as error:
        if not str(error) or len(str(error)) > 100_000:
            raise
        if isinstance(error, FauioError):
            assert all(map(str.isprintable, str(error).split("\n"))), f"not printable: {error!r:.200}"
