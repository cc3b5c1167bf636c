"""One (u, y) sample on the fixed-rate grid of the vehicle's clock: what the observer eats."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Sample:
    """Inputs and outputs of a plant at one tick of the grid.

    Parameters
    ----------
    index : int
        Tick number k; the tick is at k / rate on the vehicle's clock.
    vehicle_time_ns : int
        Time of the tick on the vehicle's own clock, nanoseconds since its start.
    time_ns : int
        Unix time of the tick, nanoseconds.
    u, y : NDArray[np.float64]
        Inputs (s,) and outputs (p,) in the channel order of the profile, units of the plant model.
    restart : bool
        True on the first sample after a gap, a clock jump or the start: the observer starts afresh.
    complete : bool
        False where a channel was bridged across lost measurements: an estimate, no evidence.
    known_ns : int
        Time on the vehicle's clock of the newest measurement it was interpolated from, where that is later than
        the tick: with a GPS of 5 Hz up to 200 ms. What is concluded from the sample is not known earlier.
    measured : bool
        False where an output was bridged across three or more lost measurements: the observer coasts on its model,
        which says more than the straight line that ``y`` holds there.
    """

    index: int
    vehicle_time_ns: int
    time_ns: int
    u: NDArray[np.float64]
    y: NDArray[np.float64]
    restart: bool
    complete: bool
    known_ns: int = 0
    measured: bool = True

    @property
    def later_ns(self) -> int:
        """By how much the sample was known later than its tick, nanoseconds."""
        return max(0, self.known_ns - self.vehicle_time_ns)
