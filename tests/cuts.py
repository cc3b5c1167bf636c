"""Ways to cut a stream of rows into batches: what a stage makes of it must not depend on them, to the bit."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray


def cuts(count: int) -> st.SearchStrategy[list[slice]]:
    """Return ways to cut ``count`` rows into batches, some of them empty or of one row."""
    some = st.lists(st.integers(0, count), max_size=8)
    return some.map(lambda at: [slice(*span) for span in pairwise(sorted([0, *at, *(k + 1 for k in at[:2]), count]))])


def same_bits(one: NDArray[Any], other: NDArray[Any]) -> bool:
    """Return whether numbers have the same bits; all that are no number count as the same."""
    return one.shape == other.shape and bool(np.all((one == other) | (np.isnan(one) & np.isnan(other))))
