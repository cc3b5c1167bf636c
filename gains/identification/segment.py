"""Samples of healthy operation, from which identification learns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Segment:
    """Consecutive healthy samples: inputs ``u`` (N, s) and outputs ``y`` (N, p), one grid step apart.

    ``own`` (N,) says which of them are evidence, where some between are not: outputs that were lost and bridged by a
    line, for instance. None: all are.
    """

    u: NDArray[np.float64]
    y: NDArray[np.float64]
    own: NDArray[np.bool_] | None = None

    @property
    def evidence(self) -> NDArray[np.bool_]:
        """Which samples are evidence (N,)."""
        return np.ones(len(self.u), np.bool_) if self.own is None else self.own

    def part(self, start: int, stop: int) -> Segment:
        """Return the samples from row ``start`` to before row ``stop``."""
        return Segment(self.u[start:stop], self.y[start:stop], None if self.own is None else self.own[start:stop])

    def unbroken(self) -> list[Segment]:
        """Return the parts in which all samples are evidence."""
        edges = np.flatnonzero(np.diff(np.concatenate([[False], self.evidence, [False]]).astype(np.int8)))
        return [Segment(self.u[start:stop], self.y[start:stop]) for start, stop in edges.reshape(-1, 2)]
