from collections.abc import Sequence

class Interleaved:
    def __init__(self, periods: Sequence[float]) -> None: ...
