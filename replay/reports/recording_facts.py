"""The content of a recording, measured while it is read: how often each message came, and its gaps."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adapters.batch import Batch
from adapters.source import Source

GAP_S = 0.5
"""Shortest gap, seconds: observers restart after such a silence (monitor/sampling)."""
GAP_PERIODS = 10.0
"""Shortest gap, periods of the message. A gap exceeds both limits: otherwise rare messages, or the jitter of frequent
ones, would be gaps."""
MOST_GAPS = 1000
"""Gaps that are kept of a message. Chosen: more of them do not improve the report, and their memory has to be
bounded."""

_PERIODS_KEPT = 2000
"""Periods that are kept of a message. Chosen: they suffice for its usual period, the median."""
StreamKey = tuple[Source, str, int, int]


@dataclass(frozen=True, slots=True)
class Gap:
    """Time without a message that comes regularly."""

    start_ns: int  # Unix time of the last message before it
    seconds: float  # its duration


@dataclass(frozen=True, slots=True)
class StreamFacts:
    """One message of one sender."""

    source: Source
    name: str  # as in :class:`adapters.message.Message`
    # MAVLink ids of the sender
    system: int
    component: int
    count: int  # number of messages
    rate_hz: float  # messages per second outside of gaps; 0 if there was only one message
    gaps: tuple[Gap, ...]  # its gaps, the first :data:`MOST_GAPS`


@dataclass(frozen=True, slots=True)
class RecordingFacts:
    """A recording."""

    # Unix times of the first and the last arrival, None if there was no message
    first_ns: int | None
    last_ns: int | None
    streams: tuple[StreamFacts, ...]  # its messages by name and sender

    @property
    def duration_s(self) -> float:
        """Seconds from the first arrival to the last."""
        return 0.0 if self.first_ns is None or self.last_ns is None else (self.last_ns - self.first_ns) * 1e-9

    @property
    def rates(self) -> dict[str, float]:
        """Messages per second by name, of the sender with the highest rate."""
        rates: dict[str, float] = {}
        for stream in self.streams:
            rates[stream.name] = max(rates.get(stream.name, 0.0), stream.rate_hz)
        return rates

    @property
    def messages(self) -> int:
        """Number of messages."""
        return sum(stream.count for stream in self.streams)


class RecordingMeter:
    """Measures a recording while its batches pass, in memory that does not grow with the recording."""

    def __init__(self) -> None:
        self._streams: dict[StreamKey, _Stream] = {}

    def watch(self, batches: Iterable[Batch]) -> Iterator[Batch]:
        """Yield the batches, and measure their messages."""
        for batch in batches:
            times: dict[StreamKey, list[NDArray[np.int64]]] = {}
            for entry in batch.entries:
                key = entry.source, entry.name, entry.system, entry.component
                times.setdefault(key, []).append(np.atleast_1d(entry.received_ns))
            for key, received_ns in times.items():
                self._streams.setdefault(key, _Stream()).add(np.concatenate(received_ns))
            yield batch

    def facts(self) -> RecordingFacts:
        """Return the measurements so far."""
        ordered = sorted(self._streams.items(), key=lambda entry: (entry[0][0].name, *entry[0][1:]))
        streams = [(key, stream) for key, stream in ordered if stream.count]
        return RecordingFacts(
            first_ns=min((stream.first_ns for _, stream in streams), default=None),
            last_ns=max((stream.last_ns for _, stream in streams), default=None),
            streams=tuple(
                StreamFacts(*key, count=stream.count, rate_hz=stream.rate_hz(), gaps=stream.gaps())
                for key, stream in streams
            ),
        )


class _Stream:
    """Arrival times of one message, each processed once."""

    def __init__(self) -> None:
        self.count = 0
        self.first_ns = self.last_ns = 0
        self._periods = np.empty(0, np.int64)
        self._usual_ns = 0.0
        self._gaps: list[Gap] = []

    def rate_hz(self) -> float:
        gaps = self.gaps()
        seconds = (self.last_ns - self.first_ns) * 1e-9 - sum(gap.seconds for gap in gaps)
        return (self.count - 1 - len(gaps)) / seconds if seconds > 0 else 0.0

    def gaps(self) -> tuple[Gap, ...]:
        # the first gaps were found before the message's usual period was known
        return tuple(gap for gap in self._gaps if gap.seconds * 1e9 > GAP_PERIODS * self._usual_ns)

    def add(self, times: NDArray[np.int64]) -> None:
        """Measure the next arrival times."""
        if not len(times):
            return
        if not self.count:
            self.first_ns = self.last_ns = int(times[0])
        before = np.concatenate(([self.last_ns], times[:-1]))
        periods = (times - before)[0 if self.count else 1 :]
        before = before[len(before) - len(periods) :]
        if len(self._periods) < _PERIODS_KEPT and len(periods):
            self._periods = np.concatenate((self._periods, periods[: _PERIODS_KEPT - len(self._periods)]))
            self._usual_ns = float(np.median(self._periods))
        for place in np.flatnonzero(periods > max(GAP_S * 1e9, GAP_PERIODS * self._usual_ns)):
            if len(self._gaps) < MOST_GAPS:
                self._gaps.append(Gap(int(before[place]), float(periods[place]) * 1e-9))
        self.count += len(times)
        self.last_ns = int(times[-1])
