"""MAVLink packets as columns, the same for the many of a log and the few that a link brings at a time."""

from __future__ import annotations

import functools
from collections.abc import Container

import numpy as np

from adapters.batch import Batch, Columns, RecordFields
from adapters.mavlink.mavlink_message import MavlinkType, mavlink_types
from adapters.mavlink.packets import Dialect, PacketList
from adapters.message import Message
from adapters.source import MAVLINK


@functools.cache
def kinds() -> tuple[MavlinkType, ...]:
    """Return the messages of the dialect in the order of their ids."""
    return tuple(kind for _, kind in sorted(mavlink_types().items()))


@functools.cache
def dialect() -> Dialect:
    """Return what packets of :func:`kinds` are checked by."""
    return Dialect(sorted(mavlink_types()), [kind.extra for kind in kinds()], [kind.size for kind in kinds()])


def wanted_kinds(only: Container[str] | None = None, without: Container[str] = ()) -> bytes:
    """Return for each of :func:`kinds` 1 where it is among some names (None: all) and not among others, else 0."""
    return bytes((only is None or kind.name in only) and kind.name not in without for kind in kinds())


def decoded(packets: PacketList, wanted: bytes) -> Batch:
    """Return the messages of wanted kinds, in the order of arrival, as a batch; those with text are no columns."""
    groups, position, received_ns, content = packets.groups(wanted)
    columns: list[Columns] = []
    others: dict[int, Message] = {}
    for number, system, component, count, first, offset in groups:
        kind = kinds()[number]
        rows = slice(first, first + count)
        if kind.layout is None:
            for k, (at, time_ns) in enumerate(zip(position[rows].tolist(), received_ns[rows].tolist(), strict=True)):
                payload = content[offset + k * kind.size : offset + (k + 1) * kind.size]
                others[at] = kind.decode(payload, time_ns, system, component)
            continue
        fields = RecordFields(np.frombuffer(content, kind.layout, count, offset), kind.places)
        columns.append(Columns(MAVLINK, kind.name, system, component, position[rows], received_ns[rows], fields))
    return Batch(len(position), tuple(columns), others)
