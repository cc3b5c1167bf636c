from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adapters.batch import Batch
from adapters.channels import Channel
from adapters.sample import Samples

MAX_STAMP_NS: int
CAPACITY: int
LINE_PERIODS: int
RAW_LINE_S: float
MAX_GAP_S: float

class VehicleClock:
    flies: bool
    boot: int
    newest_ns: int
    running: bool
    contested_ns: int
    rival_ns: int
    found: dict[tuple[str, str], int]
    pace: float
    repeated_ns: int
    skew: float
    def near(self, stamp_ns: int) -> bool: ...
    def unwrap(self, stamp_ns: int) -> int: ...
    def observe(self, stamp_ns: int, received_ns: int) -> bool: ...
    def to_unix(self, vehicle_ns: int) -> int: ...

class Grid:
    def __init__(self, rate_hz: float) -> None: ...
    def time_ns(self, index: int) -> int: ...
    def index_at(self, time_ns: int) -> int: ...

class SamplerCore:
    def __init__(
        self,
        inputs: Sequence[Channel],
        outputs: Sequence[Channel],
        rate_hz: float,
        clock: VehicleClock,
        max_gap_s: float = ...,
        fitted_hz: Mapping[str, float] = ...,
        restless: bool = ...,
        idles: bool = ...,
    ) -> None: ...
    interests: frozenset[str]
    seldom: tuple[str, ...]
    still: dict[str, int]
    clock: VehicleClock
    waiting: int
    def restart(self) -> None: ...
    def counts(self) -> dict[str, int]: ...

class Settling:
    idle: int
    commanded: bool
    def __init__(self, settle_s: float) -> None: ...
    def run(
        self, samples: Samples, allowed: bool, least_command: float | None, flies: NDArray[np.bool_] | None
    ) -> NDArray[np.bool_]: ...

class Lifting:
    waits: int
    down: bool
    fell: bool
    def __init__(self, airborne: float, hovering: float) -> None: ...
    def forget(self) -> None: ...
    def run(self, samples: Samples, landed: bool) -> NDArray[np.bool_]: ...

class Taken(NamedTuple):
    samples: tuple[Samples, ...]
    position: tuple[NDArray[np.int64], ...]
    newest_ns: NDArray[np.int64]
    used: int

def sample_batch(clock: VehicleClock, samplers: Sequence[SamplerCore], batch: Batch, stops: bool = False) -> Taken: ...
