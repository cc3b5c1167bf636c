"""One motor was commanded to its most for long, and the vehicle still turned towards it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from replay.review.facts.log_facts import LogFacts, LogSignal
from replay.review.findings.loss_of_control import FULL, spans_in_control
from replay.review.findings.rule import Judgement, Rule

_APART = 0.25
"""Chosen: how much less the others' mean is. Hard climbs take all motors to their most together; turns in yaw, two."""
_LEAST_S = 1.0
"""ArduPilot's thrust-loss check waits as long; a hard turn has motors at their most for less."""

_STEEP_DEG = 30.0
"""Tilt wanted beyond which a vehicle gathers speed (6 m/s2 and more), whose drag and lift turn it as a weak motor does:
default of PX4's and ArduPilot's position modes, half as much again in sports."""


def _judge(facts: LogFacts, motors: LogSignal) -> Iterator[Judgement]:
    if len(motors.names) < 4:
        return
    # there the air turns a fast vehicle, too
    dashes = (np.abs(facts.signal("attitude_wanted").at(motors.time_s)[:, :2]) > _STEEP_DEG).any(axis=1)
    for k, name in enumerate(motors.names):
        others, own = np.delete(motors.values, k, axis=1), motors.values[:, k]
        alone = (own > FULL) & (np.median(others, axis=1) < own - _APART) & ~dashes
        for start, end in spans_in_control(facts, motors, alone, _LEAST_S)[:1]:
            mean = float(np.median(others[(motors.time_s >= start) & (motors.time_s <= end)]))
            yield Judgement(
                span=(start, end),
                text=f"{name} was at full command for {end - start:.1f} s while the others were at {100 * mean:.0f} %: "
                "it, its ESC or its propeller gives too little",
                evidence=(f"{motors.origin}: {name} above {FULL:.2f}, median of the others {mean:.2f}",),
                weight="critical",
            )


RULE = Rule(
    title="One motor at its most",
    stage="motion",
    physics="The autopilot gives the motor that lifts too little more and more command, until there is no more.",
    evidence="one motor above 95 % for a second, the others' median 25 % of full command lower",
    counter=(
        "a hard climb takes all motors up, a turn in yaw the two that turn the same way",
        f"no more than {_STEEP_DEG:g} degrees of tilt were wanted: in a dash the air turns the vehicle, too",
    ),
    needs=("motors",),
    plots=("motors", "attitude", "rpm"),
    judge=_judge,
    multirotor=True,
    least_hz=4.0,  # of a second four samples
)
