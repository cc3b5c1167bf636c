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
    said = [
        statement
        for statement in facts.statements
        if statement.kind == "failsafe" and statement.level and statement.time_s < end_s
    ]
    flown = facts.in_flight(np.array([statement.time_s for statement in said])).tolist()
    said = [statement for statement, flies in zip(said, flown, strict=True) if flies]
    for text in dict.fromkeys(statement.text for statement in said):
        times = [statement.time_s for statement in said if statement.text == text]
        yield Judgement(
            start_s=times[0],
            end_s=times[-1],
            text=f"the autopilot announced: {text}",
            evidence=(f"at {times[0]:.1f} s" + (f", {len(times)} times" if len(times) > 1 else ""),),
            confidence="certain",
        )


RULE = Rule(
    name="failsafe",
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
