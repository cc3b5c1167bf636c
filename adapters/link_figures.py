"""Quality of a telemetry link: delay, jitter and lost share, from sequence numbers, stamps and times of arrival.

Arrival minus stamp is the offset of two clocks plus a delay. For each kind of message, the smallest value of the one to
two minutes before a message counts as no delay: the delay is how much later a message comes than the quickest of its
kind. Jitter is the mean change of the delay between two messages, the difference D of RFC 3550, section 6.4.1,
without its smoothing. If packets are numbered, gaps in the numbers are losses; otherwise a step of the stamps of at
least twice the usual step is a loss.
"""

from collections import deque
from collections.abc import Iterable
from statistics import median
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adapters.batch import Batch, Columns, joined
from adapters.channels import CLOCK_UNITS_NS

_MINUTE_NS = 60_000_000_000
_MOST_BATCHES = 1024
"""Batches that wait to be evaluated; the oldest is dropped first. Chosen: 20 s of those of a live link, 20 ms each."""
_LOOK_NS = 5_000_000_000
"""Time of arrival after which new messages of a live link are evaluated. Chosen: a twelfth of the minute that figures
cover; an evaluation takes some 3 ms for a dozen kinds of message, however few there are of each."""
_BROKEN_NS = 10_000_000_000
"""Largest step of stamps that counts as a loss: a longer one is a pause or another clock, and the vehicle's clock
starts anew."""
_SET_NS = _MINUTE_NS
"""Delay from which on the receiver's clock was set forward: as long as the quickest message is known at least."""
_LOST = 1.75
"""Step, in usual steps, from which measurements are missing: the same number as the sampler's."""
_STEPS = 31
"""Fewest steps whose median is the usual step; the same number as the sampler's."""


class LinkFigures(NamedTuple):
    """Means over the last minute or a whole recording; None if they cannot be measured."""

    delay_s: float | None = None
    jitter_s: float | None = None
    lost_share: float | None = None

    def rounded(self) -> dict[str, float | None]:
        """Return the figures as a JSON object, rounded to 0.1 ms and a hundredth of a per cent."""
        return {name: None if value is None else round(value, 4) for name, value in self._asdict().items()}


class _Sums(NamedTuple):
    """Sums that messages add to the means."""

    delay_ns: float = 0.0
    delays: int = 0
    change_ns: float = 0.0
    changes: int = 0
    lost: int = 0
    came: int = 0


def _total(sums: Iterable[_Sums]) -> _Sums:
    return _Sums(*map(sum, zip(_Sums(), *sums, strict=True)))


class _Stream:
    """Messages of one kind and sender."""

    def __init__(self) -> None:
        self._stamp_ns = self._transit_ns = 0
        self._steps: NDArray[np.int64] = np.zeros(0, np.int64)
        self._least_ns: deque[tuple[int, int]] = deque(maxlen=2)

    def add(self, stamps: NDArray[np.int64], received: NDArray[np.int64]) -> _Sums:
        """Update from stamped messages in order of arrival; return the sums that they add."""
        if abs(int(stamps[0]) - self._stamp_ns) > _BROKEN_NS:
            self.__init__()  # type: ignore[misc]
        known = bool(self._steps.size or self._stamp_ns)
        transit = received - stamps
        minute = int(received[-1]) // _MINUTE_NS
        # Only earlier messages: if a simulation's clock runs fast, each message comes quicker than the last.
        quickest = np.minimum.accumulate(transit)
        if self._least_ns:
            quickest = np.minimum(quickest, min(least_ns for _, least_ns in self._least_ns))
        delays = transit - quickest
        delays = delays[delays < _SET_NS]
        least = int(transit.min())
        if self._least_ns and self._least_ns[-1][0] == minute:
            self._least_ns[-1] = minute, min(least, self._least_ns[-1][1])
        else:
            self._least_ns.append((minute, least))
        before = np.concatenate([[self._transit_ns], transit]) if known else transit
        changes = np.abs(before[1:] - before[:-1])
        changes = changes[changes < _SET_NS]
        ordered = np.unique(np.concatenate([[self._stamp_ns], stamps]) if known else stamps)
        steps = ordered[1:] - ordered[:-1]
        steps = steps[steps < _BROKEN_NS]
        known_steps = np.concatenate([self._steps, steps])
        self._steps = known_steps[-_STEPS:]
        self._stamp_ns, self._transit_ns = int(ordered[-1]), int(transit[-1])
        usual = float(median(known_steps.tolist())) if len(known_steps) >= _STEPS else np.inf
        late = steps[steps > _LOST * usual]
        return _Sums(
            float(delays.sum()),
            len(delays),
            float(changes.sum()),
            len(changes),
            int(np.rint(late / usual).sum()) - len(late),
            len(steps) if usual < np.inf else 0,
        )


class LinkMeter:
    """Measures a link by the messages that arrive over it.

    With ``recent`` the figures cover the last minute, otherwise all messages.
    """

    def __init__(self, recent: bool = True) -> None:
        self._recent = recent
        self._waiting: deque[Batch] = deque(maxlen=_MOST_BATCHES if recent else None)
        self._streams: dict[tuple[str, int, int], _Stream] = {}
        self._sums: deque[tuple[int, _Sums]] = deque()
        self._numbered: deque[tuple[int, int, int]] = deque()
        self._looked_ns = 0

    def count(self, batch: Batch) -> None:
        """Receive a batch; any thread may call it."""
        if batch.count:
            self._waiting.append(batch)
        if not self._recent:
            self._look()

    def figures(self, received: int = 0, lost: int | None = None) -> LinkFigures:
        """Return the figures; ``received`` and ``lost`` are the packets so far, if packets are numbered."""
        if self._waiting and abs(_newest_ns(self._waiting[-1]) - self._looked_ns) >= _LOOK_NS:
            self._look()
        total = _total(sums for _, sums in self._sums)
        share = total.lost / (total.lost + total.came) if total.came else None
        if lost is not None:
            now_ns = self._sums[-1][0] if self._sums else 0
            self._numbered.append((now_ns, received, lost))
            while self._recent and self._numbered[0][0] < now_ns - _MINUTE_NS:
                self._numbered.popleft()
            _, first_received, first_lost = self._numbered[0] if len(self._numbered) > 1 else (0, 0, 0)
            gone = lost - first_lost
            share = gone / (gone + received - first_received) if received > first_received else None
        return LinkFigures(
            total.delay_ns / total.delays / 1e9 if total.delays else None,
            total.change_ns / total.changes / 1e9 if total.changes else None,
            share,
        )

    def _look(self) -> None:
        self._looked_ns = _newest_ns(self._waiting[-1]) if self._waiting else 0
        newest_ns, sums = 0, []
        for columns in joined([self._waiting.popleft() for _ in range(len(self._waiting))]).columns:
            stamps = None if columns.source.is_onboard_log else _stamps(columns)
            if stamps is not None:
                # A repeated stamp is one measurement.
                new = np.concatenate([[True], stamps[1:] != stamps[:-1]])
                stream = self._streams.setdefault((columns.name, columns.system, columns.component), _Stream())
                breaks = np.flatnonzero(np.abs(np.diff(stamps[new])) > _BROKEN_NS) + 1
                parts = (np.split(values[new], breaks) for values in (stamps, columns.received_ns))
                sums += [stream.add(*part) for part in zip(*parts, strict=True)]
                newest_ns = max(newest_ns, int(columns.received_ns[-1]))
        if sums:
            self._sums.append((newest_ns, _total(sums)))
        if not self._recent and len(self._sums) > _MOST_BATCHES:
            self._sums = deque([(0, _total(sums for _, sums in self._sums))])
        while self._recent and self._sums and self._sums[0][0] < self._sums[-1][0] - _MINUTE_NS:
            self._sums.popleft()


def _newest_ns(batch: Batch) -> int:
    return max((int(columns.received_ns[-1]) for columns in batch.columns), default=0)


def _stamps(columns: Columns) -> NDArray[np.int64] | None:
    """Return the stamps of telemetry on its sender's clock, nanoseconds, or None if it has none."""
    for name, unit_ns in CLOCK_UNITS_NS.items() if columns.source.is_telemetry else ():
        values = columns.fields.get(name)
        if values is not None:
            if values.ndim != 1 or values.dtype.kind not in "iu":
                return None
            stamps = values.astype(np.int64)
            return stamps * unit_ns if np.all((stamps > 0) & (stamps < (1 << 62) // unit_ns)) else None
    return None
