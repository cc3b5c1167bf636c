"""What an estimator says over a stretch of samples, and where such a stretch has to be taken apart."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adapters.sample import Samples


@dataclass(frozen=True, slots=True, eq=False)
class EstimatorRun:
    """What the attributes of an estimator hold after each of N samples.

    Parameters
    ----------
    x, residual : NDArray[np.float64]
        State estimate (N, n) and residual (N, p), of the hypothesis believed where it is a bank.
    fault, evidence : NDArray[np.float64]
        Each fault as estimated (N, a), and what each is held responsible for (N, a).
    speaks : NDArray[np.bool_]
        Channels whose evidence counts (N, a).
    unexplained : NDArray[np.float64]
        Score of what no hypothesis explains (N,).
    smoothed : NDArray[np.float64]
        Smoothed estimate of each fault under its own hypothesis, whichever is believed (N, a).
    """

    x: NDArray[np.float64]
    residual: NDArray[np.float64]
    fault: NDArray[np.float64]
    evidence: NDArray[np.float64]
    speaks: NDArray[np.bool_]
    unexplained: NDArray[np.float64]
    smoothed: NDArray[np.float64]

    def part(self, start: int, stop: int) -> EstimatorRun:
        """Return the samples start <= row < stop, as views."""
        rows = slice(start, stop)
        return EstimatorRun(
            self.x[rows],
            self.residual[rows],
            self.fault[rows],
            self.evidence[rows],
            self.speaks[rows],
            self.unexplained[rows],
            self.smoothed[rows],
        )


def empty_run(count: int, states: int, outputs: int, faults: int) -> EstimatorRun:
    """Return room for N samples."""
    return EstimatorRun(
        x=np.empty((count, states)),
        residual=np.empty((count, outputs)),
        fault=np.empty((count, faults)),
        evidence=np.empty((count, faults)),
        speaks=np.empty((count, faults), dtype=np.bool_),
        unexplained=np.empty(count),
        smoothed=np.empty((count, faults)),
    )


class Piece(NamedTuple):
    """Samples start <= row < stop that are all measured or all coasted, restarting at the first or not at all."""

    start: int
    stop: int
    restart: bool
    measured: bool


def pieces(samples: Samples, longest: int = 2048) -> Iterator[Piece]:
    """Yield the pieces of a stretch in order, none longer than what stays in the processor's cache."""
    measured = samples.measured | samples.restart
    begins = samples.restart.copy()
    begins[1:] |= measured[1:] != measured[:-1]
    begins[::longest] = True
    for start, stop in pairwise([*np.flatnonzero(begins).tolist(), len(samples)]):
        yield Piece(start, stop, bool(samples.restart[start]), bool(measured[start]))
