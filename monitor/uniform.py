"""How much of a block of telemetry may be taken as a whole: up to the first message that changes more than samples.

A heartbeat that says what the last one said, a position, an attitude change nothing beyond their channels. Armed and
disarmed, the first message after silence, an operator's command do, and are taken one by one.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adapters.batch import Batch, Columns, one_message
from adapters.mavlink.heartbeat import is_autopilot_heartbeat
from adapters.message import Message
from monitor.sampling.phase import FlightPhase


@dataclass(frozen=True, slots=True)
class Order:
    """The messages of a block in the order of arrival.

    Parameters
    ----------
    block : Batch
        The block.
    received_ns : NDArray[np.int64]
        Times of arrival (count,).
    column, row : NDArray[np.intp]
        Where in ``block.columns`` each stands (count,), column -1 for one of ``block.others``.
    """

    block: Batch
    received_ns: NDArray[np.int64]
    column: NDArray[np.intp]
    row: NDArray[np.intp]

    def message(self, place: int) -> Message:
        """Return the message at a place."""
        column = int(self.column[place])
        if column < 0:
            return self.block.others[place]
        return one_message(self.block.columns[column], int(self.row[place]))


def in_order(block: Batch) -> Order:
    """Return the order of a block's messages."""
    received_ns = np.zeros(block.count, np.int64)
    column, row = np.full(block.count, -1), np.zeros(block.count, np.intp)
    for number, columns in enumerate(block.columns):
        received_ns[columns.position] = columns.received_ns
        column[columns.position] = number
        row[columns.position] = np.arange(len(columns.position))
    for place, message in block.others.items():
        received_ns[place] = message.received_ns
    return Order(block, received_ns, column, row)


def selected(block: Batch, names: Collection[str], system: int, component: int) -> Batch:
    """Return the messages of these names that come from one system and component (0: any), as a block.

    What is no column stays if its name is among them. Places are counted anew.
    """
    kept = [
        one
        for one in block.columns
        if one.name in names and (not one.source.has_ids or (one.system == system and component in (0, one.component)))
    ]
    others = {place: message for place, message in block.others.items() if message.name in names}
    if len(kept) == len(block.columns) and len(others) == len(block.others):
        return block
    stays = np.zeros(block.count, np.bool_)
    for one in kept:
        stays[one.position] = True
    stays[list(others)] = True
    place = np.cumsum(stays) - 1
    columns = tuple(
        Columns(one.source, one.name, one.system, one.component, place[one.position], one.received_ns, one.fields)
        for one in kept
    )
    return Batch(int(stays.sum()), columns, {int(place[at]): message for at, message in others.items()})


def heartbeats(order: Order) -> NDArray[np.bool_]:
    """Return which messages are heartbeats of an autopilot (count,)."""
    found = np.zeros(order.block.count, np.bool_)
    for columns in order.block.columns:
        if columns.name == "HEARTBEAT":
            for row, place in enumerate(columns.position.tolist()):
                found[place] = is_autopilot_heartbeat(one_message(columns, row))
    return found


def changes_phase(order: Order, phase: FlightPhase) -> int:
    """Return the place of the first message that says something new about the phase, or is no column; else count."""
    first = min(order.block.others, default=order.block.count)
    for columns in order.block.columns:
        if columns.name not in phase.interests:
            continue
        told = FlightPhase()
        for row, place in enumerate(columns.position.tolist()):
            if place >= first:
                break
            told.armed, told.landed = phase.armed, phase.landed
            told.feed(one_message(columns, row))
            if (told.armed, told.landed) != (phase.armed, phase.landed):
                first = place
    return first
