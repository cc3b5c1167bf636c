"""A long series thinned to the points that draw the same line, without losing a peak."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

BINS = 1500
"""Chosen: more than a picture of 8 in at 160 dpi has pixels across."""


def envelope(
    times: NDArray[np.float64], values: NDArray[np.float64], restart: NDArray[np.bool_], bins: int = BINS
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return fewer points that draw the same line.

    Runs of samples become their smallest and largest value in the order they occurred. The line is broken (by
    NaN) where the observer started afresh.

    Parameters
    ----------
    times, values : NDArray[np.float64]
        The series (N,).
    restart : NDArray[np.bool_]
        Where it starts afresh (N,).
    bins : int
        Number of runs, for the whole series.
    """
    size = -(-len(values) // bins)
    edges = np.union1d(np.flatnonzero(restart), [0, len(values)])
    found: list[NDArray[np.float64]] = []
    for start, stop in pairwise(edges.astype(np.intp)):
        picked = np.arange(start, stop)
        if size > 2 and stop - start > 2 * size:
            picked = _extremes(values[start:stop], size) + start
        found += [np.stack((times[picked], values[picked])), np.full((2, 1), np.nan)]
    joined = np.concatenate(found[:-1], axis=1) if found else np.empty((2, 0))
    return joined[0], joined[1]


def band(
    times: NDArray[np.float64], low: NDArray[np.float64], high: NDArray[np.float64], bins: int = BINS
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return fewer points that draw the same band between two series (N,): its ends over runs of samples.

    A run that holds no number keeps none, so that the band is broken there.
    """
    size = -(-len(times) // bins)
    if size < 2:
        return times, low, high
    starts = np.arange(0, len(times), size)
    # fmin and fmax pass over what is no number
    return times[starts], np.fmin.reduceat(low, starts), np.fmax.reduceat(high, starts)


def _extremes(values: NDArray[np.float64], size: int) -> NDArray[np.intp]:
    """Return the places of the smallest and the largest value of each run of ``size`` samples, in order."""
    whole = len(values) // size * size
    rest = np.arange(whole, len(values))
    runs = values[:whole].reshape(-1, size)
    runs = np.where(np.isnan(runs), 0.0, runs)
    both = np.sort(np.stack((runs.argmin(axis=1), runs.argmax(axis=1)), axis=1), axis=1)
    picked = (both + np.arange(0, whole, size)[:, None]).ravel()
    if len(rest):
        last = np.where(np.isnan(values[rest]), 0.0, values[rest])
        picked = np.append(picked, whole + np.sort([last.argmin(), last.argmax()]))
    return picked
