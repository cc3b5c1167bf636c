"""Recursions over rows that come to the same bits however a stream is cut into batches."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def first_order(keep: float, gained: Array, start: float) -> Array:
    """Return y_k = keep y_{k-1} + gained_k (n,), y_{-1} = ``start``."""
    y = start
    return np.array([y := keep * y + value for value in gained.tolist()], np.float64)


def since(event: NDArray[np.bool_], before: int) -> NDArray[np.intp]:
    """Return the number of rows since the last event, 0 at one (n,); ``before`` says how many it was before row 0."""
    rows = np.arange(len(event))
    return rows - np.maximum.accumulate(np.where(event, rows, -1 - before))
