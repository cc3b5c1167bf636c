"""Messages as samplers get them, in batches cut anywhere, and samples as rows that are easily compared."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adapters.batch import Batch, Columns, pack
from adapters.message import Message
from adapters.sample import Samples
from adapters.source import MAVLINK
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
    lost: bytes

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
            samples.lost[k].tobytes(),
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
        lost=np.zeros((count, u.shape[1]), np.bool_),
    )


def packed(messages: Sequence[Message], types: dict[str, Any] | None = None) -> Batch:
    """Return messages as a batch; those whose fields are not all numbers, or unlike the first's, stay messages.

    ``types`` gives NumPy types of fields by name; otherwise they are int64 and float64.
    """
    groups: dict[tuple[Any, ...], list[tuple[int, Message]]] = {}
    others: dict[int, Message] = {}
    for place, message in enumerate(messages):
        kinds = tuple((name, _kind(value)) for name, value in message.fields.items())
        if message.source is not MAVLINK or any(kind is None for _, kind in kinds):
            others[place] = message
            continue
        members = groups.setdefault((message.source, message.name, message.system, message.component), [])
        if members and kinds != tuple((name, _kind(value)) for name, value in members[0][1].fields.items()):
            others[place] = message
        else:
            members.append((place, message))
    columns = []
    for (source, name, system, component), members in groups.items():
        fields = {}
        for field in members[0][1].fields:
            values = [message.fields[field] for _, message in members]
            first = values[0][0] if isinstance(values[0], list) else values[0]
            usual = np.int64 if isinstance(first, int) else np.float64
            fields[field] = np.array(values, (types or {}).get(field, usual))
        columns.append(
            Columns(
                source,
                name,
                system,
                component,
                np.array([place for place, _ in members]),
                np.array([message.received_ns for _, message in members]),
                fields,
            )
        )
    return Batch(len(messages), tuple(columns), others)


def _kind(value: Any) -> tuple[str, int] | None:
    if isinstance(value, list):
        inner = {_kind(element) for element in value}
        return (inner.pop()[0], len(value)) if len(inner) == 1 and None not in inner else None  # type: ignore[index]
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    if isinstance(value, int):
        return ("int", 0) if abs(value) < 1 << 63 else None
    return "float", 0
