"""Edges: a sensor that jumps and then stays, told from a fault of the plant, which makes the same estimate ramp.

A sensor fault is estimated without any assumption about how it moves, so it can explain whatever its output does: the
estimate of a gyro bias takes up a failing motor as well. What a jump of the sensor does and a push on the plant cannot
do is an edge: flat, then another level within a few samples, then flat again, while the hypothesis that it is this
sensor leaves no more unexplained than healthy flight does. The size of the edge is held until an opposite one cancels
it, at most ``hold_s``: how large the bias is afterwards only another sensor can tell. Lines across lost measurements
are flat and have corners: where more than three in five of the samples around an edge are such, it is none.
"""

from __future__ import annotations

from collections import deque
from functools import reduce
from operator import add

import numpy as np
from numpy.typing import NDArray

_MEAN_S = 0.03
_GAP_S = 0.03
_FLAT_S = 0.1
_SHARE = 0.25
_CANCELLED = 0.5
_BRIDGED = 0.6


class EdgeDetector:
    """Watches one sensor fault's estimate.

    Parameters
    ----------
    rate_hz : float
        Samples per second.
    limit : float
        Largest J = r' S^-1 r of the sensor's own hypothesis with which it is believed.
    smallest : float | None
        Smallest edge that is held, in the unit of the estimate; None: edges only show.
    hold_s : float
        How long an edge is held at most, seconds.

    Attributes
    ----------
    edge : float
        Size of an edge that completed at the newest sample, else zero.
    held : float
        Sum of the edges that are held.
    """

    def __init__(self, rate_hz: float, limit: float, smallest: float | None, hold_s: float = 10.0) -> None:
        self._mean = max(1, round(_MEAN_S * rate_hz))
        self._gap = max(1, round(_GAP_S * rate_hz))
        self._flat = max(2, round(_FLAT_S * rate_hz))
        self._longest = round(hold_s * rate_hz)
        self._limit = limit
        self._smallest = smallest
        self._back = (0, self._flat // 2, self._flat, self._flat + self._gap + self._mean)
        self._size = self._back[-1] + self._flat + 1
        self._estimates: deque[float] = deque(maxlen=self._mean)
        self._means: deque[float] = deque(maxlen=self._size)
        self._bridged: deque[bool] = deque(maxlen=self._size)
        self._loud = 0
        self._seen = 0
        self._quiet = 0
        self._age = 0
        self.edge = 0.0
        self.held = 0.0

    def restart(self) -> None:
        """Forget the past."""
        self._estimates.clear()
        self._means.clear()
        self._bridged.clear()
        self._loud = self._seen = self._quiet = self._age = 0
        self.edge = self.held = 0.0

    def update(self, estimate: float, J: float, complete: bool = True) -> float:
        """Take one sample's estimate and the J of its hypothesis; return what is held (or the edge).

        ``complete`` says whether the sample was measured, and not bridged across lost measurements.
        """
        self._bridged.append(not complete)
        self._estimates.append(estimate)
        # Added one by one: what sum() does is another thing in other versions of Python.
        self._means.append(reduce(add, self._estimates) / len(self._estimates))
        self._loud = self._size if self._limit < J else max(0, self._loud - 1)
        self._age += 1
        self._quiet = max(0, self._quiet - 1)
        if self._age > self._longest:
            self.held = 0.0
        found = self._find()
        self._seen = self._seen + 1 if found else 0
        self.edge = found if self._seen >= self._mean and not self._quiet else 0.0
        if self._smallest is None:
            return self.edge
        if self.edge and abs(self.edge) >= self._smallest:
            self._quiet = self._gap + 2 * self._mean
            self._age = 0
            self.held += self.edge
            if abs(self.held) < _CANCELLED * abs(self.edge):
                self.held = 0.0
        return self.held

    def run(
        self, estimates: NDArray[np.float64], J: NDArray[np.float64], complete: NDArray[np.bool_]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Take N samples (N,); return what :meth:`update` returns at each and ``held`` after each.

        A test holds the two together.
        """
        count = len(estimates)
        given, held = np.empty(count), np.empty(count)
        filled = min(count, self._size - len(self._means))
        for k in range(filled):
            given[k] = self.update(float(estimates[k]), float(J[k]), bool(complete[k]))
            held[k] = self.held
        if filled < count:
            # Floats by themselves say nothing of infinities either.
            with np.errstate(over="ignore", invalid="ignore"):
                steps = self._steps(estimates[filled:], J[filled:], complete[filled:])
            self._hold(steps, given[filled:], held[filled:])
        return given, held

    def _steps(
        self, estimates: NDArray[np.float64], J: NDArray[np.float64], complete: NDArray[np.bool_]
    ) -> NDArray[np.float64]:
        """Return what :meth:`_find` finds at each of N samples (N,) after the first that fill the window."""
        count, size = len(estimates), self._size
        known = np.concatenate([self._estimates, estimates])
        total = known[1 : count + 1]
        for k in range(2, self._mean + 1):
            total = total + known[k : count + k]
        means = np.concatenate([self._means, total / self._mean])
        last, middle, after, before = (means[size - back : size - back + count] for back in self._back)
        step = after - before
        swing = np.abs(last - after)
        for other in (np.abs(middle - after), np.abs(before - means[1 : count + 1])):
            swing = np.where(other > swing, other, swing)
        bridged = np.concatenate([self._bridged, ~complete])
        among = np.cumsum(bridged, dtype=np.int64)
        loud = np.where(self._limit < J, np.arange(count), self._loud - size - 1)
        since = np.arange(count) - np.maximum.accumulate(loud)
        flat = (swing < _SHARE * np.abs(step)) & (since >= size)
        flat &= among[size:] - among[:count] <= _BRIDGED * size
        self._estimates.extend(known[count:].tolist())
        self._means.extend(means[count:].tolist())
        self._bridged.extend(bridged[count:].tolist())
        self._loud = max(0, size - int(since[-1]))
        return np.where(flat, step, 0.0)

    def _hold(self, steps: NDArray[np.float64], given: NDArray[np.float64], held: NDArray[np.float64]) -> None:
        """Write what is given and held at each of N samples (N,) with these steps."""
        count, kept = len(steps), 0
        last, quiet_until, since = -1, self._quiet - 1, -1 - self._age
        self.edge = 0.0
        given[:] = 0.0

        def keep(stop: int) -> None:
            end = min(max(since + self._longest + 1, kept), stop)
            held[kept:end] = self.held
            held[end:stop] = 0.0
            if end < stop:
                self.held = 0.0

        for k in np.flatnonzero(steps).tolist():
            self._seen = self._seen + 1 if k == last + 1 else 1
            last = k
            if self._seen < self._mean or k < quiet_until:
                continue
            edge = float(steps[k])
            given[k] = edge
            self.edge = edge if k == count - 1 else 0.0
            if self._smallest is None or abs(edge) < self._smallest:
                continue
            keep(k + 1)
            kept, quiet_until, since = k, k + self._gap + 2 * self._mean, k
            self.held += edge
            if abs(self.held) < _CANCELLED * abs(edge):
                self.held = 0.0
        keep(count)
        self._seen = self._seen if last == count - 1 else 0
        self._quiet, self._age = max(0, quiet_until - count + 1), count - 1 - since
        if self._smallest is not None:
            given[:] = held

    def _find(self) -> float:
        """Return the step from before the gap to after it, zero where the estimate is not flat on both sides."""
        if self._loud or len(self._means) < self._size or sum(self._bridged) > _BRIDGED * self._size:
            return 0.0
        last, middle, after, before = (self._means[-1 - back] for back in self._back)
        step = after - before
        swing = max(abs(last - after), abs(middle - after), abs(before - self._means[0]))
        return step if swing < _SHARE * abs(step) else 0.0
