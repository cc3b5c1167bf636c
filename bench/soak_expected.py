"""What a pipeline makes of a flight that is sent again and again: samples by packet, and which packet causes which."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from math import inf
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "tools"))

from fleet_sender import SentFlight, fleet_packets

from adapters.mavlink.mavlink_columns import decoded, dialect, wanted_kinds
from adapters.mavlink.packets import PacketList, PacketScanner
from monitor.estimate import Estimates
from monitor.pipeline import Pipeline
from monitor.profile import Profile

_START_NS = 1_800_000_000_000_000_000
_TURNS = 3


@dataclass(frozen=True, slots=True)
class Expected:
    """What to expect of one vehicle.

    Parameters
    ----------
    packets : int
        Packets of one turn of the flight.
    first, later : Sequence[int]
        Samples of all observers after each packet of the first turn, and of any later one, which begins with the
        clock set back; as far as the run comes.
    causes : dict[tuple[str, int], int]
        Which packet of a turn completes the sample of an observer that is known at a time of the vehicle's clock,
        milliseconds.
    """

    packets: int
    first: Sequence[int]
    later: Sequence[int]
    causes: dict[tuple[str, int], int]

    def samples(self, sent: int) -> int:
        """Return the samples that so many packets make, none of them lost."""
        turns, rest = divmod(sent, self.packets)
        if turns == 0:
            return self.first[rest - 1] if rest else 0
        return self.first[-1] + (turns - 1) * self.later[-1] + (self.later[rest - 1] if rest else 0)


def expected(profile: Profile, flight: SentFlight, seconds: float = inf) -> Expected:
    """Run a flight through a pipeline of its own, offline, so many seconds or three turns, which stand for all others.

    Raises
    ------
    ValueError
        The third turn differs from the second.
    """
    pipeline = Pipeline(profile, system=flight.system)
    scanner = PacketScanner(dialect())
    size = len(flight.packets)
    turn_s = (flight.packets[-1][0] + 1e7) / 1e9
    turns: list[list[int]] = []
    causes: dict[tuple[str, int], int] = {}
    samples = 0
    for place, (due_ns, (_, packet)) in enumerate(fleet_packets([flight], min(_TURNS * turn_s, seconds))):
        turn, index = divmod(place, size)
        if index == 0:
            turns.append([])
            samples = 0
        scanner.scan(packet, packets := PacketList(dialect()), _START_NS + due_ns)
        for output in pipeline.run(decoded(packets, wanted_kinds())):
            if isinstance(output, Estimates):
                samples += len(output)
                known_ns = output.samples.known_ns
                causes.update(((output.observer, at // 1_000_000), index) for at in known_ns.tolist())
        turns[turn].append(samples)
    turns += [[]] * (_TURNS - len(turns))
    if turns[1][: len(turns[2])] != turns[2]:
        raise ValueError("the second turn of the flight differs from the third: it cannot be told what to expect")
    return Expected(size, turns[0], turns[1], causes)
