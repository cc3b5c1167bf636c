"""One vehicle's data for the live view, in bounded memory: thinned in time, the oldest dropped."""

import threading
from collections import deque
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from adapters.batch import Batch, one_message
from adapters.channels import follow, number
from adapters.message import Message
from monitor.estimate import Estimates, Layout, joined_estimates
from monitor.event import AlarmEvent
from monitor.trace import Trace, TraceBuilder
from monitor.views.panels import Thresholds

MAX_RATE_HZ = 20
"""Largest number of rows a second of an observer or message. Chosen: a plot of a minute has some 1,200 pixels."""
MAX_WAITING_ROWS = 600
"""Largest number of waiting rows of an observer or message: 30 s at :data:`MAX_RATE_HZ`. A viewer starts in less."""
MAX_EVENTS = 500
"""Largest number of waiting alarm events; chosen as far more than an operator can read in those 30 s."""
MAX_FIELDS = 24
"""Largest number of fields shown of a message. SERVO_OUTPUT_RAW, the largest message that our observers read, has
18."""

_PERIOD_NS = 1_000_000_000 // MAX_RATE_HZ
# Bounds of the search for numbers in JSON from the network: entries visited, and levels of nesting.
_WALK = 200
_DEPTH = 3
_CLOCKS = ("time_boot_ms", "time_usec", "time_ns")

_Path = tuple[str | int, ...]
_T = TypeVar("_T")


@dataclass(frozen=True, slots=True)
class RawBatch:
    """A message's numeric fields over some time."""

    message: str
    fields: tuple[str, ...]  # names of the fields, those of the first of these messages
    unix_ns: NDArray[np.int64]  # times of arrival (N,)
    values: NDArray[np.float64]  # one row per message (N, fields); NaN where a message lacks a field


@dataclass(frozen=True, slots=True)
class Shown:
    """All data since the last call of :meth:`VehicleView.drain`."""

    traces: tuple[Trace, ...]
    events: tuple[AlarmEvent, ...]
    raw: tuple[RawBatch, ...]


@dataclass(slots=True)
class _Raw:
    paths: tuple[_Path, ...]
    rows: deque[tuple[int, tuple[float, ...]]] = field(default_factory=lambda: deque(maxlen=MAX_WAITING_ROWS))


class VehicleView:
    """Collects the data that one vehicle's monitor receives and computes, as an archive does; another thread drains it.

    Estimates are thinned to :data:`MAX_RATE_HZ` per observer, telemetry of the ``messages`` to be shown to the same
    rate per message name and sender. No call takes longer than an append, even if the viewer fails.
    """

    def __init__(
        self, vehicle: str, layouts: Sequence[Layout], thresholds: Thresholds, messages: Collection[str]
    ) -> None:
        self.vehicle = vehicle
        self.layouts = tuple(layouts)
        self.thresholds = dict(thresholds)
        self.messages = tuple(sorted(messages))
        self._wanted = frozenset(messages)
        self._lock = threading.Lock()
        self._estimates: dict[str, deque[Estimates]] = {
            layout.observer: deque(maxlen=MAX_WAITING_ROWS) for layout in self.layouts
        }
        self._events: deque[AlarmEvent] = deque(maxlen=MAX_EVENTS)
        self._raw: dict[str, _Raw] = {}
        self._last_ns: dict[tuple[str | int, ...], int] = {}
        self.dropped = 0

    def batch(self, batch: Batch) -> None:
        """Keep the telemetry to be shown; other messages cost nothing."""
        for columns in batch.columns:
            if columns.name in self._wanted:
                sender = columns.name, columns.system, columns.component
                for row, time_ns in enumerate(columns.received_ns.tolist()):
                    if self._is_due(sender, time_ns):
                        self._keep_message(one_message(columns, row))
        for message in batch.others.values():
            sender = message.name, message.system, message.component
            if message.name in self._wanted and self._is_due(sender, message.received_ns):
                self._keep_message(message)

    def estimates(self, estimates: Estimates) -> None:
        """Keep estimates to be shown."""
        buffer = self._estimates.get(estimates.observer)
        if buffer is None:
            return
        for row, time_ns in enumerate(estimates.samples.time_ns.tolist()):
            if self._is_due((estimates.observer,), time_ns):
                with self._lock:
                    self._keep(buffer, estimates.part(row, row + 1))

    def event(self, event: AlarmEvent) -> None:
        """Keep an alarm event."""
        with self._lock:
            self._keep(self._events, event)

    def flush(self) -> None:
        """Do nothing: another thread drains the view."""

    def retune(self, thresholds: Thresholds) -> None:
        """Show other thresholds from now on."""
        self.thresholds = dict(thresholds)

    def drain(self) -> Shown:
        """Return and forget the data since the last call; for one thread other than the monitor's."""
        with self._lock:
            estimates = {name: list(buffer) for name, buffer in self._estimates.items()}
            events = tuple(self._events)
            raw = {name: (kept.paths, list(kept.rows)) for name, kept in self._raw.items()}
            self._events.clear()
            for buffer in self._estimates.values():
                buffer.clear()
            for kept in self._raw.values():
                kept.rows.clear()
        return Shown(
            traces=tuple(
                _trace(layout, estimates[layout.observer]) for layout in self.layouts if estimates[layout.observer]
            ),
            events=events,
            raw=tuple(
                RawBatch(
                    message=name,
                    fields=tuple(".".join(str(step) for step in path) for path in paths),
                    unix_ns=np.array([row[0] for row in rows], dtype=np.int64),
                    values=np.array([row[1] for row in rows]),
                )
                for name, (paths, rows) in raw.items()
                if rows
            ),
        )

    def __len__(self) -> int:
        """Return the number of waiting rows and events."""
        with self._lock:
            waiting = sum(len(buffer) for buffer in self._estimates.values()) + len(self._events)
            return waiting + sum(len(kept.rows) for kept in self._raw.values())

    def _keep(self, buffer: deque[_T], item: _T) -> None:
        self.dropped += len(buffer) == buffer.maxlen
        buffer.append(item)

    def _keep_message(self, message: Message) -> None:
        raw = self._raw.get(message.name)
        if raw is None:
            paths = tuple(islice(_numeric_paths(message.fields), MAX_FIELDS))
            if not paths:
                return
            raw = _Raw(paths)
        row = tuple(number(follow(message.fields, path)) for path in raw.paths)
        with self._lock:
            self._raw[message.name] = raw
            self._keep(raw.rows, (message.received_ns, row))

    def _is_due(self, key: tuple[str | int, ...], time_ns: int) -> bool:
        """Return whether a period has passed since the last row kept for a key, or the time jumped back."""
        last_ns = self._last_ns.get(key)
        if last_ns is not None and 0 <= time_ns - last_ns < _PERIOD_NS:
            return False
        self._last_ns[key] = time_ns
        return True


def _trace(layout: Layout, estimates: Sequence[Estimates]) -> Trace:
    builder = TraceBuilder(layout, max_rows=len(estimates) + 1)
    builder.extend(joined_estimates(estimates))
    return builder.build()


def _numeric_paths(fields: Mapping[str, Any]) -> Iterator[_Path]:
    """Yield the paths of numbers in decoded fields, except clocks.

    Only a bounded part of hostile fields is searched.
    """
    waiting: deque[tuple[_Path, Any]] = deque([((), fields)])
    for _ in range(_WALK):
        if not waiting:
            return
        path, value = waiting.popleft()
        if isinstance(value, int | float) and not isinstance(value, bool):
            yield path
        elif len(path) >= _DEPTH:
            continue
        elif isinstance(value, Mapping):
            inside = ((name, inner) for name, inner in value.items() if isinstance(name, str) and name not in _CLOCKS)
            waiting.extend(((*path, name), inner) for name, inner in islice(inside, _WALK))
        elif isinstance(value, list | tuple):
            waiting.extend(((*path, place), inner) for place, inner in enumerate(value[:_WALK]))
