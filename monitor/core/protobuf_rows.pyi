from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

class RowEncoder:
    names: tuple[str, ...]
    def __init__(self, pb_class: Any) -> None: ...
    def encode(self, columns: Sequence[NDArray[np.generic] | int], count: int) -> list[bytes]: ...
