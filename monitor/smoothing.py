"""First-order smoothing of a stretch of samples, to the bits of smoothing them one by one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter


def smooth(values: NDArray[np.float64], keep: float, state: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return m after each row of ``m *= keep; m += (1 - keep) * row``; ``state`` (m,) is left as after the last one.

    Parameters
    ----------
    values : NDArray[np.float64]
        One row for each sample (N, m).
    keep : float
        Share of m that a sample leaves.
    state : NDArray[np.float64]
        m before the first sample (m,).
    """
    gained = (1.0 - keep) * values
    if not len(values):
        return gained
    if not (np.isfinite(gained).all() and np.isfinite(state).all()):
        # The filter multiplies what it was given by a zero too, which infinity does not survive.
        for row in gained:
            state *= keep
            state += row
            row[:] = state
        return gained
    # With a gain of one the filter rounds as often as m does, also where its products and sums are fused.
    found = np.ascontiguousarray(lfilter([1.0], [1.0, -keep], gained, axis=0, zi=(keep * state)[None])[0])
    state[:] = found[-1]
    return found
