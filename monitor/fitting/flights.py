"""Healthy samples of recordings, each with whether it is evidence, as the monitor would process them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from adapters.batch import Batch, Columns, cut, each, gathered, rows_of
from adapters.channels import Channel
from adapters.errors import TelemetryError
from adapters.message import Message
from adapters.sample import Samples, joined_samples
from gains.identification.segment import Segment
from monitor.core.sampling import VehicleClock
from monitor.sampling.gate import GatedSampler, GateRule
from monitor.sampling.phase import FlightPhase
from monitor.sampling.supply import SupplyRule
from monitor.sampling.transform import SampleSource, Transform


@dataclass(frozen=True, slots=True, eq=False)
class Flight:
    """Samples of one recording."""

    samples: Samples  # the n samples
    armed: NDArray[np.bool_]  # whether each is evidence (n,)

    def __len__(self) -> int:
        return len(self.armed)

    @property
    def evidence(self) -> NDArray[np.intp]:
        """Rows of the samples that are evidence, ascending."""
        return np.flatnonzero(self.armed)

    def part(self, start: int, stop: int) -> Flight:
        """Return the samples start <= row < stop as a flight of their own, which begins with a restart."""
        return self.rows(np.arange(start, min(stop, len(self))))

    def rows(self, rows: NDArray[np.intp]) -> Flight:
        """Return some of the samples, ascending; the observer restarts after each sample that is left out."""
        samples = self.samples.rows(rows)
        restart = samples.restart.copy()
        restart[:1] = True
        restart[1:] |= np.diff(rows) != 1
        return Flight(replace(samples, restart=restart), self.armed[rows])

    def segments(self, bridged: int = 1) -> list[Segment]:
        """Return the stretches of evidence; two at most ``bridged`` rows apart count as one with a break in it."""
        return [
            Segment(self.samples.u[rows], self.samples.y[rows], None if bridged == 1 else self.armed[rows])
            for rows in self.stretches(at_restart=True, bridged=bridged)
        ]

    def stretches(self, *, at_restart: bool, bridged: int = 1) -> Iterator[slice]:
        """Yield the rows of each stretch of evidence; a restart ends a stretch if ``at_restart``."""
        rows = self.evidence
        breaks = np.diff(rows) > bridged
        if at_restart:
            restarts = np.cumsum(self.samples.restart)
            breaks |= restarts[rows[1:]] > restarts[rows[:-1]]
        for stretch in np.split(rows, np.flatnonzero(breaks) + 1) if len(rows) else ():
            yield slice(int(stretch[0]), int(stretch[-1]) + 1)


def part_of(batches: Iterable[Batch], start_s: float, end_s: float | None, name: str) -> Iterator[Batch]:
    """Yield the messages of a recording from ``start_s`` to ``end_s`` seconds after its first one arrived.

    Earlier messages that tell the phase of flight, or which vehicle it is, are included.

    Raises
    ------
    TelemetryError
        The recording, called ``name``, ends before.
    """
    first_ns = last_ns = None
    inside = False
    for batch in batches:
        arrivals = [(columns.received_ns[0], columns.received_ns[-1]) for columns in batch.columns]
        arrivals += [(message.received_ns, message.received_ns) for message in batch.others.values()]
        first_ns = min(int(first) for first, _ in arrivals) if first_ns is None and arrivals else first_ns
        if first_ns is None:
            continue
        last_ns = max([int(last) for _, last in arrivals] + ([last_ns] if last_ns is not None else []))
        start_ns = first_ns + round(start_s * 1e9)
        end_ns = first_ns + round(end_s * 1e9) if end_s is not None else last_ns + 1
        others = {
            at: message
            for at, message in batch.others.items()
            if message.received_ns < end_ns
            and (message.received_ns >= start_ns or message.name in FlightPhase.interests)
        }
        parts = [_arrived(columns, start_ns, end_ns) for columns in batch.columns]
        part = gathered([columns for columns in parts if len(columns.position)], others)
        inside = inside or (last_ns >= start_ns and part.count > 0)
        yield part
    if not inside:
        lasts_s = 0.0 if first_ns is None or last_ns is None else (last_ns - first_ns) / 1e9
        raise TelemetryError(f"{name}: lasts {lasts_s:.0f} s and holds nothing from --start {start_s:g} s on")


def _arrived(columns: Columns, start_ns: int, end_ns: int) -> Columns:
    since = 0 if columns.name in FlightPhase.interests else int(np.searchsorted(columns.received_ns, start_ns))
    return rows_of(columns, slice(since, int(np.searchsorted(columns.received_ns, end_ns))))


def flight_samples(
    batches: Iterable[Batch],
    source: SampleSource,
    rate_hz: float,
    gate: GateRule,
    supply: SupplyRule | None = None,
    *,
    commands: bool = True,
) -> Flight:
    """Return the samples of a recording, ``rate_hz`` of them per second; without ``commands`` their mean is none."""
    sampler = GatedSampler(source, rate_hz, VehicleClock(), gate, supply, commands=commands)
    flights: list[Flight] = []
    for part, phase in _by_phase(batches):
        flights.append(Flight(*sampler.sample(part, phase)))
    return joined_flights(flights)


def raw_flights(
    logs: Iterable[Callable[[], Iterable[Batch]]], channels: Sequence[Channel], rate_hz: float, gate: GateRule
) -> list[Flight]:
    """Return raw signals of recordings for a transform.

    As in a transform's observer they count as no commands of flight.
    """
    source = SampleSource(inputs=tuple(channels))
    return [flight_samples(log(), source, rate_hz, gate, commands=False) for log in logs]


def transformed(flight: Flight, transform: Transform) -> Flight:
    """Return the samples that a transform makes of raw ones."""
    given = transform.run(flight.samples)
    return Flight(given.samples, flight.armed[given.rows] & ~given.samples.lost.any(axis=1))


def _by_phase(batches: Iterable[Batch]) -> Iterator[tuple[Batch, FlightPhase]]:
    """Yield a recording in parts, each with the phase of flight that holds from its first message to its last."""
    phase = FlightPhase()
    for batch in batches:
        start, current = 0, copy(phase)
        for index, message in phase_reports(batch):
            phase.feed(message)
            if _matters(phase) != _matters(current):
                if index > start:
                    yield cut(batch, start, index), current
                start, current = index, copy(phase)
        yield cut(batch, start, batch.count), current


def _matters(phase: FlightPhase) -> tuple[object, ...]:
    """Return the gate that decides which samples are evidence, for a flight that is known to be healthy."""
    return phase.armed, phase.landed, phase.airborne, phase.near_home, phase.carried


def phase_reports(batch: Batch) -> list[tuple[int, Message]]:
    """Return the messages of a batch that tell the phase of flight or which vehicle it is, with their indices."""
    reports = [(index, message) for index, message in batch.others.items() if message.name in FlightPhase.interests]
    for columns in batch.columns:
        if columns.name in FlightPhase.interests:
            reports += zip(columns.position.tolist(), each(columns), strict=True)
    return sorted(reports, key=lambda report: report[0])


def joined_flights(flights: Sequence[Flight]) -> Flight:
    """Return the samples of flights one after the other."""
    samples = joined_samples([flight.samples for flight in flights])
    return Flight(samples, np.concatenate([flight.armed for flight in flights]))
