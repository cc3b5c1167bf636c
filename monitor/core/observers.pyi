from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

class AffineMap:
    def __init__(
        self,
        maps: Sequence[tuple[Array, Array]],
        initial: Array,
        curves: Array,
        bends: Array,
        lagged: Array,
        newer: NDArray[np.intp],
        source: NDArray[np.intp],
        functions: Sequence[Callable[..., float]],
        spans: ArrayLike,
        owner: NDArray[np.intp],
        scaled: NDArray[np.intp],
        observers: int,
        states: int,
        outputs: int,
    ) -> None: ...
    def run(self, u: Array, y: Array, measured: Flags, restart: Flags) -> tuple[Array, Array, Array]: ...

class ErrorCovariance:
    def __init__(
        self,
        A: Array,
        Q: Array,
        steady: Array,
        start: Array,
        owner: NDArray[np.intp],
        entry: NDArray[np.intp],
        scale: Array,
        tolerance: float,
    ) -> None: ...
    def run(self, measured: Flags, restart: Flags) -> Array: ...

class FlightErrors:
    def __init__(self, faults: int, dt: float, prior_s: float, memory_s: float, most: float) -> None: ...
    def run(self, sd: Array, fault: Array, level: Array, healthy: Flags) -> Array: ...

class SizeErrors:
    def __init__(self, rows: NDArray[np.intp], ahead: Array, apart: Array) -> None: ...
    def run(self, sd: Array, sizes: Array, shown: Array, full: Array) -> Array: ...

class CommandScale:
    def __init__(self, curves: Array, inputs: NDArray[np.intp], channel: NDArray[np.intp], keep: float) -> None: ...
    def run(
        self, u: Array, restart: Flags, fault: Array, evidence: Array, sd: Array
    ) -> tuple[Array, Array, Array, Array, Array]: ...

def shares_in_command(curves: Array, inputs: NDArray[np.intp], command: Array, share: Array) -> Array: ...
