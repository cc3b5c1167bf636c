from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from adapters.sample import Given, Samples
from monitor.core.navigation import Navigation

class StrapdownCore:
    scores: NDArray[np.float64]
    spreads: NDArray[np.float64]
    sizes: NDArray[np.float64]
    frozen_ns: int

    def __init__(
        self,
        gps: bool,
        speeds: int,
        baro: bool,
        mag: bool,
        hectopascal: bool,
        dt: float,
        imu_ticks: int,
        gps_ticks: int,
        baro_ticks: int,
        compass_ticks: int,
        gps_hold: int,
        compass_hold: int,
        count: int,
        inputs: int,
        washouts: Sequence[tuple[float, float]],
        twice: Sequence[bool],
        navigation: Navigation | None = None,
        attitude_share: float = 1.0,
        imu_hold: int = ...,
        angles_s: Sequence[float] = ...,
        learned: bool = ...,
    ) -> None: ...
    def run(self, samples: Samples) -> Given: ...
