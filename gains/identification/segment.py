"""What identification learns from: unbroken samples of healthy operation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Segment:
    """Consecutive healthy samples: inputs ``u`` (N, s) and outputs ``y`` (N, p), one grid step apart."""

    u: NDArray[np.float64]
    y: NDArray[np.float64]
