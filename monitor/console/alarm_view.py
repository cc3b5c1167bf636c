"""The live table of ``fauio alarms`` on a terminal."""

from __future__ import annotations

import time
from collections.abc import Sequence

from rich import box
from rich.cells import cell_len
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from adapters.errors import printable
from monitor.bus.status_watch import StatusWatch, VehicleStatus
from monitor.bus.subscriber import AlarmSubscriber
from monitor.console.alarm_table import AlarmRow, AlarmTable
from monitor.views.palette import SEVERITY

REFRESH_S = 0.25
"""Chosen: four times a second looks live and costs next to nothing."""

_COLOURS = {str(severity): colour for severity, colour in SEVERITY.items()}
_HELP = "fauio alarms ack | shelve | unshelve | reset CHANNEL   Ctrl-C ends"
_AROUND_ROWS = 5
"""Lines of the screen that are not rows of alarms: heading, rules and the line below."""
_LEAST_ROWS = 3
"""Shown even where a terminal is lower than that."""
_MOST_WARNINGS = 3
"""Lines about monitors that are not well. Chosen: the alarms are what the table is for."""
_LAST = "message"
_LAST_WIDTH = 20
"""Letters that the last column needs to say anything."""
_GAP = 3
"""Rich puts a blank, a rule and a blank between columns."""
_TITLES = {"brief": "size", "age": "since"}
# from the widest to the narrowest terminal
_LAYOUTS = (
    ("severity", "vehicle", "channel", "size", "age", "peak", "state", _LAST),
    ("severity", "vehicle", "channel", "brief", "age", "peak", "state", _LAST),
    ("severity", "vehicle", "channel", "brief", "age", "state", _LAST),
    ("severity", "vehicle", "channel", "brief", "age", "state"),
    ("severity", "vehicle", "channel", "brief", "state"),
    ("vehicle", "channel", "brief", "state"),
)


def can_redraw() -> bool:
    """Return whether standard output is a terminal that lines can be drawn again on."""
    console = Console()
    return console.is_terminal and not console.is_dumb_terminal


def watch(subscriber: AlarmSubscriber, statuses: StatusWatch, endpoints: Sequence[str], until: float) -> None:
    """Draw the active alarms, again and again, and which vehicles are not watched as they should be.

    ``endpoints`` are named where no monitor is there; ``until`` is the monotonic time at which to stop, seconds.
    """
    table = AlarmTable()
    console = Console()
    with Live(console=console, auto_refresh=False, transient=False) as live:
        while (now := time.monotonic()) < until:
            event = subscriber.receive(min(REFRESH_S, until - now))
            while event is not None:
                table.take(event, time.time_ns())
                # at most one refresh a period, however many come
                event = subscriber.receive(0.0) if time.monotonic() - now < REFRESH_S else None
            rows = table.rows(time.time_ns())
            unwell = [one for one in statuses.latest() if not one.well]
            live.update(draw(rows, subscriber, endpoints, *console.size, unwell), refresh=True)


def draw(
    rows: Sequence[AlarmRow],
    subscriber: AlarmSubscriber,
    endpoints: Sequence[str],
    width: int,
    height: int,
    unwell: Sequence[VehicleStatus] = (),
) -> Group:
    """Return header, table and help for a terminal with this many columns and lines."""
    warnings = _warnings([status for status in unwell if status.vehicle in subscriber.live])
    shown = rows[: max(_LEAST_ROWS, height - _AROUND_ROWS - len(warnings))]
    columns = _columns(shown, width)
    table = Table(box=box.SIMPLE_HEAD, expand=True, padding=(0, 1), pad_edge=False, show_edge=False)
    for name in columns:
        # a ratio takes what is left, and only the message may be cut
        table.add_column(_TITLES.get(name, name), no_wrap=True, overflow="ellipsis", ratio=1 if name == _LAST else None)
    for row in shown:
        # Text and not str: what came over a network is no markup
        table.add_row(*(Text(getattr(row, name)) for name in columns), style=_style(row))
    active = sum(row.group == "active" for row in rows)
    gone = sorted({row.vehicle for row in rows} - subscriber.live)
    header = _header(active, gone, subscriber, endpoints)
    lines = [header, *warnings, table if rows else Text("no alarm is active", style="dim")]
    if len(rows) > len(shown):
        lines.append(Text(f"and {len(rows) - len(shown)} more", style="dim"))
    return Group(*lines, Text(_HELP, style="dim", no_wrap=True, overflow="ellipsis"))


def _columns(rows: Sequence[AlarmRow], width: int) -> tuple[str, ...]:
    """Return the columns there is room for."""
    for names in _LAYOUTS[:-1]:
        least = sum(
            _LAST_WIDTH
            if name == _LAST
            else max(len(_TITLES.get(name, name)), *(cell_len(getattr(row, name)) for row in rows), 0)
            for name in names
        )
        if least + _GAP * len(names) <= width:
            return names
    return _LAYOUTS[-1]


def _header(active: int, gone: Sequence[str], subscriber: AlarmSubscriber, endpoints: Sequence[str]) -> Text:
    live = sorted(subscriber.live)
    if live:
        words = f"{active} active   monitored: {printable(', '.join(live))}"
        if gone:
            words += f"   monitor gone: {', '.join(gone)}"
    else:
        words = f"{active} active   no monitor at {', '.join(endpoints)}; waiting (start one with 'fauio run')"
    if subscriber.lost:
        words += f"   {subscriber.lost} events lost"
    if subscriber.invalid:
        words += f"   {subscriber.invalid} payloads were no events"
    return Text(words, style="bold" if live else "", no_wrap=True, overflow="ellipsis")


def _warnings(unwell: Sequence[VehicleStatus]) -> list[Text]:
    """Return a line for each of the first vehicles of which no alarm says little."""
    lines = [status.line() for status in unwell[:_MOST_WARNINGS]]
    if len(unwell) > _MOST_WARNINGS:
        lines.append(f"and {len(unwell) - _MOST_WARNINGS} more vehicles are not watched as they should be")
    return [Text(printable(line), style=_COLOURS["warning"], no_wrap=True, overflow="ellipsis") for line in lines]


def _style(row: AlarmRow) -> str:
    if row.group != "active":
        return "dim"
    weight = "" if "acknowledged" in row.state else "bold"
    return f"{weight} {_COLOURS.get(row.severity, '')}".strip()
