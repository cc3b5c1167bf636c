"""(u, y) samples on the fixed-rate grid of the vehicle's clock: the input of observers."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray


# Not frozen: making one that is takes 4 us for 0.7, and a live batch makes several.
@dataclass(slots=True)
class Samples:
    """Inputs and outputs of a plant at n consecutive ticks of the grid, one row per tick."""

    index: NDArray[np.int64]  # tick numbers k (n,); tick k is at k / rate on the vehicle's clock
    # times of the ticks on the vehicle's own clock, nanoseconds since its start (n,)
    vehicle_time_ns: NDArray[np.int64]
    time_ns: NDArray[np.int64]  # Unix times of the ticks, nanoseconds (n,)
    # inputs (n, s) and outputs (n, p) in the channel order of the profile, units of the plant model
    u: NDArray[np.float64]
    y: NDArray[np.float64]
    # True on the first sample after a gap, a clock jump or the start: the observer restarts (n,)
    restart: NDArray[np.bool_]
    complete: NDArray[np.bool_]  # false if measurements of a channel were lost around the tick (n,)
    # Time on the vehicle's clock of the newest measurement that a sample was interpolated from, if that is later than
    # the tick: up to 200 ms with a GPS of 5 Hz (n,). Conclusions from the sample are not known earlier.
    known_ns: NDArray[np.int64]
    # false if the observer has to coast on its model, which is better than the value in ``y`` (n,)
    measured: NDArray[np.bool_]
    # inputs, then outputs, for which the sample holds no measurement, but a straight line over many lost ones or the
    # newest value (n, s + p)
    lost: NDArray[np.bool_]
    # duration of the straight line over one or more lost measurements on which each value lies, 0 if none was lost (n,
    # s + p); None except for raw signals
    lines_ns: NDArray[np.int64] | None = None

    def __len__(self) -> int:
        return len(self.index)

    def part(self, start: int, stop: int) -> Samples:
        """Return the samples from row ``start`` to before row ``stop``, as views."""
        return self.rows(slice(start, stop))

    def rows(self, chosen: slice | NDArray[np.bool_] | NDArray[np.intp]) -> Samples:
        """Return the samples of these rows."""
        columns = (getattr(self, name) for name in _COLUMNS)
        found: Iterator[Any] = (None if column is None else column[chosen] for column in columns)
        return Samples(*found)


_COLUMNS = tuple(field.name for field in fields(Samples))


def joined_samples(parts: Sequence[Samples]) -> Samples:
    """Return consecutive samples as one object."""
    columns = ([getattr(part, name) for part in parts] for name in _COLUMNS)
    joined: Iterator[Any] = (None if column[0] is None else np.concatenate(column) for column in columns)
    return Samples(*joined)


class Given(NamedTuple):
    """Samples computed from others: from raw signals, each from several rows."""

    samples: Samples  # the n samples
    # row of the sample that completed each (n,); all rows if each sample is computed from one
    rows: NDArray[np.intp] | slice = slice(None)
    # standard deviation of the faults that y itself holds an estimate of, by name (n,), in their units
    spread: Mapping[str, NDArray[np.float64]] = MappingProxyType({})
    # their sizes where the transform knows them, before the observer's estimates have risen to them; 0: unknown
    sizes: Mapping[str, NDArray[np.float64]] = MappingProxyType({})
    # where y counts as lost because the received values are unlike the fitted flights (n,), not because they are
    # missing
    unflown: NDArray[np.bool_] | None = None
    # factor by which sizes are larger because the sample is unlike the fitted flights (n,)
    beyond: NDArray[np.float64] | None = None
    # the same factor for faults in ``spread``, whose uncertainty includes what the transform lacked (n,); None: 1
    known_beyond: NDArray[np.float64] | None = None
    # where a transform put the accumulated effect of a fault into y, which no sensor measured (n,)
    corrected: NDArray[np.bool_] | None = None
    # y of the sample after each, if it is known together with it (n, p): its inputs are means up to then
    ahead: NDArray[np.float64] | None = None
    # raw signals that repeat for longer than they ever did in health, by name since when, in vehicle time, ns
    still: Mapping[str, int] = MappingProxyType({})
    # where a sensor repeats one reading for longer than chance allows, by its fault (n,)
    frozen: Mapping[str, NDArray[np.bool_]] = MappingProxyType({})
