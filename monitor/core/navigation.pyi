from collections.abc import Sequence

class Navigation:
    score: float
    biases: tuple[float, ...]
    faults: tuple[float, ...]

    def __init__(self, dt: float, every: int, level: float, angles_s: Sequence[float] = ...) -> None: ...
