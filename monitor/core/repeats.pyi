from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

class Repeats: ...

class Frozen:
    def __init__(
        self, first: Sequence[int], width: Sequence[int], hold: Sequence[int], reading: Sequence[int], noisy: int
    ) -> None: ...
    def run(
        self, signals: NDArray[np.float64], lost: NDArray[np.uint8], restart: NDArray[np.uint8]
    ) -> NDArray[np.bool_]: ...
