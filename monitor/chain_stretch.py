"""What an observer made of a stretch of samples, and the events of a vehicle's observers over it, in their order.

An alarm may excuse another channel, of its own observer or of another one. So the rows in which something may happen
are taken in the order in which messages completed their samples, and an event has its say in all rows that come after.
"""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from monitor.alarms.alarm_stretch import AlarmStretch
from monitor.alarms.excuse import Excuses
from monitor.estimate import Estimates
from monitor.event import AlarmEvent


@dataclass(frozen=True, slots=True)
class Evidence:
    """One channel's evidence over a stretch of n samples.

    Parameters
    ----------
    alarm : AlarmStretch
        The channel's alarm.
    size : NDArray[np.float64]
        Signed size (n,), in the alarm's unit.
    speaking : NDArray[np.bool_]
        Rows in which it speaks unless it is excused (n,).
    command : NDArray[np.float64] | None
        What the size takes its share of (n,), None where that makes no sense.
    relative : NDArray[np.float64] | None
        That share, where it is known in another way (n,); not a number in rows where it is not.
    excusable : bool
        Whether other alarms may excuse it.
    """

    alarm: AlarmStretch
    size: NDArray[np.float64]
    speaking: NDArray[np.bool_]
    command: NDArray[np.float64] | None = None
    relative: NDArray[np.float64] | None = None
    excusable: bool = True


@dataclass(frozen=True, slots=True)
class ChainStretch:
    """One observer over a stretch.

    Parameters
    ----------
    estimates : Estimates
        Of its n samples.
    position : NDArray[np.int64]
        Place of the message that completed each sample (n,), ascending.
    evidence : tuple[Evidence, ...]
        Of its alarms, in the order in which they are asked.
    """

    estimates: Estimates
    position: NDArray[np.int64]
    evidence: tuple[Evidence, ...]


Key = tuple[int, int, int, int]
"""Place of the message, observer, row and alarm: the order in which alarms are asked."""


def events_in_order(chains: Sequence[ChainStretch], excuses: Excuses) -> list[AlarmEvent]:
    """Ask all alarms of a vehicle about a stretch; return their events in the order in which they arise."""
    positions = [chain.position.tolist() for chain in chains]
    queue: list[tuple[Key, int]] = []
    versions: dict[tuple[int, int], int] = {}

    def enqueue(k: int, order: int) -> None:
        alarm = chains[k].evidence[order].alarm
        versions[k, order] = version = versions.get((k, order), 0) + 1
        if alarm.row < len(alarm):
            heapq.heappush(queue, ((positions[k][alarm.row], k, alarm.row, order), version))

    for k, chain in enumerate(chains):
        for order in range(len(chain.evidence)):
            enqueue(k, order)
    events = []
    while queue:
        key, version = heapq.heappop(queue)
        k, order = key[1], key[3]
        if version != versions[k, order]:
            continue
        evidence = chains[k].evidence[order]
        alarm = evidence.alarm
        while True:
            if not alarm.due:
                alarm.go_on()
            elif (event := _ask(evidence, chains[k].estimates, alarm.row)) is not None:
                events.append(event)
                excuses.note(event)
                for other in _touched(chains, event, excuses):
                    _excuse(chains[other[0]], other, key, excuses)
                    enqueue(*other)
            if alarm.row == len(alarm):
                break
            # An alarm that stands is asked row after row: through the queue only where another one comes first.
            key = positions[k][alarm.row], k, alarm.row, order
            if queue and queue[0][0] < key:
                enqueue(k, order)
                break
    for chain in chains:
        for evidence in chain.evidence:
            evidence.alarm.pass_to(len(evidence.alarm))
    return events


def _ask(evidence: Evidence, estimates: Estimates, row: int) -> AlarmEvent | None:
    stretch = evidence.alarm
    stretch.pass_to(row)
    command = None if evidence.command is None else float(evidence.command[row])
    relative = None if evidence.relative is None or np.isnan(evidence.relative[row]) else float(evidence.relative[row])
    event = stretch.alarm.update(estimates.samples.one(row), float(evidence.size[row]), command, relative)
    stretch.update_done()
    return event


def _touched(chains: Sequence[ChainStretch], event: AlarmEvent, excuses: Excuses) -> list[tuple[int, int]]:
    """Return the alarms whose evidence an event may excuse, by observer and order."""
    channels = excuses.touched(event.channel)
    return [
        (k, order)
        for k, chain in enumerate(chains)
        for order, evidence in enumerate(chain.evidence)
        if evidence.excusable and evidence.alarm.alarm.rule.channel in channels
    ]


def _excuse(chain: ChainStretch, other: tuple[int, int], key: Key, excuses: Excuses) -> None:
    """Let the excuses of now hold in all rows of an alarm that come after ``key``."""
    place, k, row, order = key
    evidence = chain.evidence[other[1]]
    if other[0] == k:
        first = row if other[1] > order else row + 1
    else:
        first = int(np.searchsorted(chain.position, place, side="left" if other[0] > k else "right"))
    times = chain.estimates.samples.vehicle_time_ns
    excused = excuses.excused_rows(evidence.alarm.alarm.rule.channel, times[first:])
    evidence.alarm.change(evidence.speaking[first:] & ~excused, first)
