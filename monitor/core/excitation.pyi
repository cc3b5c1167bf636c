from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

class Excitation:
    newest: tuple[float, float, float, float, float]
    furthest: tuple[float, float, float, float]
    rows: int
    def __init__(self, outputs: Sequence[int], variance: Array, hold: int, inputs: int, outside: float) -> None: ...
    def run(self, u: Array, y: Array, restart: NDArray[np.bool_], level: Array) -> Array: ...

class Beyond:
    factor: float
    reached: tuple[float, float, float]
    furthest: tuple[float, float, float]
    rows: int
    def __init__(self, fitted: Sequence[float], columns: Sequence[int], keep: float, outside: float) -> None: ...
    def run(self, signals: Array, restart: NDArray[np.bool_], ends: NDArray[np.intp]) -> Array: ...
