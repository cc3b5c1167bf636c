"""First-order smoothing of a stretch of samples, to the bits of smoothing them one by one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def smooth(values: NDArray[np.float64], keep: float, state: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return m after each row of ``m *= keep; m += (1 - keep) * row``; ``state`` (m,) is left as after the last one.

    Two vector operations a row: a filter routine is faster, but to load the package it is in takes longer than a
    flight.

    Parameters
    ----------
    values : NDArray[np.float64]
        One row for each sample (N, m).
    keep : float
        Share of m that a sample leaves.
    state : NDArray[np.float64]
        m before the first sample (m,).
    """
    found = (1.0 - keep) * values
    if not len(found):
        return found
    before, kept = state, np.empty_like(state)
    multiply, add = np.multiply, np.add
    for row in found:
        multiply(before, keep, kept)
        add(kept, row, row)
        before = row
    state[:] = before
    return found
