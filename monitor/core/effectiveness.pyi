from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from monitor.estimation.effectiveness import EffectivenessRule

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

class EffectivenessEstimator:
    misfit: float
    def __init__(self, rule: EffectivenessRule, rate_hz: float) -> None: ...
    def run(
        self,
        times_ns: NDArray[np.int64],
        restart: Flags,
        armed: Flags,
        fault: Array,
        command: Array,
        full: Array,
        beyond: Array,
    ) -> Array: ...
