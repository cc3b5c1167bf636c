"""A progress line on a terminal, nothing in a pipe."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from typing import TypeVar

T = TypeVar("T")

_SHOW_EVERY = 2000


def track(items: Iterable[T], what: str, unit: str = "messages") -> Iterator[T]:
    """Yield the items; on a terminal say on stderr how many have gone by, and wipe the line at the end."""
    if not sys.stderr.isatty():
        yield from items
        return
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}"),
        TextColumn("{task.completed:,.0f} " + unit),
    )
    with Progress(*columns, TimeElapsedColumn(), console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(what, total=None)
        pending = 0
        for item in items:
            yield item
            pending += 1
            if pending == (_SHOW_EVERY if unit == "messages" else 1):
                progress.advance(task, pending)
                pending = 0
