from collections.abc import Sequence

from adapters.sample import Given, Samples

class StrapdownCore:
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
    ) -> None: ...
    def run(self, samples: Samples) -> Given: ...
