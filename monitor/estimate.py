"""An observer's results over consecutive samples, and the names of their entries."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from adapters.sample import Samples, joined_samples


@dataclass(frozen=True, slots=True)
class Layout:
    """Names and units of one observer's vectors, in order."""

    observer: str  # the observer's name in the profile (``"motors"``)
    rate_hz: float  # samples per second of the vehicle's clock
    # channel names of u, y, x and of the faults (actuator faults f_a first, then sensor faults f_s)
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    states: tuple[str, ...]
    faults: tuple[str, ...]
    fault_units: tuple[str, ...]  # unit of each fault estimate
    # of each fault of an actuator the command that it usually gets, None where that is not known; empty where none is
    usual_commands: tuple[float | None, ...] = ()
    smoothing_s: float = 0.0  # time constant of estimates, and of the commands that they are shares of


@dataclass(slots=True)  # not frozen, as Samples
class Estimates:
    """Estimates at n consecutive samples of one observer as arrays, a row for each sample."""

    observer: str  # the observer's name
    samples: Samples  # the samples they were computed from
    x: NDArray[np.float64]  # state estimates x^ (n, states)
    fault: NDArray[np.float64]  # joint fault estimates [f_a^; f_s^] (n, a1 + a2) in the channels' units
    # size attributed to each fault channel by isolation (n, a1 + a2), zero for the others
    isolated: NDArray[np.float64]
    residual: NDArray[np.float64]  # output errors yt = y - Cb zeta^ (n, p)
    # whether alarms could be raised from the sample (n,): in flight, observer settled, sample complete
    armed: NDArray[np.bool_]
    # one standard deviation (n, a1 + a2), in the same units, of ``isolated`` where that is not zero, as of an alarm's
    # size, elsewhere of ``fault`` by the noise of healthy flight; not a number where it is not known
    sd: NDArray[np.float64]
    # time since the last sample with measurements, seconds (n,); 0 for one that has them
    coasted_s: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.samples)

    def part(self, start: int, stop: int) -> Estimates:
        """Return the estimates start <= row < stop, as views."""
        rows = slice(start, stop)
        values = (getattr(self, name)[rows] for name in _VALUES)
        return Estimates(self.observer, self.samples.part(start, stop), *values)


_VALUES = tuple(field.name for field in fields(Estimates) if field.name not in ("observer", "samples"))


def joined_estimates(parts: Sequence[Estimates]) -> Estimates:
    """Return the estimates of one observer over consecutive samples as one object."""
    if len(parts) == 1:
        return parts[0]
    return Estimates(
        parts[0].observer,
        joined_samples([part.samples for part in parts]),
        *(np.concatenate([getattr(part, name) for part in parts]) for name in _VALUES),
    )
