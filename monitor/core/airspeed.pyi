import numpy as np
from numpy.typing import NDArray

from adapters.sample import Samples

LAPSE: float
EXPONENT: float

class AirspeedCore:
    def __init__(self, dt: float, scale: float, noise: float, level: float, minimum: float) -> None: ...
    def run(
        self, samples: Samples
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_], NDArray[np.float64]]: ...
