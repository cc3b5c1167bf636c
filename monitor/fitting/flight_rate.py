"""How often a message comes while a vehicle flies and its link holds."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_SHORTEST_GAP_NS = 5_000_000_000
"""A step of 5 s and of ten usual ones is a gap: nothing was recorded, as between two flights in a log. Chosen: what is
lost for less is a bad link, and belongs in its rate.
"""
_GAP_STEPS = 10.0
"""See there."""
_RESTART_NS = -1_000_000_000
"""A stamp that lies further back than this is of a clock that began anew; a packet that came late is nearer."""
_BINS_PER_OCTAVE = 4
"""Steps are counted by their logarithm, so that a recording of any length is counted in the same room. Chosen: the
usual step is then known to a fifth.
"""
_BINS = 64 * _BINS_PER_OCTAVE


class FlightRate:
    """Counts the steps from stamp to stamp of one message.

    With ``repeats`` messages of the same time count, as those that arrive together; else they are one measurement.
    """

    def __init__(self, *, repeats: bool = False) -> None:
        self._repeats = repeats
        self._last_ns: int | None = None
        self._counts = np.zeros(_BINS, np.int64)
        self._sums_ns = np.zeros(_BINS, np.float64)
        # of steps back, which messages that overtake each other take
        self._late = 0
        self._late_ns = 0.0

    def add(self, stamps_ns: NDArray[np.int64]) -> None:
        """Count the stamps (n,) of messages in the order in which they came."""
        if not len(stamps_ns):
            return
        before = stamps_ns[:1] if self._last_ns is None else np.array([self._last_ns])
        steps = np.diff(np.concatenate([before, stamps_ns])).astype(np.float64)
        steps = steps[self._last_ns is None :]
        self._last_ns = int(stamps_ns[-1])
        late = steps[(steps <= 0.0 if self._repeats else steps < 0.0) & (steps > _RESTART_NS)]
        self._late += len(late)
        self._late_ns += float(late.sum())
        ahead = steps[steps > 0.0]
        place = (_BINS_PER_OCTAVE * np.log2(ahead)).astype(np.int64)
        self._counts += np.bincount(place, minlength=_BINS)
        self._sums_ns += np.bincount(place, ahead, _BINS)

    @property
    def hz(self) -> float | None:
        """Messages per second without the gaps, None where there are no two."""
        total = int(self._counts.sum())
        if not total:
            return None
        usual = int(np.searchsorted(np.cumsum(self._counts), 0.5 * total))
        longest_ns = max(_GAP_STEPS * 2.0 ** ((usual + 1) / _BINS_PER_OCTAVE), _SHORTEST_GAP_NS)
        kept = np.arange(_BINS) <= _BINS_PER_OCTAVE * np.log2(longest_ns)
        seconds = 1e-9 * (float(self._sums_ns[kept].sum()) + self._late_ns)
        return float(self._counts[kept].sum() + self._late) / seconds if seconds > 0.0 else None
