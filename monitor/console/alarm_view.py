"""The live table of ``fauio alarms`` on a terminal."""

import os
import queue
import select
import sys
import termios
import threading
import time
import tty
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Self

from rich import box
from rich.cells import cell_len
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from adapters.errors import UsageError, printable
from monitor.bus.estimate_watch import EstimateWatch
from monitor.bus.status_watch import StatusWatch, VehicleStatus
from monitor.bus.subscriber import AlarmSubscriber
from monitor.console.alarm_table import AlarmRow, AlarmTable, RowKey

REFRESH_S = 0.25
"""Seconds between two drawings of the table. Chosen: four times a second looks live and costs next to nothing."""

# the terminal's own colours, which its user has chosen to be readable
_COLOURS = {"warning": "yellow", "critical": "red"}
_VERBS = {"a": "ack", "s": "shelve", "u": "unshelve", "r": "reset"}
_HELP = "arrows: choose   a ack   s shelve   u unshelve   r reset   Ctrl-C ends"
_AROUND_ROWS = 7
"""Lines of the screen that are not rows of alarms: heading, rules, a message, the latest answer and the keys."""
_LEAST_ROWS = 3
"""Rows of alarms that are shown even on a lower terminal."""
_MOST_WARNINGS = 3
"""Largest number of lines about monitors that are not well. Chosen: the table is for alarms."""
_LAST = "message"
_LAST_WIDTH = 20
"""Least width, letters, at which the last column is readable."""
_GAP = 3
"""Columns that Rich puts between two columns of the table: a blank, a rule and a blank."""
_TITLES = {"age": "since", "brief": "size"}
# from the widest to the narrowest terminal
_LAYOUTS = (
    ("severity", "vehicle", "channel", "size", "age", "state", _LAST),
    ("severity", "vehicle", "channel", "size", "age", "state"),
    ("severity", "vehicle", "channel", "brief", "state"),
    ("vehicle", "channel", "brief", "state"),
)

_ARROWS = {b"\x1b[A": "up", b"\x1b[B": "down", b"\x1bOA": "up", b"\x1bOB": "down"}
_MOST_BYTES = 256
"""Bytes of input that are read at once. Chosen: more than a person types between two drawings."""


def can_redraw() -> bool:
    """Return whether standard output is a terminal whose lines can be redrawn."""
    console = Console()
    return console.is_terminal and not console.is_dumb_terminal


def watch(
    subscriber: AlarmSubscriber,
    statuses: StatusWatch,
    estimates: EstimateWatch,
    ask: Callable[[str, str, Mapping[str, Any]], Any],
    endpoints: Sequence[str],
    until: float,
) -> None:
    """Show the active alarms, redrawn again and again, and the vehicles that are not monitored as they should be.

    ``ask`` sends a command on an alarm to the monitor of a vehicle, and raises UsageError if it is refused;
    ``endpoints`` are named if no monitor is found; ``until`` is the monotonic time at which to stop, seconds.
    """
    table, desk = AlarmTable(), _Desk(ask)
    console = Console()
    with Keyboard() as keyboard, Live(console=console, auto_refresh=False, transient=False) as live:
        while (now := time.monotonic()) < until:
            event = subscriber.receive(min(REFRESH_S, until - now))
            while event is not None:
                table.take(event, time.time_ns())
                # at most one drawing a period, however many events arrive
                event = subscriber.receive(0.0) if time.monotonic() - now < REFRESH_S else None
            for sizes in estimates.take():
                table.resize(*sizes)
            rows = table.rows(time.time_ns())
            for key in keyboard.pressed():
                if key == "q":
                    return
                desk.press(key, rows)
            drawn = draw(rows, subscriber, endpoints, *console.size, statuses.latest(), desk.chosen, desk.said())
            live.update(drawn, refresh=True)


class _Desk:
    """The selected alarm, and the command sent to its monitor."""

    def __init__(self, ask: Callable[[str, str, Mapping[str, Any]], Any]) -> None:
        self.chosen: RowKey | None = None
        self._ask = ask
        self._said = ""
        self._answers: queue.SimpleQueue[str] = queue.SimpleQueue()

    def press(self, key: str, rows: Sequence[AlarmRow]) -> None:
        """Select another row, or send a command on the selected one, in a thread."""
        keys = [row.key for row in rows]
        index = keys.index(self.chosen) if self.chosen in keys else None
        if key in ("up", "k", "down", "j") and keys:
            step = -1 if key in ("up", "k") else 1
            self.chosen = keys[0] if index is None else keys[min(max(index + step, 0), len(keys) - 1)]
        elif (verb := _VERBS.get(key)) is not None and index is None:
            self._said = f"{verb} which alarm? choose it with up and down"
        elif verb is not None and index is not None:
            row = rows[index]
            self._said = f"{verb} {row.channel} of {row.vehicle} ..."
            threading.Thread(target=self._request, args=(verb, row), name="command", daemon=True).start()

    def said(self) -> str:
        """Return the latest answer."""
        while not self._answers.empty():
            self._said = self._answers.get()
        return self._said

    def _request(self, verb: str, row: AlarmRow) -> None:
        try:
            self._ask(verb, row.key[0], {"id": row.id} if row.group == "active" else {"channel": row.channel})
        except UsageError as error:
            self._answers.put(str(error))
        else:
            self._answers.put(f"{verb} {row.channel} of {row.vehicle}: done")


def draw(
    rows: Sequence[AlarmRow],
    subscriber: AlarmSubscriber,
    endpoints: Sequence[str],
    width: int,
    height: int,
    statuses: Sequence[VehicleStatus] = (),
    chosen: RowKey | None = None,
    said: str = "",
) -> Group:
    """Return header, table and help for a terminal with this many columns and lines."""
    there = [status for status in statuses if status.vehicle in subscriber.live]
    warnings = _warnings([status for status in there if not status.well])
    shown = rows[: max(_LEAST_ROWS, height - _AROUND_ROWS - len(warnings))]
    columns = _columns(shown, width)
    table = Table(box=box.SIMPLE_HEAD, expand=True, padding=(0, 1), pad_edge=False, show_edge=False)
    for name in columns:
        # a ratio takes the remaining width, and only the message may be cut
        table.add_column(_TITLES.get(name, name), no_wrap=True, overflow="ellipsis", ratio=1 if name == _LAST else None)
    for row in shown:
        # Text and not str: text from the network is no markup
        style = f"{_style(row)} reverse".strip() if row.key == chosen else _style(row)
        table.add_row(*(Text(getattr(row, name)) for name in columns), style=style)
    active = sum(row.group == "active" for row in rows)
    gone = sorted({row.vehicle for row in rows} - subscriber.live)
    header = _header(active, gone, subscriber, endpoints, {status.vehicle: status.messages_per_s for status in there})
    lines = [header, *warnings, table if rows else Text("no alarm is active", style="dim")]
    if shown and _LAST not in columns:  # the message column does not fit: the message of one alarm goes below the table
        told = next((row for row in shown if row.key == chosen), shown[0])
        lines.append(Text(f"{told.channel}: {told.message}", style=_style(told), overflow="ellipsis", no_wrap=True))
    if len(rows) > len(shown):
        lines.append(Text(f"and {len(rows) - len(shown)} more", style="dim"))
    if said:
        lines.append(Text(printable(said), no_wrap=True, overflow="ellipsis"))
    return Group(*lines, Text(_HELP, style="dim", no_wrap=True, overflow="ellipsis"))


def _columns(rows: Sequence[AlarmRow], width: int) -> tuple[str, ...]:
    """Return the columns that fit."""
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


def _header(
    active: int,
    gone: Sequence[str],
    subscriber: AlarmSubscriber,
    endpoints: Sequence[str],
    rates: Mapping[str, float | None],
) -> Text:
    live = sorted(subscriber.live)
    if live:
        names = [name if (rate := rates.get(name)) is None else f"{name} ({rate:.0f} messages/s)" for name in live]
        words = f"{active} active   monitored: {printable(', '.join(names))}"
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
    """Return a line for each of the first vehicles that are not well: for them a lack of alarms means little."""
    lines = [status.line() for status in unwell[:_MOST_WARNINGS]]
    if len(unwell) > _MOST_WARNINGS:
        lines.append(f"and {len(unwell) - _MOST_WARNINGS} more vehicles are not watched as they should be")
    return [Text(printable(line), style=_COLOURS["warning"], no_wrap=True, overflow="ellipsis") for line in lines]


def _style(row: AlarmRow) -> str:
    if row.group != "active":
        return "dim"
    weight = "" if "acknowledged" in row.state else "bold"
    return f"{weight} {_COLOURS.get(row.severity, '')}".strip()


class Keyboard:
    """Reads keys as a context; the terminal is restored afterwards.

    If standard input is no terminal, there are no keys.
    """

    def __init__(self) -> None:
        self._file: int | None = None
        self._before: list[Any] = []

    def pressed(self) -> list[str]:
        """Return the keys pressed since the last call: letters, ``up`` and ``down``."""
        if self._file is None or not select.select([self._file], [], [], 0.0)[0]:
            return []
        data = os.read(self._file, _MOST_BYTES)
        if not data:  # its other end is gone
            self._file = None
        for code, name in _ARROWS.items():
            data = data.replace(code, b"\n" + name.encode() + b"\n")
        words = data.decode("ascii", "ignore").split("\n")
        return [key for word in words for key in ([word] if word in _ARROWS.values() else word)]

    def __enter__(self) -> Self:
        if sys.stdin is not None and sys.stdin.isatty():
            self._file = sys.stdin.fileno()
            self._before = termios.tcgetattr(self._file)
            tty.setcbreak(self._file)
        return self

    def __exit__(self, *_: object) -> None:
        if self._before:
            termios.tcsetattr(sys.stdin.fileno(), termios.TCSADRAIN, self._before)
