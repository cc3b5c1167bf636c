from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

class Excitation:
    def __init__(self, outputs: Sequence[int], variance: Array, hold: int, inputs: int) -> None: ...
    def run(self, u: Array, y: Array, restart: NDArray[np.bool_], level: Array) -> Array: ...
