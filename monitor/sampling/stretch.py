"""What stages need to take a stretch of samples at once and come to the bits that one after the other gives.

NumPy's elementwise arithmetic and square root round like Python's; its sines, powers and sums need not. Recursions go
through Python's numbers: some 50 ns a step, and no filter routine that might fuse or reorder what is rounded.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adapters.sample import Sample, Samples, stacked

Array = NDArray[np.float64]


class Given(NamedTuple):
    """Samples that a stretch of raw samples gave, and the row of the raw sample that completed each."""

    samples: Samples
    rows: NDArray[np.intp]


def mapped(function: Callable[[float], float], values: Array) -> Array:
    """Return a function of ``math`` of each number (n,)."""
    return np.array([function(value) for value in values.tolist()], np.float64)


def first_order(keep: float, gained: Array, start: float) -> Array:
    """Return y_k = keep y_{k-1} + gained_k (n,), y_{-1} = ``start``."""
    y = start
    return np.array([y := keep * y + value for value in gained.tolist()], np.float64)


def since(event: NDArray[np.bool_], before: int) -> NDArray[np.intp]:
    """Return the number of rows since the last event, 0 at one (n,); ``before`` says how many it was before row 0."""
    rows = np.arange(len(event))
    return rows - np.maximum.accumulate(np.where(event, rows, -1 - before))


def in_parts(
    samples: Samples,
    run: Callable[[Samples], Given],
    feed: Callable[[Sample], Sample | None],
    widths: tuple[int, int],
) -> Given:
    """Take raw samples in parts that are restarted at their first row at most and have all ticks in between.

    Parameters
    ----------
    samples : Samples
        The stretch.
    run : Callable
        Takes such a part at once.
    feed : Callable
        Takes one sample: what is not finite has no sine, and is left to it.
    widths : tuple[int, int]
        Number of inputs and of outputs given out.

    Returns
    -------
    Given
        Each sample with the ``known_ns`` of the raw sample that completed it, as
        :meth:`monitor.sampling.transform.TransformedSampler.feed` says it.
    """
    found = []
    for start, stop in _parts(samples):
        part = samples.part(start, stop)
        given = run(part) if np.isfinite(part.u).all() else one_by_one(feed, part, widths)
        found.append(Given(given.samples, given.rows + start))
    given = joined(found, widths)
    return Given(replace(given.samples, known_ns=samples.known_ns[given.rows]), given.rows)


def one_by_one(feed: Callable[[Sample], Sample | None], samples: Samples, widths: tuple[int, int]) -> Given:
    """Take raw samples one after the other; ``known_ns`` of what they give is not filled in."""
    given = [(feed(samples.one(row)), row) for row in range(len(samples))]
    found = [(sample, row) for sample, row in given if sample is not None]
    return Given(stacked([sample for sample, _ in found], *widths), np.array([row for _, row in found], np.intp))


def joined(parts: Sequence[Given], widths: tuple[int, int]) -> Given:
    """Return parts one after the other."""
    given = [part for part in parts if len(part.rows)]
    if len(given) == 1:
        return given[0]
    if not given:
        return Given(stacked((), *widths), np.zeros(0, np.intp))
    names = Samples.__slots__
    columns = {name: np.concatenate([getattr(part.samples, name) for part in given]) for name in names}
    return Given(Samples(**columns), np.concatenate([part.rows for part in given]))


def _parts(samples: Samples) -> Iterator[tuple[int, int]]:
    cuts = np.flatnonzero(samples.restart[1:] | (np.diff(samples.index) != 1)) + 1
    return pairwise([0, *cuts.tolist(), len(samples)]) if len(samples) else iter(())
