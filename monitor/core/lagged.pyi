from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from adapters.sample import Given, Samples

def cosines(angles: NDArray[np.float64]) -> NDArray[np.float64]: ...
def sines(angles: NDArray[np.float64]) -> NDArray[np.float64]: ...

class LaggedMeans:
    def __init__(
        self, timing: Sequence[tuple[float, float]], rate_hz: float, size: int, inputs: int, outputs: int
    ) -> None: ...
    def run(self, samples: Samples, columns: Sequence[NDArray[np.float64]], evidence: NDArray[np.bool_]) -> Given: ...
