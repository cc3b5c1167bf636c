class Navigation:
    score: float
    biases: tuple[float, ...]
    faults: tuple[float, ...]

    def __init__(
        self,
        dt: float,
        every: int,
        level: float,
        field_delay_s: float = 0.0,
        field_noise: float = 0.0,
        field_walk: float = 0.0,
    ) -> None: ...
