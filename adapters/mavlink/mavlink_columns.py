"""MAVLink packets as columns, both for the many packets of a log and for the few that a link brings at a time."""

import functools
from collections.abc import Container

import numpy as np

from adapters.batch import Batch, Columns, RecordFields, cut, joined, pack
from adapters.mavlink.mavlink_message import MavlinkType, mavlink_types
from adapters.mavlink.packets import Dialect, PacketList, SequenceCounter
from adapters.message import Message
from adapters.source import LINK, MAVLINK

SEQUENCE = "sequence"
"""Name of the finding that packets of one sender have two series of sequence numbers; ``conflicts`` counts them."""
_REPORT_NS = 1_000_000_000
"""Interval of its reports: once a second, like updates of alarms."""


@functools.cache
def kinds() -> tuple[MavlinkType, ...]:
    """Return the messages of the dialect in the order of their ids."""
    return tuple(kind for _, kind in sorted(mavlink_types().items()))


@functools.cache
def dialect() -> Dialect:
    """Return the definitions by which packets of :func:`kinds` are checked."""
    return Dialect(sorted(mavlink_types()), [kind.extra for kind in kinds()], [kind.size for kind in kinds()])


def wanted_kinds(only: Container[str] | None = None, without: Container[str] = ()) -> bytes:
    """Return 1 for each of :func:`kinds` whose name is in ``only`` (None: all) and not in ``without``, otherwise 0."""
    return bytes((only is None or kind.name in only) and kind.name not in without for kind in kinds())


def decoded(packets: PacketList, wanted: bytes) -> Batch:
    """Return the messages of wanted kinds, in the order of arrival, as a batch; those with text are not in columns."""
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


class SequenceFindings:
    """Findings from the sequence numbers of a link or a log: lost packets, and ids that two senders share."""

    def __init__(self) -> None:
        self._counter = SequenceCounter()
        self._reported_ns: dict[tuple[int, int], int] = {}

    def lost(self) -> dict[int, int]:
        """Return the lost packets by system, for systems that lost any."""
        return self._counter.lost()

    def decoded(self, packets: PacketList, wanted: bytes) -> Batch:
        """Return :func:`decoded` with a message of source ``link``, once a second, if an id has two senders."""
        parts, start = [], 0
        conflicts = self._counter.count(packets, wanted)
        batch = decoded(packets, wanted)
        for place, received_ns, system, component, count in conflicts:
            if 0 <= received_ns - self._reported_ns.get((system, component), received_ns - _REPORT_NS) < _REPORT_NS:
                continue
            self._reported_ns[system, component] = received_ns
            finding = Message(LINK, SEQUENCE, received_ns, {"conflicts": count}, system, component)
            parts += [cut(batch, start, place), pack([finding])]
            start = place
        return joined([*parts, cut(batch, start, batch.count)]) if parts else batch
