"""Where a batch has to be cut: before each message that does more than bring measurements.

A heartbeat that repeats the last one, a position, an attitude only bring measurements. A vehicle that arms, the first
message after silence, an operator's command change how the messages after them are processed.
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
class Arrivals:
    """The messages of a batch in the order of arrival."""

    received_ns: NDArray[np.int64]  # times of arrival (count,)
    wanted: NDArray[np.bool_]  # which of them carry a channel (count,)
    heartbeats: NDArray[np.intp]  # indices of the heartbeats of an autopilot, ascending
    phases: NDArray[np.intp]  # indices of the messages that say something new about the flight phase, ascending


def arrivals_of(batch: Batch, wanted: Collection[str], phase: FlightPhase) -> Arrivals:
    """Return when the messages of a batch arrived, and which of them need a closer look.

    ``wanted`` names the messages that carry a channel; the phase is that before the batch.
    """
    received_ns = np.zeros(batch.count, np.int64)
    is_wanted = np.zeros(batch.count, np.bool_)
    reports: list[tuple[int, Message]] = []
    for columns in batch.columns:
        received_ns[columns.position] = columns.received_ns
        if columns.name in wanted:
            is_wanted[columns.position] = True
        if columns.name in FlightPhase.interests:
            reports += [(place, one_message(columns, row)) for row, place in enumerate(columns.position.tolist())]
    for place, message in batch.others.items():
        received_ns[place] = message.received_ns
        is_wanted[place] = message.name in wanted
        if message.name in FlightPhase.interests:
            reports.append((place, message))
    heartbeats, phases = [], []
    follower = phase.copy()
    for place, message in sorted(reports, key=lambda report: report[0]):
        if is_autopilot_heartbeat(message):
            heartbeats.append(place)
        before = follower.copy()
        follower.feed(message)
        if follower != before:
            phases.append(place)
    return Arrivals(received_ns, is_wanted, np.array(heartbeats, np.intp), np.array(phases, np.intp))


def message_at(batch: Batch, index: int) -> Message:
    """Return the message at an index of a batch."""
    if (message := batch.others.get(index)) is not None:
        return message
    for columns in batch.columns:
        row = int(np.searchsorted(columns.position, index))
        if row < len(columns.position) and columns.position[row] == index:
            return one_message(columns, row)
    raise IndexError(f"no message at {index} of a batch of {batch.count}")


def selected(batch: Batch, names: Collection[str], system: int, component: int) -> Batch:
    """Return the messages of these names that come from one system and component (0: any) as a batch.

    What is no MAVLink message stays if its name is among them. Indices are counted anew.
    """
    kept = [
        columns
        for columns in batch.columns
        if columns.name in names
        and (not columns.source.has_ids or (columns.system == system and component in (0, columns.component)))
    ]
    others = {
        index: message
        for index, message in batch.others.items()
        if message.name in names
        and (not message.source.has_ids or message.system == system)
        and (not (message.source.has_ids and message.source.is_telemetry) or component in (0, message.component))
    }
    if len(kept) == len(batch.columns) and len(others) == len(batch.others):
        return batch
    stays = np.zeros(batch.count, np.bool_)
    for columns in kept:
        stays[columns.position] = True
    stays[list(others)] = True
    index = np.cumsum(stays) - 1
    return Batch(
        int(np.count_nonzero(stays)),
        tuple(
            Columns(
                columns.source,
                columns.name,
                columns.system,
                columns.component,
                index[columns.position],
                columns.received_ns,
                columns.fields,
            )
            for columns in kept
        ),
        {int(index[at]): message for at, message in others.items()},
    )
