"""What links do to telemetry, on whole recordings as columns: losses at random and in bursts, jitter, pauses.

Each distortion takes names and times of arrival of all messages and says which are lost and by how much the others are
late.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from adapters.batch import Batch

Names = NDArray[np.str_]
Times = NDArray[np.int64]
Kept = NDArray[np.bool_]
Distortion = Callable[[Names, Times, np.random.Generator], tuple[Kept, Times]]


def loss(share: float, names: Names, received_ns: Times, rng: np.random.Generator) -> tuple[Kept, Times]:
    """Lose messages at random."""
    return rng.random(len(received_ns)) >= share, np.zeros_like(received_ns)


def bursts(
    length_s: float, share: float, names: Names, received_ns: Times, rng: np.random.Generator
) -> tuple[Kept, Times]:
    """Lose everything for ``length_s``, again and again after random times, so that a share of all is lost."""
    length_ns, apart_ns = 1e9 * length_s, 1e9 * length_s * (1.0 / share - 1.0)
    span_ns = float(received_ns[-1] - received_ns[0])
    count = int(3.0 * span_ns / (length_ns + apart_ns)) + 10
    starts = received_ns[0] + np.cumsum(length_ns + rng.exponential(apart_ns, count)) - length_ns
    since = received_ns - starts[np.maximum(np.searchsorted(starts, received_ns, "right") - 1, 0)]
    return (since < 0.0) | (since >= length_ns), np.zeros_like(received_ns)


def jitter(
    most_s: float, in_order: bool, names: Names, received_ns: Times, rng: np.random.Generator
) -> tuple[Kept, Times]:
    """Let each message be late by up to ``most_s``; ``in_order``: none overtakes another."""
    late = np.rint(rng.uniform(0.0, 1e9 * most_s, len(received_ns))).astype(np.int64)
    if in_order:
        late = np.maximum.accumulate(received_ns + late) - received_ns
    return np.ones(len(received_ns), np.bool_), late


def held_back(length_s: float, names: Names, received_ns: Times, rng: np.random.Generator) -> tuple[Kept, Times]:
    """Let what comes within half of all stretches of ``length_s`` arrive at their ends."""
    stretch = np.floor((received_ns - received_ns[0]) / (1e9 * length_s)).astype(np.int64)
    held = rng.random(stretch[-1] + 1) < 0.5
    ends = received_ns[0] + np.rint((stretch + 1) * 1e9 * length_s).astype(np.int64)
    return np.ones(len(received_ns), np.bool_), np.where(held[stretch], ends - received_ns, 0)


def pauses(
    name: str, length_s: float, share: float, names: Names, received_ns: Times, rng: np.random.Generator
) -> tuple[Kept, Times]:
    """Lose the messages of one name only, in bursts."""
    kept, late_ns = bursts(length_s, share, names, received_ns, rng)
    return kept | (names != name), late_ns


def both(
    first: Distortion, second: Distortion, names: Names, received_ns: Times, rng: np.random.Generator
) -> tuple[Kept, Times]:
    """Do one and the other."""
    (kept, late), (also, later) = first(names, received_ns, rng), second(names, received_ns, rng)
    return kept & also, late + later


DISTORTIONS: Mapping[str, Distortion] = {
    "none": partial(loss, 0.0),
    "10 % lost": partial(loss, 0.1),
    "30 % lost": partial(loss, 0.3),
    "50 % lost": partial(loss, 0.5),
    "bursts 50 ms, 20 %": partial(bursts, 0.05, 0.2),
    "bursts 100 ms, 20 %": partial(bursts, 0.1, 0.2),
    "bursts 100 ms, 2.5 a second": partial(bursts, 0.1, 0.25),
    "bursts 300 ms, 20 %": partial(bursts, 0.3, 0.2),
    "bursts 1 s, 20 %": partial(bursts, 1.0, 0.2),
    "jitter 50 ms": partial(jitter, 0.05, False),
    "jitter 200 ms": partial(jitter, 0.2, False),
    "jitter 200 ms, in order": partial(jitter, 0.2, True),
    "held back 0.5 s": partial(held_back, 0.5),
    "GPS pauses 2 s, 20 %": partial(pauses, "GPS_RAW_INT", 2.0, 0.2),
    "IMU pauses 0.3 s, 20 %": partial(pauses, "HIGHRES_IMU", 0.3, 0.2),
    "jitter 100 ms, 10 % lost": partial(both, partial(jitter, 0.1, False), partial(loss, 0.1)),
}


def distorted(batch: Batch, distort: Distortion, seed: int) -> Batch:
    """Return what arrives of a recording, in the order of arrival."""
    names, received = np.zeros(batch.count, "<U64"), np.zeros(batch.count, np.int64)
    for columns in batch.columns:
        names[columns.position], received[columns.position] = columns.name, columns.received_ns
    for position, message in batch.others.items():
        names[position], received[position] = message.name, message.received_ns
    kept, late_ns = distort(names, received, np.random.default_rng(seed))
    received += late_ns
    order = np.flatnonzero(kept)
    order = order[np.argsort(received[order], kind="stable")]
    rank = np.full(batch.count, -1, np.int64)
    rank[order] = np.arange(len(order))
    arrived = []
    for columns in batch.columns:
        at = rank[columns.position]
        rows = np.flatnonzero(at >= 0)
        rows = rows[np.argsort(at[rows])]
        if len(rows):
            arrived.append(
                columns._replace(
                    position=at[rows],
                    received_ns=received[columns.position[rows]],
                    fields={name: values[rows] for name, values in columns.fields.items()},
                )
            )
    others = {
        int(rank[position]): replace(message, received_ns=int(received[position]))
        for position, message in batch.others.items()
        if rank[position] >= 0
    }
    return Batch(len(order), tuple(arrived), others)
