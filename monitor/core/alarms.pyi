from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from monitor.alarms.alarm import AlarmRule

NONE: int
RAISED: int
UPDATED: int
CLEARED: int
EXPLAINED: int

class Trend:
    def update(self, evidence: float, elapsed_ns: int) -> None: ...
    def size_in(self, seconds: float) -> float: ...

def standing_rungs(below: NDArray[np.int64], rungs: int, samples: int) -> NDArray[np.int64]: ...

class AlarmState:
    active: bool
    critical: bool
    creeping: bool
    recurring: bool
    sudden: bool
    frozen: bool
    shown: float
    peak: float
    size: float
    reported: float
    rival: int
    def set_rule(self, rule: AlarmRule) -> None: ...
    def set_excuse(self, now: bool, spans: NDArray[np.int64]) -> None: ...
    def allow(self, size: float) -> None: ...
    def resume(
        self,
        estimate: float,
        peak: float,
        size: float,
        sd: float,
        reported_ns: int,
        critical: bool,
        creeping: bool,
        recurring: bool,
    ) -> None: ...
    def deactivate(self) -> None: ...
    def forget_recurrences(self) -> None: ...

class ChainRows:
    def __init__(
        self,
        alarms: Sequence[AlarmState],
        position: NDArray[np.int64],
        times_ns: NDArray[np.int64],
        restart: NDArray[np.bool_],
        evidence: NDArray[np.float64],
        speaking: NDArray[np.bool_],
        scale: NDArray[np.float64] | None = None,
        changed: NDArray[np.intp] | None = None,
        nats: NDArray[np.float64] | None = None,
        size: NDArray[np.float64] | None = None,
        growth: NDArray[np.float64] | None = None,
        onset_ns: NDArray[np.int64] | None = None,
        change_sd: NDArray[np.float64] | None = None,
        sd: NDArray[np.float64] | None = None,
        noise: NDArray[np.float64] | None = None,
        command: NDArray[np.float64] | None = None,
        rival: NDArray[np.intp] | None = None,
        instead: NDArray[np.intp] | None = None,
        frozen: NDArray[np.bool_] | None = None,
    ) -> None: ...

def nats_asked(
    alarms: Sequence[AlarmState],
    evidence: NDArray[np.float64],
    speaking: NDArray[np.bool_],
    scale: NDArray[np.float64],
    beyond: NDArray[np.float64] | None,
    lasting: Sequence[bool],
) -> NDArray[np.float64]: ...

class Weighing:
    def __init__(
        self,
        fault_of: Sequence[int],
        alarms: int,
        shown: NDArray[np.bool_],
        healthy: NDArray[np.float64],
        excited: Sequence[int],
    ) -> None: ...
    def run(
        self,
        isolated: NDArray[np.float64],
        unexplained: NDArray[np.float64],
        armed: NDArray[np.bool_],
        counted: NDArray[np.bool_],
        lost: NDArray[np.bool_],
        level: NDArray[np.float64],
        beyond: NDArray[np.float64] | None,
        excitation: NDArray[np.float64] | None,
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_], NDArray[np.float64], NDArray[np.float64]]: ...

def walk(chains: Sequence[ChainRows], on_event: Callable[[int, int, int, int], None]) -> None: ...
