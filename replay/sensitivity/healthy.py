"""A healthy recording as the monitor sees it, and windows of it around times of onset."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adapters.errors import OtherVehicleError
from adapters.logs.recordings import packed
from adapters.message import Message
from monitor.estimate import Estimates
from monitor.fitting.flights import Flight, joined_flights
from monitor.pipeline import Pipeline
from monitor.profile import Profile
from monitor.sampling.phase import FlightPhase
from replay.attacks.injector import VehicleTime, profile_clocks
from replay.attacks.plant_response import States

Span = tuple[int, int]


@dataclass(frozen=True, slots=True, eq=False)
class Healthy:
    """A recording without a fault.

    Parameters
    ----------
    messages : Sequence[Message]
        Its messages of one vehicle.
    times_ns : Sequence[int]
        For each of them the newest time on the vehicle's clock by then, nanoseconds.
    system : int
        The vehicle's MAVLink system.
    flights : Mapping[str, Flight]
        By observer: its samples.
    states : Mapping[str, NDArray[np.float64]]
        By observer: its state estimates at them (N, n).
    alarms_ns : Sequence[int]
        Times at which alarms were raised, vehicle nanoseconds.
    """

    messages: Sequence[Message]
    times_ns: Sequence[int]
    system: int
    flights: Mapping[str, Flight]
    states: Mapping[str, NDArray[np.float64]]
    alarms_ns: Sequence[int]

    def spans_ns(self, observer: str) -> list[Span]:
        """Return the stretches in which an observer's samples are evidence, vehicle nanoseconds."""
        flight = self.flights[observer]
        times_ns = flight.samples.vehicle_time_ns
        stretches = flight.stretches(at_restart=True)
        return [(int(times_ns[rows.start]), int(times_ns[rows.stop - 1])) for rows in stretches]

    def states_of(self, observer: str) -> States:
        """Return an observer's state estimates over time."""
        return States(self.flights[observer].samples.vehicle_time_ns, self.states[observer])

    def window(self, start_ns: int, stop_ns: int) -> list[Message]:
        """Return the messages of a stretch, led by the newest ones before it that tell the phase of flight."""
        start, stop = bisect_left(self.times_ns, start_ns), bisect_left(self.times_ns, stop_ns)
        phase: dict[tuple[str, int], Message] = {}
        for message in self.messages[:start]:
            if message.name in FlightPhase.interests:
                phase[message.name, message.component] = message
        return [*phase.values(), *self.messages[start:stop]]


def play_healthy(profile: Profile, recorded: Iterable[Message]) -> Healthy:
    """Run a healthy recording through a profile's pipeline; it follows the vehicle that the pipeline chooses.

    Raises
    ------
    OtherVehicleError
        The recording says it is of another vehicle than the profile.
    """
    pipeline = Pipeline(profile)
    recorded = list(recorded)
    wanted = pipeline.interests - FlightPhase.interests
    system = profile.system or next((message.system for message in recorded if message.name in wanted), 0)
    messages = [message for message in recorded if message.system == system]
    estimates: dict[str, list[Estimates]] = {observer.name: [] for observer in profile.observers}
    alarms_ns: list[int] = []
    for batch in packed(messages):
        outputs = pipeline.run(batch)
        if pipeline.refused is not None:
            raise OtherVehicleError(f"{pipeline.refused}; take its own profile")
        for output in outputs:
            if isinstance(output, Estimates):
                estimates[output.observer].append(output)
            elif output.state == "raised":
                alarms_ns.append(output.vehicle_time_ms * 1_000_000)
    found = {name: runs for name, runs in estimates.items() if runs}
    return Healthy(
        messages=messages,
        times_ns=_newest_ns(profile, messages),
        system=system,
        flights={
            name: joined_flights([Flight(run.samples, run.armed) for run in runs]) for name, runs in found.items()
        },
        states={name: np.concatenate([run.x for run in runs]) for name, runs in found.items()},
        alarms_ns=alarms_ns,
    )


def free_spans(
    spans: Sequence[Span],
    alarms_ns: Iterable[int],
    before_ns: int,
    after_ns: int,
    wanted: Sequence[Span] | None = None,
) -> list[Span]:
    """Return where onsets may lie: with watched flight and no alarm around them, vehicle nanoseconds.

    Parameters
    ----------
    spans : Sequence[tuple[int, int]]
        Stretches of watched flight.
    alarms_ns : Iterable[int]
        Times at which alarms were raised.
    before_ns, after_ns : int
        How much of the window lies before and after its onset.
    wanted : Sequence[tuple[int, int]] | None
        Stretches that onsets have to lie in; None: anywhere.
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
    """Return times of onset, evenly spread over where they may lie in each of several recordings.

    Returns
    -------
    list[tuple[int, int]]
        Index of the recording and time of each onset, whole milliseconds in nanoseconds; fewer than ``count`` where
        time is short, none where no window fits.
    """
    free = [(index, a, b) for index, spans in enumerate(recordings) for a, b in spans]
    total = sum(b - a for _, a, b in free)
    found: dict[tuple[int, int], None] = {}
    for number in range(count):
        offset = total * (2 * number + 1) // (2 * count)
        for index, a, b in free:
            if offset <= b - a:
                found[index, (a + offset) // 1_000_000 * 1_000_000] = None
                break
            offset -= b - a
    return list(found)


def _newest_ns(profile: Profile, messages: Iterable[Message]) -> list[int]:
    time = VehicleTime(profile_clocks(profile))
    newest_ns, found = 0, []
    for message in messages:
        newest_ns = max(newest_ns, time.stamp(message) or 0)
        found.append(newest_ns)
    return found
