import numpy as np
from numpy.typing import NDArray

def first_order(keep: float, gained: NDArray[np.float64], start: float) -> NDArray[np.float64]: ...
