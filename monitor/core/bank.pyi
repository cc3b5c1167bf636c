from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

class Choice:
    def __init__(
        self,
        whitening: Array,
        lasting: Array,
        spans: ArrayLike,
        channel: ArrayLike,
        shown: ArrayLike,
        scaling: ArrayLike,
        groups: Sequence[NDArray[np.intp]],
        own: NDArray[np.bool_],
        edges: Sequence[tuple[int, int, EdgeDetector]],
        washouts: Sequence[tuple[int, Washout]],
        keep: float,
        floor: float,
        share: float,
        penalty: float,
        usual: float = 0.0,
        follow: float = 0.0,
        calm: Array | None = None,
        calm_rows: int = 0,
    ) -> None: ...
    def run(
        self,
        x: Array,
        fault: Array,
        residual: Array,
        y: Array,
        measured: Flags,
        complete: Flags,
        restart: Flags,
        armed: Flags,
        beyond: Array | None,
        corrected: Flags | None = None,
        resumed: Flags | None = None,
    ) -> tuple[Array, Array, Array, Array, Flags, Array, Array, Array, NDArray[np.intp], Flags]: ...

class EdgeDetector:
    edge: float
    held: float
    def __init__(self, mean: int, gap: int, flat: int, longest: int, limit: float, smallest: float) -> None: ...
    def run(self, estimates: Array, J: Array, complete: Flags) -> Array: ...

class Washout:
    threshold: float
    peak: float
    def __init__(self, share: float, threshold: float, settle: int, longest: int) -> None: ...
    def run(self, washed: Array) -> Array: ...

class IndependentIsolation:
    def __init__(self, channels: int, keep: float) -> None: ...
    def run(self, fault: Array, measured: Flags, restart: Flags) -> Array: ...
