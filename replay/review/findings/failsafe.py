"""The autopilot itself announced a failsafe in flight."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from replay.review.facts.log_facts import LogFacts
from replay.review.findings.loss_of_control import lost_s
from replay.review.findings.rule import Judgement, Rule

_LATER_S = 1.0
"""Chosen: the slowest statements of state come once a second; a failsafe that late is of the fall itself."""


def _judge(facts: LogFacts) -> Iterator[Judgement]:
    end_s = lost_s(facts) + _LATER_S
    said = [one for one in facts.statements if one.kind == "failsafe" and one.level and one.time_s < end_s]
    flown = facts.in_flight(np.array([one.time_s for one in said]))
    for text in dict.fromkeys(one.text for one in said):
        times = [one.time_s for one, flies in zip(said, flown.tolist(), strict=True) if flies and one.text == text]
        if not times:
            continue
        yield Judgement(
            span=(times[0], times[-1]),
            text=f"the autopilot announced: {text}",
            evidence=(f"at {times[0]:.1f} s" + (f", {len(times)} times" if len(times) > 1 else ""),),
            confidence="certain",
        )


RULE = Rule(
    title="Failsafe announced",
    stage="reaction",
    physics="The autopilot compares what it measures with limits of its own and acts; that act can be the incident.",
    evidence="its own statement in flight",
    counter=(
        "it says what the autopilot saw, which need not be the cause: a finding before it comes first",
        "those on the ground and after control was lost are left out",
    ),
    needs=(),
    plots=("attitude", "ratios", "battery"),
    judge=_judge,
)
