"""A run as plots need it: each observer's series as arrays, and alarms as spans of time."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from monitor.estimate import Estimates, Layout
from monitor.event import AlarmEvent, Severity

FIRST_ROWS = 4096
"""Number of rows allocated at first; the memory doubles as it fills. Chosen: 40 s at 100 Hz, below the length of most
flights."""
MAX_ROWS = 4_000_000
"""Largest number of rows kept: 11 h at 100 Hz, in 2 GB for an observer of 60 columns. Longer runs are thinned."""


@dataclass(frozen=True, slots=True)
class Trace:
    """Samples and estimates of one observer over a run of N samples."""

    layout: Layout  # names of the columns
    # vehicle's clock and Unix time of the samples (N,)
    vehicle_ns: NDArray[np.int64]
    unix_ns: NDArray[np.int64]
    # one row per sample, as in :class:`~adapters.sample.Samples` and :class:`~monitor.estimate.Estimates`
    u: NDArray[np.float64]
    y: NDArray[np.float64]
    x: NDArray[np.float64]
    fault: NDArray[np.float64]
    isolated: NDArray[np.float64]
    residual: NDArray[np.float64]
    sd: NDArray[np.float64]
    armed: NDArray[np.bool_]  # whether alarms could be raised from the sample (N,)
    # whether the observer restarted at the sample (N,): earlier samples have no influence on it
    restart: NDArray[np.bool_]


class TraceBuilder:
    """Collects one observer's estimates in bounded memory.

    At ``max_rows``, an even number, every second sample is dropped, and from then on only every second sample is kept,
    then every fourth and so on, so that a run of any length is covered from end to end.
    """

    def __init__(self, layout: Layout, max_rows: int = MAX_ROWS) -> None:
        self._layout = layout
        self._max_rows = max_rows
        sizes = [len(names) for names in (layout.inputs, layout.outputs, layout.states, layout.faults)]
        s, p, n, a = sizes
        self._edges = np.cumsum([s, p, n, a, a, p])
        rows = min(FIRST_ROWS, max_rows)
        self._values = np.empty((rows, s + p + n + 2 * a + p + a))
        self._times = np.empty((rows, 2), np.int64)
        self._flags = np.empty((rows, 2), np.bool_)
        self._rows = 0
        self._stride = 1
        self._skip = 0
        self._restart = False

    def extend(self, estimates: Estimates) -> None:
        """Add the next estimates; the trace does not depend on how a run is cut into calls."""
        samples = estimates.samples
        values = (
            samples.u,
            samples.y,
            estimates.x,
            estimates.fault,
            estimates.isolated,
            estimates.residual,
            estimates.sd,
        )
        start, count = 0, len(estimates)
        while start < count:
            if self._skip >= count - start:
                self._skip -= count - start
                self._restart |= bool(samples.restart[start:].any())
                return
            if self._rows == len(self._values):
                self._make_room()
            rows = np.arange(start + self._skip, count, self._stride)[: len(self._values) - self._rows]
            place = slice(self._rows, self._rows + len(rows))
            np.concatenate([part[rows] for part in values], axis=1, out=self._values[place])
            self._times[place, 0], self._times[place, 1] = samples.vehicle_time_ns[rows], samples.time_ns[rows]
            stop = int(rows[-1]) + 1
            restarts = np.logical_or.reduceat(samples.restart[start:stop], np.append(start, rows[:-1] + 1) - start)
            restarts[0] |= self._restart
            self._flags[place, 0], self._flags[place, 1] = estimates.armed[rows], restarts
            self._rows += len(rows)
            self._skip, self._restart = self._stride - 1, False
            start = stop

    def build(self) -> Trace:
        """Return the samples collected so far, as a copy."""
        times, values, flags = (kept[: self._rows].copy() for kept in (self._times, self._values, self._flags))
        return Trace(self._layout, *times.T, *np.split(values, self._edges, axis=1), *flags.T)

    def _make_room(self) -> None:
        rows = self._rows
        if rows < self._max_rows:
            more = min(2 * rows, self._max_rows) - rows
            self._values = np.concatenate((self._values, np.empty((more, self._values.shape[1]))))
            self._times = np.concatenate((self._times, np.empty((more, 2), np.int64)))
            self._flags = np.concatenate((self._flags, np.empty((more, 2), np.bool_)))
            return
        # a restart at a dropped sample moves to the next kept sample
        restarts = self._flags[:, 1]
        restarts[2::2] |= restarts[1:-1:2]
        self._restart |= bool(restarts[-1])
        self._rows = rows // 2
        for kept in (self._values, self._times, self._flags):
            kept[: self._rows] = kept[::2].copy()
        self._stride *= 2


@dataclass(frozen=True, slots=True)
class AlarmSpan:
    """Time during which an alarm was active; ends are None while it is active."""

    history: tuple[AlarmEvent, ...]
    observer: str
    channel: str
    severity: Severity  # the worst severity that it had
    # Unix times and vehicle's times of the events that raised and cleared it
    start_ns: int
    start_vehicle_ns: int
    end_ns: int | None
    end_vehicle_ns: int | None


def alarm_spans(events: Iterable[AlarmEvent]) -> list[AlarmSpan]:
    """Return the span of each alarm, in the order of their beginnings.

    If the event that raised an alarm is missing, its span begins with its first event.
    """
    histories: dict[str, list[AlarmEvent]] = {}
    for event in events:
        histories.setdefault(event.id, []).append(event)
    spans = []
    for history in histories.values():
        first, last = history[0], history[-1]
        cleared = last.state == "cleared"
        spans.append(
            AlarmSpan(
                history=tuple(history),
                observer=first.observer,
                channel=first.channel,
                severity="critical" if any(e.severity == "critical" for e in history) else "warning",
                start_ns=first.time_ns,
                start_vehicle_ns=first.vehicle_time_ms * 1_000_000,
                end_ns=last.time_ns if cleared else None,
                end_vehicle_ns=last.vehicle_time_ms * 1_000_000 if cleared else None,
            )
        )
    return sorted(spans, key=lambda span: span.start_ns)
