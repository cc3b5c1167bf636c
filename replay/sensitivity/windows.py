"""Windows of a recording around times of onset, spread over the flight that a monitor watched."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable, Sequence

from adapters.message import Message
from monitor.profile import Profile
from monitor.sampling.phase import FlightPhase
from replay.attacks.injector import VehicleTime, profile_clocks

Span = tuple[int, int]


def onsets(watched: Sequence[Span], alarms_ns: Iterable[int], before_ns: int, after_ns: int, count: int) -> list[int]:
    """Return times of onset, evenly spread over those that have watched flight and no alarm around them.

    Parameters
    ----------
    watched : Sequence[tuple[int, int]]
        Stretches of watched flight, vehicle nanoseconds.
    alarms_ns : Iterable[int]
        Times at which alarms were raised.
    before_ns, after_ns : int
        How much of the window lies before and after its onset.
    count : int
        How many onsets, whole milliseconds each; fewer where time is short, none where no window fits.
    """
    free = [(a + before_ns, b - after_ns) for a, b in watched if b - a >= before_ns + after_ns]
    for alarm_ns in alarms_ns:
        low, high = alarm_ns - after_ns, alarm_ns + before_ns
        pieces = [piece for a, b in free for piece in ((a, min(b, low)), (max(a, high), b))]
        free = [(a, b) for a, b in pieces if a <= b]
    total = sum(b - a for a, b in free)
    found: dict[int, None] = {}
    for number in range(count):
        offset = total * (2 * number + 1) // (2 * count)
        for a, b in free:
            if offset <= b - a:
                found[(a + offset) // 1_000_000 * 1_000_000] = None
                break
            offset -= b - a
    return list(found)


def stamps(profile: Profile, messages: Iterable[Message]) -> list[int]:
    """Return for each message of one vehicle the newest time on its clock by then, nanoseconds."""
    time = VehicleTime(profile_clocks(profile))
    newest_ns, found = 0, []
    for message in messages:
        newest_ns = max(newest_ns, time.stamp(message) or 0)
        found.append(newest_ns)
    return found


def window(messages: Sequence[Message], times_ns: Sequence[int], start_ns: int, stop_ns: int) -> list[Message]:
    """Return the messages of a stretch, led by the newest ones before it that tell the phase of flight."""
    start, stop = bisect_left(times_ns, start_ns), bisect_left(times_ns, stop_ns)
    phase: dict[tuple[str, int], Message] = {}
    for message in messages[:start]:
        if message.name in FlightPhase.interests:
            phase[message.name, message.component] = message
    return [*phase.values(), *messages[start:stop]]
