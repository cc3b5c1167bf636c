"""A healthy recording as the monitor processes it, and its windows around times of onset."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adapters.batch import Batch, chosen, cut, joined, messages, one_message, pack
from adapters.errors import OtherVehicleError
from adapters.message import Message
from monitor.core.sampling import VehicleClock, sample_batch
from monitor.estimate import Estimates
from monitor.fitting.flights import Flight, joined_flights, phase_reports
from monitor.pipeline import Pipeline
from monitor.profile import Profile
from monitor.sampling.gate import GatedSampler
from replay.attacks.plant_response import States

Span = tuple[int, int]


class TrialWindow(NamedTuple):
    """The messages of a window: the ones before a time of onset, and the ones from it on."""

    lead: Batch
    tail: Sequence[Message]

    def messages(self) -> list[Message]:
        """Return all messages of the window."""
        return [*messages(self.lead), *self.tail]

    def newest(self) -> list[Message]:
        """Return the newest message of each name and sender before the onset."""
        newest = {int(columns.position[-1]): one_message(columns, -1) for columns in self.lead.columns}
        return [message for _, message in sorted((newest | dict(self.lead.others)).items(), key=lambda entry: entry[0])]

    @property
    def names(self) -> frozenset[str]:
        """Names of all messages of the window."""
        return self.lead.names.union(message.name for message in self.tail)


@dataclass(frozen=True, slots=True, eq=False)
class Healthy:
    """A recording without a fault."""

    batches: Sequence[Batch]  # its messages of one vehicle
    # for each batch the newest time on the vehicle's clock after each message, nanoseconds
    newest_ns: Sequence[NDArray[np.int64]]
    system: int  # the vehicle's MAVLink system
    flights: Mapping[str, Flight]  # samples by observer
    states: Mapping[str, NDArray[np.float64]]  # state estimates at these samples (N, n), by observer
    alarms_ns: Sequence[int]  # times at which alarms were raised, vehicle nanoseconds

    def spans_ns(self, observer: str) -> list[Span]:
        """Return the spans in which an observer's samples are evidence, vehicle nanoseconds."""
        flight = self.flights[observer]
        times_ns = flight.samples.vehicle_time_ns
        stretches = flight.stretches(at_restart=True)
        return [(int(times_ns[rows.start]), int(times_ns[rows.stop - 1])) for rows in stretches]

    def states_of(self, observer: str) -> States:
        """Return an observer's state estimates over time."""
        return States(self.flights[observer].samples.vehicle_time_ns, self.states[observer])

    @property
    def names(self) -> frozenset[str]:
        """Names of the recording's messages."""
        return frozenset().union(*(batch.names for batch in self.batches))

    def window(self, start_ns: int, onset_ns: int, stop_ns: int) -> TrialWindow:
        """Return the messages of a window, preceded by the newest earlier messages about the phase of flight."""
        phase: dict[tuple[str, int], Message] = {}
        lead: list[Batch] = []
        tail: list[Message] = []
        for batch, newest_ns in zip(self.batches, self.newest_ns, strict=True):
            start, onset, stop = np.searchsorted(newest_ns, (start_ns, onset_ns, stop_ns)).tolist()
            if not lead:
                phase |= {
                    (message.name, message.component): message for at, message in phase_reports(batch) if at < start
                }
            lead += [cut(batch, start, onset)] if onset > start else []
            tail += messages(cut(batch, onset, stop))
        return TrialWindow(joined([pack([*phase.values()]), *lead]), tail)


def play_healthy(profile: Profile, recorded: Iterable[Batch]) -> Healthy:
    """Run a healthy recording through a profile's pipeline, which refuses that of another vehicle."""
    pipeline = Pipeline(profile)
    batches: list[Batch] = []
    estimates: dict[str, list[Estimates]] = {observer.name: [] for observer in profile.observers}
    alarms_ns: list[int] = []
    for batch in recorded:
        outputs = pipeline.run(batch)
        if pipeline.refused is not None:
            raise OtherVehicleError(f"{pipeline.refused}; take its own profile")
        batches.append(batch)
        for output in outputs:
            if isinstance(output, Estimates):
                estimates[output.observer].append(output)
            elif output.state == "raised":
                alarms_ns.append(output.vehicle_time_ms * 1_000_000)
    estimated = {name: runs for name, runs in estimates.items() if runs}
    system = pipeline.system
    own = [chosen(batch, lambda entry: entry.system == system) for batch in batches]
    return Healthy(
        batches=own,
        newest_ns=_newest_ns(profile, own),
        system=system,
        flights={
            name: joined_flights([Flight(run.samples, run.armed) for run in runs]) for name, runs in estimated.items()
        },
        states={name: np.concatenate([run.x for run in runs]) for name, runs in estimated.items()},
        alarms_ns=alarms_ns,
    )


def _newest_ns(profile: Profile, batches: Iterable[Batch]) -> list[NDArray[np.int64]]:
    """Return for each batch the newest time on the vehicle's clock after each of its messages."""
    clock = VehicleClock()
    samplers = [
        GatedSampler(observer.source, observer.rate_hz, clock, profile.gate).sampler for observer in profile.observers
    ]
    return [sample_batch(clock, samplers, batch).newest_ns for batch in batches]


def free_spans(
    spans: Sequence[Span],
    alarms_ns: Iterable[int],
    before_ns: int,
    after_ns: int,
    wanted: Sequence[Span] | None = None,
) -> list[Span]:
    """Return the spans of possible onsets: with watched flight and no alarm around them, vehicle nanoseconds.

    ``spans`` are those of watched flight, ``wanted`` those in which onsets have to be (None: anywhere). A window begins
    ``before_ns`` before its onset and ends ``after_ns`` after it.
    """
    free = [(a + before_ns, b - after_ns) for a, b in spans if b - a >= before_ns + after_ns]
    for alarm_ns in alarms_ns:
        low, high = alarm_ns - after_ns, alarm_ns + before_ns
        pieces = [piece for a, b in free for piece in ((a, min(b, low)), (max(a, high), b))]
        free = [(a, b) for a, b in pieces if a <= b]
    if wanted is not None:
        pieces = [(max(a, c), min(b, d)) for a, b in free for c, d in wanted]
        free = [(a, b) for a, b in pieces if a <= b]
    return free


def onsets(recordings: Sequence[Sequence[Span]], count: int) -> list[tuple[int, int]]:
    """Return times of onset, evenly spread over the spans of possible onsets of several recordings.

    Each is the index of its recording, and whole milliseconds in nanoseconds. There are fewer than ``count`` if time is
    short, and none if no window fits.
    """
    free = [(index, a, b) for index, spans in enumerate(recordings) for a, b in spans]
    total = sum(b - a for _, a, b in free)
    places: dict[tuple[int, int], None] = {}
    for number in range(count):
        offset = total * (2 * number + 1) // (2 * count)
        for index, a, b in free:
            if offset <= b - a:
                places[index, (a + offset) // 1_000_000 * 1_000_000] = None
                break
            offset -= b - a
    return list(places)
