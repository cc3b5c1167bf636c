from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

class ChangeTest:
    def __init__(
        self,
        dynamics: Array,
        curves: Array,
        bends: Array,
        taps: Array,
        judged: Sequence[int],
        actuators: Sequence[int] | NDArray[np.intp],
        additions: Array,
        grown: Array,
        owner: Sequence[int] | NDArray[np.intp],
        sudden: Sequence[bool] | Array,
        faults: Sequence[int],
        driven: bool,
        largest: float,
        rate_hz: float,
        whitening: Array,
        variance: Array,
        hold: int,
        window: int,
        clip: float,
        level_rows: float,
    ) -> None: ...
    def innovations(self, u: Array, y: Array, usable: Flags, restart: Flags) -> tuple[Array, Array, Flags]: ...
    def run(
        self,
        u: Array,
        y: Array,
        usable: Flags,
        restart: Flags,
        times_ns: NDArray[np.int64],
        armed: Flags,
        believed: Array,
        asked: Array | None = None,
        ahead: bool = False,
    ) -> tuple[NDArray[np.intp], Array, Array, Array, Array, NDArray[np.int64], Array, NDArray[np.intp]]: ...
