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

    Attributes
    ----------
    state : tuple[float, float, float]
        How long it has run, seconds, its quick and its slow mean: all that it remembers.
    """

    def __init__(self) -> None:
        self.state = (0.0, 0.0, 0.0)

    def update(self, evidence: float, elapsed_ns: int) -> None:
        """Take evidence that stood for some time, nanoseconds."""
        elapsed_s = elapsed_ns / 1e9
        run_s, quick, slow = self.state
        if run_s < _WAIT_S:
            self.state = (run_s + elapsed_s, evidence, evidence)
            return
        self.state = (
            run_s + elapsed_s,
            quick + (1.0 - math.exp(-elapsed_s / _QUICK_S)) * (evidence - quick),
            slow + (1.0 - math.exp(-elapsed_s / _SLOW_S)) * (evidence - slow),
        )

    def size_in(self, seconds: float) -> float:
        """Return the size the evidence will have some seconds ahead if it goes on growing; 0 where it does not grow."""
        run_s, quick, slow = self.state
        if run_s < _WAIT_S + _SLOW_S:
            return 0.0
        slope = (quick - slow) / (_SLOW_S - _QUICK_S)
        now = quick + slope * _QUICK_S
        return abs(now + slope * seconds) if slope * now > 0.0 else 0.0
