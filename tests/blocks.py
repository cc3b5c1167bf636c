"""Messages packed into blocks, and all that a sampler and its clock know, for comparing ways to get there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from adapters.batch import Batch, Columns
from adapters.message import Message
from adapters.sample import Sample, Samples
from monitor.sampling.clock import VehicleClock
from monitor.sampling.sampler import Sampler


def pack(messages: Sequence[Message], types: dict[str, Any] | None = None) -> Batch:
    """Return messages as a block; those whose fields are not all numbers, or unlike the first's, stay messages.

    ``types`` gives NumPy types of fields by name; otherwise they are int64 and float64.
    """
    groups: dict[tuple[Any, ...], list[tuple[int, Message]]] = {}
    others: dict[int, Message] = {}
    for place, one in enumerate(messages):
        kinds = tuple((name, _kind(value)) for name, value in one.fields.items())
        if one.source != "mavlink" or any(kind is None for _, kind in kinds):
            others[place] = one
            continue
        members = groups.setdefault((one.source, one.name, one.system, one.component), [])
        if members and kinds != tuple((name, _kind(value)) for name, value in members[0][1].fields.items()):
            others[place] = one
        else:
            members.append((place, one))
    columns = []
    for (source, name, system, component), members in groups.items():
        fields = {}
        for field in members[0][1].fields:
            values = [one.fields[field] for _, one in members]
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
                np.array([one.received_ns for _, one in members]),
                fields,
            )
        )
    return Batch(len(messages), tuple(columns), others)


def _kind(value: Any) -> tuple[str, int] | None:
    if isinstance(value, list):
        inner = {_kind(one) for one in value}
        return (inner.pop()[0], len(value)) if len(inner) == 1 and None not in inner else None  # type: ignore[index]
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    if isinstance(value, int):
        return ("int", 0) if abs(value) < 1 << 63 else None
    return "float", 0


def clock_state(clock: VehicleClock) -> tuple[Any, ...]:
    """Return all that a clock knows."""
    return (
        clock.boot,
        clock.newest_ns,
        clock.running,
        clock._candidate_ns,
        tuple(clock._points),
        clock.line,
        clock._doubtful,
    )


def sampler_state(sampler: Sampler) -> tuple[Any, ...]:
    """Return all that a sampler knows, values as their bits."""
    held = sampler._held and (list(sampler.streams).index(sampler._held[0].channel.message), *sampler._held[1:])
    waiting = None if sampler.waiting is None else [lane is sampler.waiting for lane in sampler.lanes].index(True)
    lanes = [
        (
            tuple(lane.stamps),
            tuple(np.array(row).tobytes() for row in lane.rows),
            {type(value) for row in lane.rows for value in row} <= {float},
            tuple(lane.places),
            tuple(lane.steps),
            lane.learned,
            (lane.loss_ns, lane.line_ns, lane.gap_ns, lane.silence_ns),
        )
        for lane in sampler.lanes
    ]
    return (
        sampler._boot,
        held,
        waiting,
        lanes,
        sampler.next_tick,
        sampler._tick_ns,
        sampler.due_ns,
        sampler.restarting,
        sampler.last_unix,
        asdict(sampler.statistics()),
    )


def sample_bits(sample: Sample) -> tuple[Any, ...]:
    """Return a sample as something that is equal only where every bit is."""
    return (
        sample.index,
        sample.vehicle_time_ns,
        sample.time_ns,
        sample.u.tobytes(),
        sample.y.tobytes(),
        sample.restart,
        sample.complete,
        sample.known_ns,
        sample.measured,
    )


def samples_bits(samples: Samples) -> list[tuple[Any, ...]]:
    """Return samples one by one, as :func:`sample_bits` does."""
    return [sample_bits(samples.one(row)) for row in range(len(samples))]
