"""Whether a stage comes to the same bits over stretches as one by one, however a stream is cut into them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from adapters.sample import Sample

FIELDS = ("index", "vehicle_time_ns", "time_ns", "restart", "complete", "known_ns", "measured")


def partitions(count: int) -> st.SearchStrategy[list[tuple[int, int, bool]]]:
    """Return ways to cut ``count`` rows: start and stop of each part, and whether it is taken row by row."""
    cuts = st.lists(st.integers(0, count), max_size=6).map(lambda some: sorted([0, *some, count]))
    kinds = st.lists(st.booleans(), min_size=8, max_size=8)
    return st.tuples(cuts, kinds).map(
        lambda drawn: [(*span, kind) for span, kind in zip(pairwise(drawn[0]), drawn[1], strict=False)]
    )


def bits(values: NDArray[np.float64] | Sequence[float]) -> bytes:
    """Return the bits of numbers; all that are no number have the same."""
    array = np.array(values, np.float64)
    return np.where(np.isnan(array), np.nan, array).tobytes()


def said(sample: Sample) -> tuple[object, ...]:
    """Return all there is in a sample, to compare to the bit."""
    return (*(getattr(sample, name) for name in FIELDS), sample.u.shape, bits(sample.u), sample.y.shape, bits(sample.y))
