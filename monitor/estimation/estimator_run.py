"""What an estimator concludes from n samples."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class EstimatorRun(NamedTuple):
    """Estimates and evidence after each of N samples.

    Parameters
    ----------
    x, fault, residual : NDArray[np.float64]
        State estimate (N, n), each fault as estimated (N, a), in a bank under its smallest hypothesis, and residual
        (N, p), not smoothed; x and residual are those of the hypothesis believed.
    evidence : NDArray[np.float64]
        Size of each fault that is held responsible (N, a), zero for all others.
    counted : NDArray[np.bool_]
        Channels whose evidence counts (N, a): in a bank not those that are compared where no hypothesis explains the
        data.
    smoothed : NDArray[np.float64]
        Smoothed estimate of each fault (N, a), in a bank under its smallest hypothesis, whichever is believed.
    unexplained : NDArray[np.float64]
        Score sqrt(min J) where no hypothesis explains the data, else zero (N,).
    """

    x: NDArray[np.float64]
    fault: NDArray[np.float64]
    residual: NDArray[np.float64]
    evidence: NDArray[np.float64]
    counted: NDArray[np.bool_]
    smoothed: NDArray[np.float64]
    unexplained: NDArray[np.float64]
