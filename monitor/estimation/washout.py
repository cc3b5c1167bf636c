"""Give back what washing out takes from a fault that stands.

An observer of washed-out positions and angles sees a fault f through the same washout,

    f_w' = f' - f_w / tau,     whose exact inverse is     f = f_w + (1/tau) * integral of f_w dt,

so a step fades and, when the fault ends, swings to the other side. Integrated for ever the inverse would grow with
every error of healthy operation; it is integrated while |f_w| says that something is there:

- nothing there (integral zero) and |f_w| <= threshold / 2: f = f_w;
- |f_w| > threshold / 2: the integral runs (by the trapezoidal rule), and f = f_w + integral / tau;
- |f_w| <= threshold / 2 again while f is still large: the fault stands, fully washed out; the integral is held;
- |f| back within the threshold, or within a tenth of its peak (what errors of a tenth leave): the fault is over, and
  zero is given until |f_w| has settled too, when everything is forgotten.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_QUIET = 0.5
_OVER = 0.1


class Unwash:
    """Inverse of the washout of one fault channel.

    Feed it the smoothed estimate of the channel under its own hypothesis, every sample, whichever hypothesis is
    believed: switching it off and on would cut pieces out of the integral.

    Parameters
    ----------
    tau : float
        Time constant of the washout, seconds.
    rate_hz : float
        Samples per second.
    threshold : float
        Alarm threshold of the channel, in its unit.

    Attributes
    ----------
    peak : float
        Largest size of f since the fault began, zero without one.
    """

    def __init__(self, tau: float, rate_hz: float, threshold: float) -> None:
        self._share = 0.5 / (tau * rate_hz)
        self._threshold = threshold
        self._before = 0.0
        self._integral = 0.0
        self.peak = 0.0

    def restart(self) -> None:
        """Forget the past."""
        self._before = self._integral = self.peak = 0.0

    def update(self, washed: float) -> float:
        """Take the estimate f_w of one sample; return f."""
        moves = abs(washed) > _QUIET * self._threshold
        if moves:
            self._integral += self._share * (washed + self._before)
        self._before = washed
        fault = washed + self._integral
        size = abs(fault)
        if size > self._threshold:
            self.peak = max(self.peak, size)
        over = size <= max(self._threshold, _OVER * self.peak)
        if over and not moves:
            self._integral = self.peak = 0.0
            return washed
        return 0.0 if over and self.peak > 0.0 else fault

    def run(self, washed: NDArray[np.float64]) -> NDArray[np.float64]:
        """Take the estimates f_w of N samples (N,); return f (N,), as :meth:`update` gives it one by one."""
        found = washed.copy()
        if not len(washed):
            return found
        moving = np.flatnonzero(np.abs(washed) > _QUIET * self._threshold)
        k = 0
        while k < len(washed):
            if self._integral == 0.0 and self.peak == 0.0:
                following = int(np.searchsorted(moving, k))
                if following == len(moving):
                    break
                if moving[following] > k:
                    k = int(moving[following])
                    self._before = float(washed[k - 1])
            found[k] = self.update(float(washed[k]))
            k += 1
        self._before = float(washed[-1])
        return found
