"""Somebody who had not commanded the vehicle before take-off did so in flight, or commands came in a flood."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from monitor.alarms.command_risk import command_risk
from replay.review.facts.log_facts import LogFacts
from replay.review.findings.rule import Judgement, Rule

_FLOOD = 50
"""Commands within a second. Chosen: a ground station sends missions and parameters with an answer to each, some
ten a second over a radio, some thirty over a wire."""


def _judge(facts: LogFacts) -> Iterator[Judgement]:
    if not facts.commands:
        return
    begin_s = facts.flight[0][0]
    known = {(one.system, one.component) for one in facts.commands if one.time_s < begin_s}
    flown = facts.in_flight(np.array([one.time_s for one in facts.commands]))
    for one in (one for one, flies in zip(facts.commands, flown, strict=True) if flies):
        risk = command_risk(one.name, one.values)
        sender = one.system, one.component
        if risk is None or sender in known:
            continue
        yield Judgement(
            start_s=one.time_s,
            end_s=one.time_s,
            text=f"system {one.system}, component {one.component}, which had not commanded before, {risk} in flight",
            evidence=(f"{one.name} at {one.time_s:.2f} s with {', '.join(map(str, one.values)) or 'nothing'}",),
            counter=(
                f"commands before take-off came from {sorted(known) if known else 'nobody'}",
                "a second ground station that was switched on in flight looks the same",
            ),
            confidence="likely" if known else "possible",
            weight="critical" if known else "information",
            plots=("height", "motors", "attitude"),
        )
        known.add(sender)
    times = np.array([one.time_s for one, flies in zip(facts.commands, flown, strict=True) if flies])
    within = np.searchsorted(times, times + 1.0) - np.arange(len(times))
    if len(times) and within.max() > _FLOOD:
        at = float(times[int(np.argmax(within > _FLOOD))])
        yield Judgement(
            start_s=at,
            end_s=at + 1.0,
            text=f"up to {within.max()} commands a second reached the vehicle in flight",
            evidence=(f"{within.max()} commands within a second, from {at:.2f} s on",),
            counter=("missions and parameters come with an answer to each, and slower",),
            confidence="certain",
            weight="warning",
            plots=("height", "motors", "attitude"),
        )


RULE = Rule(
    name="commands_from_outside",
    title="Commands from a new sender in flight",
    stage="link",
    physics="MAVLink without signing obeys everybody. An attacker disarms, reboots, changes the mode, rewrites the "
    "mission or takes safety parameters away; the vehicle does as it is told, and nothing fails.",
    evidence="such a command in flight from ids that had not commanded before take-off; more than 50 commands a second",
    counter="a second ground station switched on in flight; a sender that uses the ids of the ground station, which "
    "signing alone tells apart",
    needs=(),
    judge=_judge,
)
