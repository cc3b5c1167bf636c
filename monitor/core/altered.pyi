from collections.abc import Sequence

class Stands:
    def __init__(self, stopped: Sequence[float]) -> None: ...

class Pace:
    def __init__(self) -> None: ...
