"""Stretches of messages -> samples, as arrays: exactly what :mod:`monitor.sampling.sampler` gives one by one.

A stretch is taken as far as nothing unusual happens: stamps in order and near the vehicle's newest time, values that
are numbers, no gap to skip. Whatever else comes, the sampler's own code has to take, one message; then it goes on.
What is usual in real telemetry is done here: measurements repeated, lost or without a stamp, channels of any rate, and
channels that others wait for in vain. This module knows the samplers' state as well as they do themselves; a test
holds both together, stretch by stretch, to the last bit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adapters.batch import Batch
from adapters.sample import Samples
from monitor.sampling.block_clock import observe_block
from monitor.sampling.block_stream import Hearing, prepared
from monitor.sampling.block_ticks import Ticks, Waits, is_waiting, no_samples
from monitor.sampling.clock import VehicleClock
from monitor.sampling.sampler import Sampler


@dataclass(frozen=True, slots=True)
class Taken:
    """What a stretch of messages gave.

    Parameters
    ----------
    count : int
        How many messages were taken, from the first on.
    samples : tuple[Samples, ...]
        The samples of each sampler.
    position : tuple[NDArray[np.int64], ...]
        For each sampler, the place in the block of the message that completed each sample (n,).
    newest_ns : NDArray[np.int64]
        Newest time on the vehicle's clock after each message taken (count,).
    """

    count: int
    samples: tuple[Samples, ...]
    position: tuple[NDArray[np.int64], ...]
    newest_ns: NDArray[np.int64]


def sample_block(clock: VehicleClock, samplers: Sequence[Sampler], block: Batch) -> Taken:
    """Feed the messages of a block to samplers that share a clock, as many as can be taken as arrays.

    Samplers and clock are left as if each message taken had been fed to every sampler in turn.

    Parameters
    ----------
    clock : VehicleClock
        The clock of all of them.
    samplers : Sequence[Sampler]
        The samplers.
    block : Batch
        The messages, of one vehicle. Where little of a long block was taken, it is cheaper to go on with a short one.
    """
    columns, limit = prepared(clock, samplers, block)
    if not limit:
        nowhere = np.empty(0, np.int64)
        return Taken(0, tuple(map(no_samples, samplers)), (nowhere,) * len(samplers), nowhere)
    hearing = Hearing(clock, samplers, columns, limit)
    factors = [max((len(streams) for streams in sampler.streams.values()), default=1) for sampler in samplers]
    lanes = [
        hearing.lanes(sampler, streams, factor)
        for sampler, streams, factor in zip(samplers, hearing.streams, factors, strict=True)
    ]
    newest_ns, limit = hearing.newest_ns, hearing.limit
    courses: list[Ticks | Waits] = []
    for sampler, own, factor in zip(samplers, lanes, factors, strict=True):
        kind = Waits if is_waiting(sampler, clock.newest_ns) else Ticks
        courses.append(kind(sampler, own, factor, newest_ns, limit))
        limit = courses[-1].limit
    changes = observe_block(clock, *hearing.observations(limit))
    samples, position = [], []
    for course, streams in zip(courses, hearing.streams, strict=True):
        counts = np.array([(0, 0, 0), *(stream.counts(limit) for stream in streams)]).sum(axis=0).tolist()
        given, place = course.commit(limit, counts, changes)
        samples.append(given)
        position.append(place)
    return Taken(limit, tuple(samples), tuple(position), newest_ns[1 : limit + 1])
