"""Where evidence is heading: its slope, so that a fault which grows is critical early."""

from __future__ import annotations

import math

_QUICK_S = 0.5
_SLOW_S = 2.0
_WAIT_S = 1.0


class Trend:
    """Slope of one channel's evidence since its alarm was raised.

    Of a ramp with slope s the means lag by s times their time constants, so s = (quick - slow) / (2.0 s - 0.5 s). The
    first second is left out, in which the observer is still on its way to a fault that came as a step; nothing is said
    before the slow mean has run for its time constant.
    """

    def __init__(self) -> None:
        self._run_s = 0.0
        self._quick = self._slow = 0.0

    def update(self, evidence: float, elapsed_ns: int) -> None:
        """Take evidence that stood for some time, nanoseconds."""
        elapsed_s = elapsed_ns / 1e9
        before = self._run_s
        self._run_s += elapsed_s
        if before < _WAIT_S:
            self._quick = self._slow = evidence
            return
        self._quick += (1.0 - math.exp(-elapsed_s / _QUICK_S)) * (evidence - self._quick)
        self._slow += (1.0 - math.exp(-elapsed_s / _SLOW_S)) * (evidence - self._slow)

    def size_in(self, seconds: float) -> float:
        """Return the size the evidence will have some seconds ahead if it goes on growing; 0 where it does not grow."""
        if self._run_s < _WAIT_S + _SLOW_S:
            return 0.0
        slope = (self._quick - self._slow) / (_SLOW_S - _QUICK_S)
        now = self._quick + slope * _QUICK_S
        return abs(now + slope * seconds) if slope * now > 0.0 else 0.0
