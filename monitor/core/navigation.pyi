class Navigation:
    score: float
    biases: tuple[float, ...]
    faults: tuple[float, ...]

    def __init__(self, dt: float, every: int, level: float) -> None: ...
