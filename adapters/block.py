"""A stretch of telemetry by columns: what a recording holds of each message, as arrays, in the order of arrival.

Recordings are read in blocks so that whatever is the same for thousands of messages is done once. A block says
exactly what the messages say one by one: :func:`messages` gives them back.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adapters.message import Message


@dataclass(frozen=True, slots=True)
class Columns:
    """The m messages of one name and one sender in a block.

    Parameters
    ----------
    source, name : str
        As of :class:`adapters.message.Message`.
    system, component : int
        MAVLink ids of the sender.
    position : NDArray[np.int64]
        Place of each among all messages of the block (m,), ascending.
    received_ns : NDArray[np.int64]
        Unix times of arrival, nanoseconds (m,).
    fields : Mapping[str, NDArray]
        Decoded fields in the type they have on the wire (m,); an array field has shape (m, its length).
    """

    source: str
    name: str
    system: int
    component: int
    position: NDArray[np.int64]
    received_ns: NDArray[np.int64]
    fields: Mapping[str, NDArray[np.generic]]


@dataclass(frozen=True, slots=True)
class Block:
    """A stretch of telemetry.

    Parameters
    ----------
    count : int
        Number of messages.
    columns : tuple[Columns, ...]
        By name and sender; no two have both in common.
    others : Mapping[int, Message]
        Messages that are no columns (texts, other kinds of source), by their place in the block.
    """

    count: int
    columns: tuple[Columns, ...]
    others: Mapping[int, Message]


def messages(block: Block) -> Iterator[Message]:
    """Yield the messages of a block one by one, in the order of arrival."""
    place: list[tuple[Columns, int] | Message | None] = [None] * block.count
    for columns in block.columns:
        for row, position in enumerate(columns.position.tolist()):
            place[position] = columns, row
    for position, message in block.others.items():
        place[position] = message
    for entry in place:
        if isinstance(entry, Message):
            yield entry
        elif entry is not None:
            yield one_message(*entry)


def one_message(columns: Columns, row: int) -> Message:
    """Return one message of its columns."""
    return Message(
        source=columns.source,
        name=columns.name,
        received_ns=int(columns.received_ns[row]),
        fields={name: values[row].tolist() for name, values in columns.fields.items()},
        system=columns.system,
        component=columns.component,
    )


def cut(block: Block, start: int, stop: int) -> Block:
    """Return the messages at places start <= place < stop as a block of their own."""
    columns = []
    for one in block.columns:
        first, last = np.searchsorted(one.position, (start, stop))
        if first == last:
            continue
        part = slice(int(first), int(last))
        columns.append(
            Columns(
                source=one.source,
                name=one.name,
                system=one.system,
                component=one.component,
                position=one.position[part] - start,
                received_ns=one.received_ns[part],
                fields={name: values[part] for name, values in one.fields.items()},
            )
        )
    others = {place - start: message for place, message in block.others.items() if start <= place < stop}
    return Block(stop - start, tuple(columns), others)
