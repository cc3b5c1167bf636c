"""(u, y) samples on the fixed-rate grid of the vehicle's clock: the input of observers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Sample:
    """Inputs and outputs of a plant at one tick of the grid.

    Parameters
    ----------
    index : int
        Tick number k; the tick is at k / rate on the vehicle's clock.
    vehicle_time_ns : int
        Time of the tick on the vehicle's own clock, nanoseconds since its start.
    time_ns : int
        Unix time of the tick, nanoseconds.
    u, y : NDArray[np.float64]
        Inputs (s,) and outputs (p,) in the channel order of the profile, units of the plant model.
    restart : bool
        True on the first sample after a gap, a clock jump or the start: the observer starts afresh.
    complete : bool
        False where a channel was bridged across lost measurements: an estimate, no evidence.
    known_ns : int
        Time on the vehicle's clock of the newest measurement it was interpolated from, where that is later than
        the tick: with a GPS of 5 Hz up to 200 ms. What is concluded from the sample is not known earlier.
    measured : bool
        False where an output was bridged across three or more lost measurements: the observer coasts on its model,
        which is better than the straight line that ``y`` holds there.
    """

    index: int
    vehicle_time_ns: int
    time_ns: int
    u: NDArray[np.float64]
    y: NDArray[np.float64]
    restart: bool
    complete: bool
    known_ns: int = 0
    measured: bool = True

    @property
    def later_ns(self) -> int:
        """By how much the sample was known later than its tick, nanoseconds."""
        return max(0, self.known_ns - self.vehicle_time_ns)


@dataclass(frozen=True, slots=True)
class Samples:
    """n consecutive samples as arrays, the fields those of :class:`Sample`.

    Parameters
    ----------
    index, vehicle_time_ns, time_ns, known_ns : NDArray[np.int64]
        (n,).
    u, y : NDArray[np.float64]
        One row per sample (n, s), (n, p).
    restart, complete, measured : NDArray[np.bool_]
        (n,).
    """

    index: NDArray[np.int64]
    vehicle_time_ns: NDArray[np.int64]
    time_ns: NDArray[np.int64]
    u: NDArray[np.float64]
    y: NDArray[np.float64]
    restart: NDArray[np.bool_]
    complete: NDArray[np.bool_]
    known_ns: NDArray[np.int64]
    measured: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.index)

    def one(self, row: int) -> Sample:
        """Return one of the samples; its u and y are views."""
        return Sample(
            index=int(self.index[row]),
            vehicle_time_ns=int(self.vehicle_time_ns[row]),
            time_ns=int(self.time_ns[row]),
            u=self.u[row],
            y=self.y[row],
            restart=bool(self.restart[row]),
            complete=bool(self.complete[row]),
            known_ns=int(self.known_ns[row]),
            measured=bool(self.measured[row]),
        )

    def part(self, start: int, stop: int) -> Samples:
        """Return the samples start <= row < stop, as views."""
        rows = slice(start, stop)
        return Samples(
            self.index[rows],
            self.vehicle_time_ns[rows],
            self.time_ns[rows],
            self.u[rows],
            self.y[rows],
            self.restart[rows],
            self.complete[rows],
            self.known_ns[rows],
            self.measured[rows],
        )


class Given(NamedTuple):
    """Samples made of others: of raw signals, of several in a row.

    Parameters
    ----------
    samples : Samples
        The n samples.
    rows : NDArray[np.intp]
        Row of the sample that completed each (n,).
    """

    samples: Samples
    rows: NDArray[np.intp]


def stacked(samples: Sequence[Sample], inputs: int, outputs: int) -> Samples:
    """Return samples one by one as arrays; ``inputs`` and ``outputs`` give the width of u and y where there is none."""
    times = np.array([(s.index, s.vehicle_time_ns, s.time_ns, s.known_ns) for s in samples], np.int64).reshape(-1, 4)
    flags = np.array([(s.restart, s.complete, s.measured) for s in samples], np.bool_).reshape(-1, 3)
    return Samples(
        index=times[:, 0],
        vehicle_time_ns=times[:, 1],
        time_ns=times[:, 2],
        u=np.array([s.u for s in samples], np.float64).reshape(len(samples), inputs),
        y=np.array([s.y for s in samples], np.float64).reshape(len(samples), outputs),
        restart=flags[:, 0],
        complete=flags[:, 1],
        known_ns=times[:, 3],
        measured=flags[:, 2],
    )
