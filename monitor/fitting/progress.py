"""The progress of a long command: a bar with the remaining time on a terminal; in a pipe a line for each stage."""

from __future__ import annotations

import functools
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, TypeVar

from adapters.errors import printable

T = TypeVar("T")

_SHOW_EVERY = 2000
"""Messages between updates of the bar: some hundred updates per second would cost more than reading."""


_PATIENCE_S = 5.0
"""Time before the first line, seconds. Chosen: a command that is refused within five seconds prints a single line."""


_LINE_S = 10.0
"""Time between lines, seconds. Chosen: a log of a job shows that the job is still running, and stays short."""


class Stages:
    """Reports on stderr which stages are done, a line each, unless stderr is a terminal.

    The first lines wait until the command has run for a while, or is done: one that is refused early prints only why.
    """

    def __init__(self) -> None:
        self._started_s = time.monotonic()
        self._waiting: list[str] = []

    def done(self, stage: str) -> None:
        """Report that a stage is done."""
        elapsed_s = time.monotonic() - self._started_s
        self._waiting.append(f"{printable(f'fauio: {elapsed_s:.0f} s: {stage}')}\n")
        if elapsed_s >= _PATIENCE_S:
            self.flush()

    def flush(self) -> None:
        """Print the lines that wait."""
        if not sys.stderr.isatty():
            sys.stderr.writelines(self._waiting)
            sys.stderr.flush()
        self._waiting.clear()


def track(
    items: Iterable[T],
    what: str,
    unit: str = "messages",
    *,
    total_bytes: int = 0,
    total: int | None = None,
    weigh: Callable[[T], int] | None = None,
) -> Iterator[T]:
    """Yield the items; show their progress on stderr if it is a terminal, and wipe the line at the end.

    In a pipe a line is printed every ten seconds, and none if it takes less. ``what`` precedes the bar, ``unit`` is
    counted, ``weigh`` returns how many of it an item holds (None: one). If the items are read from a recording of
    ``total_bytes`` (:func:`recording_bytes`), the share that was read gives per cent and the remaining time; ``total``
    is the final number of the unit, if it is known.
    """
    from adapters.logs.compressed import ON_BYTES

    with ExitStack() as stack:
        show: Callable[..., None] = _Lines(what, unit, total_bytes or total).show
        if sys.stderr.isatty():
            progress = stack.enter_context(_bar(unit, total, known=bool(total_bytes or total)))
            task = progress.add_task(what, total=total_bytes or total, count=0)
            show = functools.partial(progress.update, task)
        read = count = shown = 0

        def note(more: int) -> None:
            nonlocal read
            read += more

        ON_BYTES.set(note)
        try:
            for item in items:
                yield item
                count += 1 if weigh is None else weigh(item)
                if unit != "messages" or count - shown >= _SHOW_EVERY:
                    shown = count
                    show(completed=min(read, total_bytes) if total_bytes else count, count=count)
        finally:
            ON_BYTES.set(None)


class _Lines:
    """Prints the progress of something, a line now and then."""

    def __init__(self, what: str, unit: str, total: int | None) -> None:
        self._what, self._unit, self._total = what, unit, total
        self._started_s = self._said_s = time.monotonic()

    def show(self, *, completed: int, count: int) -> None:
        """Print the progress if the last line is old enough."""
        now_s = time.monotonic()
        if now_s - self._said_s < _LINE_S:
            return
        self._said_s = now_s
        share = f"{100 * completed / self._total:.0f} %, " if self._total else ""
        words = f"fauio: {self._what}: {share}{count:,} {self._unit} after {now_s - self._started_s:.0f} s"
        sys.stderr.write(printable(words) + "\n")
        sys.stderr.flush()


def recording_bytes(path: Path) -> int:
    """Return the size of a recording, of all files in a folder; 0 if it is not known."""
    try:
        files = [path] if path.is_file() else [file for file in path.iterdir() if file.is_file()]
        return sum(file.stat().st_size for file in files)
    except OSError:
        return 0


def _bar(unit: str, total: int | None, *, known: bool) -> Any:
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        Progress,
        SpinnerColumn,
        TaskProgressColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    name = TextColumn("{task.description}", markup=False)
    of_all = f" of {total:,}" if total else ""
    counted = TextColumn("{task.fields[count]:,.0f}" + of_all + f" {unit}")
    left = (BarColumn(), TaskProgressColumn(), TextColumn("left:"), TimeRemainingColumn()) if known else ()
    columns = (SpinnerColumn(), name, *left, counted, TimeElapsedColumn())
    # If the results go to a file or pipe, rich may not write them to the terminal instead.
    redirect = sys.stdout.isatty()
    return Progress(*columns, console=Console(stderr=True), transient=True, redirect_stdout=redirect)
