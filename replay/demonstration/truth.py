"""What was injected: the course of a fault that a recording or simulation is known to hold."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Truth:
    """One injected fault.

    Parameters
    ----------
    channel : str
        The fault channel it should show up on.
    start_s, stop_s : float
        When it acts, seconds of the vehicle's clock.
    signal : Callable[[float], float]
        Its size over time.
    relative : bool
        Whether the size is a share of the command.
    """

    channel: str
    start_s: float
    stop_s: float
    signal: Callable[[float], float]
    relative: bool = False

    def at(self, time_s: float) -> float:
        """Return the size at a time, zero while it does not act."""
        return self.signal(time_s) if self.start_s <= time_s < self.stop_s else 0.0

    def course(self, times_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the sizes at many times (N,)."""
        return np.array([self.at(float(time_s)) for time_s in times_s])
