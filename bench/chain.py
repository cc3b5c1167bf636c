"""Faults between command and thrust told apart by name: controllers, propellers, motors.

    python bench/chain.py             print the page
    python bench/chain.py --write     write docs/chain.md

A simulated quadrotor (tests/simulated_chain.py) with exact faults; profiles are fitted on two healthy flights.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path

from adapters.logs.recordings import packed
from monitor.profile import Profile, read_profile
from replay.fit import fit_profile
from replay.player import play

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT / "tests"))

from simulated_chain import Fault, flight  # noqa: E402

RATES_HZ = (50.0, 3.0)
SHARES = {"esc": (0.1, 0.2), "prop": (0.1, 0.2), "motor": (0.1, 0.2, 0.4)}
BATTERY_SHARES = (0.5, 1.0, 2.0)
"""More resistance."""
HEALTHY_S, ONSET_S, LENGTH_S, BOOT_S = 90.0, 20.0, 40.0, 5.0
CASES = ((2, 11), (3, 12))
"""Motor and seed of each flight with a fault."""


@dataclass(frozen=True, slots=True)
class Tried:
    """What a fault came to."""

    part: str
    share: float
    named: tuple[str, ...]  # parts of the right motor, by an alarm or in the one of the motors observer's motorN
    wrong: tuple[str, ...]  # all other channels
    alarms: int  # how many were raised
    delay_s: float | None  # until the right name


def fitted(rate_hz: float, folder: Path) -> Profile:
    """Return a profile fitted on two healthy flights, in one of which the battery sags."""
    flights = [list(flight(seed, HEALTHY_S, esc_hz=rate_hz, sag_v=1.5 * (seed - 1))) for seed in (1, 2)]
    fit_profile("multirotor", [partial(packed, one) for one in flights], folder, "quad")
    return read_profile(folder)


def tried(profile: Profile, rate_hz: float, part: str, share: float, motor: int, seed: int) -> Tried:
    """Fly with a fault."""
    fault = Fault(part, motor, share, ONSET_S)
    events = play(profile, flight(seed, LENGTH_S, fault, esc_hz=rate_hz, sag_v=1.0)).events
    raised = [event for event in events if event.state == "raised"]
    parts = [event for event in events if event.part == f"{part}{motor}"]
    general = [event for event in raised if (event.observer, event.channel) == ("motors", f"motor{motor}")]
    own = [event for event in raised if event not in general]
    named = [event.channel.removesuffix(str(motor)) for event in own]
    named += [(event.part or "").removesuffix(str(motor)) for event in events if event.part]
    right = [event for event in own if event.channel == f"{part}{motor}"] + parts
    delay_s = right[0].vehicle_time_ms / 1000 - BOOT_S - ONSET_S if right else None
    ours = tuple(dict.fromkeys(name for name in named if name in SHARES))
    wrong = tuple(dict.fromkeys(name for name in named if name not in SHARES))
    return Tried(part, share, ours, wrong, len(raised), delay_s)


def healthy_alarms(profile: Profile, rate_hz: float) -> list[str]:
    """Return what is raised in a healthy flight of five minutes whose battery loses 2.5 V."""
    return [
        event.channel
        for event in play(profile, flight(21, 300.0, esc_hz=rate_hz, sag_v=2.5)).events
        if event.state == "raised"
    ]


def battery(folder: Path) -> Iterator[str]:
    """Yield a table of batteries whose resistance rises, on flights that climb and sink by a metre a second."""
    quad = partial(flight, esc_hz=0.0, climbs=1.0)
    logs = [list(quad(seed, HEALTHY_S, sag_v=1.5 * (seed - 1))) for seed in (1, 2)]
    fit_profile("multirotor", [partial(packed, one) for one in logs], folder, "quad")
    profile = read_profile(folder)
    healthy = [event.channel for event in play(profile, quad(21, 300.0, sag_v=2.5)).events if event.state == "raised"]
    yield f"Healthy, five minutes, battery from 16.6 V to 14.1 V: {', '.join(healthy) or 'no alarm'}.\n"
    yield "| resistance | alarms, each | seconds, each | first said |"
    yield "|---|---|---|---|"
    for share in BATTERY_SHARES:
        fault = Fault("battery", 0, share, ONSET_S)
        flights = [play(profile, quad(seed, 2.0 * LENGTH_S, fault, sag_v=1.0)).events for _, seed in CASES]
        raised = [[event for event in events if event.state == "raised"] for events in flights]
        alarms = "; ".join(", ".join(event.channel for event in events) or "nothing" for events in raised)
        delays = [event.vehicle_time_ms / 1000 - BOOT_S - ONSET_S for events in raised for event in events[:1]]
        said = next((event.message for events in raised for event in events), "")
        yield f"| +{100 * share:.0f} % | {alarms} | {', '.join(f'{one:.1f}' for one in delays)} | {said} |"


def page(results: dict[float, tuple[list[str], list[Tried]]]) -> Iterator[str]:
    """Yield the lines of the page."""
    yield from (__doc__ or "").splitlines()[:1]
    for rate_hz, (healthy, all_tried) in results.items():
        yield f"\n## Speeds {rate_hz:g} times a second\n"
        yield f"Healthy, five minutes, battery from 16.6 V to 14.1 V: {', '.join(healthy) or 'no alarm'}.\n"
        yield "| fault | share | named esc | prop | motor | nothing | also | alarms, each | seconds, each |"
        yield "|---|---|---|---|---|---|---|---|---|"
        for part, share in ((part, share) for part, shares in SHARES.items() for share in shares):
            cases = [one for one in all_tried if (one.part, one.share) == (part, share)]
            counts = [sum(name in one.named for one in cases) for name in SHARES]
            nothing = sum(not one.named for one in cases)
            also = ", ".join(sorted({name for one in cases for name in one.wrong})) or "-"
            delays = ", ".join("-" if one.delay_s is None else f"{one.delay_s:.2f}" for one in cases)
            alarms = ", ".join(str(one.alarms) for one in cases)
            columns = (part, f"{100 * share:.0f} %", *map(str, counts), str(nothing), also, alarms, delays)
            yield f"| {' | '.join(columns)} |"


INTRODUCTION = """# From command to thrust

This page shows whether fauio tells a weak speed controller, a damaged propeller and a bad motor apart. It does, in
simulation, if controllers report speed and current; the tables count the names. `python bench/chain.py --write` makes
this page.

**Not measured on real faults.** No recording with such faults and their truth is at hand. Two logs of PX4 with speeds
at 3 and 4 Hz could be fitted: 1.4 % of the speeds stay unexplained by commands in one, and 8 % in an acrobatic one,
too much to watch. Currents as those controllers report them leave 30 % and more, so no motor could be watched by its
current.

**The simulation** (`tests/simulated_chain.py`) is a quadrotor in gusts and random manoeuvres. Profiles are fitted on
two healthy flights; the flights with faults are others.

| fault | effect |
|---|---|
| esc | the controller applies less of the battery's voltage than commanded; 10 % less makes a motor turn 5 % slower |
| prop | the propeller gives less thrust at its speed, and takes as much less current |
| motor | the motor draws more current at its speed |

**One cause, one alarm.** If speeds come slowly, the motors' observer, which uses commands, raises `motorN` first.
Controller and propeller then show where the loss is: `escN` if the speed does not follow the command, `propN` if the
thrust does not follow the speed. The active alarm reports it in its message and its field `part`; it raises no other
alarm. The alarm is active until both have ended. If the controller or the propeller is seen first, its alarm explains
the motor's, which is not raised. An excuse with `same_cause` in the
[profile](profiles.md#observers-that-read-raw-signals) states that. A motor that ArduPilot's simulator weakens turns
slower than commanded: its alarm `motorN` names `escN`.

Each row counts the flights in which a fault was given this name, by its own alarm or in the motor's; "also" lists
other alarms.
"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run all cases and print or write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help="write docs/chain.md")
    given = parser.parse_args(arguments)
    results = {}
    with tempfile.TemporaryDirectory() as folder:
        for rate_hz in RATES_HZ:
            profile = fitted(rate_hz, Path(folder) / f"{rate_hz:g}")
            faults = ((part, share) for part, shares in SHARES.items() for share in shares)
            cases = [tried(profile, rate_hz, *fault, *case) for fault, case in product(faults, CASES)]
            results[rate_hz] = healthy_alarms(profile, rate_hz), cases
        table = ["\n## Battery\n", *battery(Path(folder) / "battery")]
    text = INTRODUCTION + "\n".join([*list(page(results))[1:], *table]) + "\n"
    if given.write:
        (ROOT / "docs" / "chain.md").write_text(text)
    else:
        print(text)


if __name__ == "__main__":
    main()
