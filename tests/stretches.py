"""Whether a stage comes to the same bits over stretches as one by one, however a stream is cut into them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from adapters.sample import Sample, Samples, stacked
from monitor.sampling.transform import Transform

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


def one_by_one(transform: Transform, raw: Samples) -> list[tuple[int, tuple[object, ...]]]:
    """Return what ``feed`` gives and at which rows, ``known_ns`` as the sampler behind it fills it in."""
    found = []
    for row in range(len(raw)):
        sample = raw.one(row)
        given = transform.feed(sample)
        if given is not None:
            one = stacked([given], len(given.u), len(given.y))
            one.known_ns[0] = sample.known_ns
            found.append((row, said(one.one(0))))
    return found


def in_stretches(
    transform: Transform, raw: Samples, parts: list[tuple[int, int, bool]]
) -> list[tuple[int, tuple[object, ...]]]:
    """Return the same by ``run`` on some parts and ``feed`` on the others."""
    found = []
    for start, stop, singly in parts:
        part = raw.part(start, stop)
        if singly:
            given = one_by_one(transform, part)
        else:
            samples, rows = transform.run(part)
            assert len(samples) == len(rows)
            given = [(int(row), said(samples.one(k))) for k, row in enumerate(rows)]
        found += [(row + start, sample) for row, sample in given]
    return found
