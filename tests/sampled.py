"""Messages as samplers get them, in batches cut anywhere, and samples as rows that are easily compared."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adapters.batch import Batch, pack
from adapters.message import Message
from adapters.sample import Samples
from monitor.core.sampling import sample_batch
from monitor.sampling.sampler import Sampler


class Row(NamedTuple):
    """One sample; the fields are those of :class:`adapters.sample.Samples`."""

    index: int
    vehicle_time_ns: int
    time_ns: int
    u: NDArray[np.float64]
    y: NDArray[np.float64]
    restart: bool
    complete: bool
    known_ns: int
    measured: bool

    @property
    def bits(self) -> tuple[Any, ...]:
        """What is equal only where every bit is; numbers that are none are all the same."""
        u, y = (np.where(np.isnan(part), np.nan, part).tobytes() for part in (self.u, self.y))
        return (*self[:3], u, y, *self[5:])


def rows(samples: Samples) -> list[Row]:
    """Return samples row by row."""
    return [
        Row(
            int(samples.index[k]),
            int(samples.vehicle_time_ns[k]),
            int(samples.time_ns[k]),
            samples.u[k],
            samples.y[k],
            bool(samples.restart[k]),
            bool(samples.complete[k]),
            int(samples.known_ns[k]),
            bool(samples.measured[k]),
        )
        for k in range(len(samples))
    ]


def feed(sampler: Sampler, messages: Sequence[Message]) -> list[Row]:
    """Return the samples that messages complete, in one batch."""
    return rows(sample_batch(sampler.clock, [sampler], pack(messages)).samples[0])


def batches(messages: Sequence[Message], cuts: Iterable[int], packing: Any = pack) -> list[Batch]:
    """Return messages as batches, cut before the messages of these places."""
    places = [0, *sorted(at for at in cuts if at < len(messages)), len(messages)]
    return [packing(messages[start:stop]) for start, stop in pairwise(places)]


def raw_samples(u: NDArray[np.float64], first: int = 0) -> Samples:
    """Return samples without outputs at 100 Hz, whole, restarted at the first; its index is ``first``."""
    count = len(u)
    index = first + np.arange(count)
    return Samples(
        index=index,
        vehicle_time_ns=index * 10_000_000,
        time_ns=index * 10_000_000,
        u=u,
        y=np.zeros((count, 0)),
        restart=np.arange(count) == 0,
        complete=np.ones(count, np.bool_),
        known_ns=index * 10_000_000,
        measured=np.ones(count, np.bool_),
    )
