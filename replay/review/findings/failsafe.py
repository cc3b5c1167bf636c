"""The autopilot itself announced a failsafe in flight."""

from collections.abc import Iterator

import numpy as np

from replay.review.facts.log_facts import LogFacts, inside
from replay.review.findings.loss_of_control import lost_s
from replay.review.findings.rule import Judgement, Rule

_LATER_S = 1.0
"""Time after a loss of control in which failsafes count, seconds. Chosen: the slowest statements of state come once a
second; a later failsafe is caused by the fall itself."""


def _judge(facts: LogFacts) -> Iterator[Judgement]:
    end_s = lost_s(facts) + _LATER_S
    said = [one for one in facts.statements if one.kind == "failsafe" and one.level and one.time_s < end_s]
    times_s = np.array([one.time_s for one in said])
    crashed = np.array(["crash" in one.text.lower() for one in said], bool)
    # a crash check disarms a vehicle that has lain for a while
    lain = [(end, until + _LATER_S) for _, end in facts.flight for start, until in facts.armed if start < end <= until]
    flown = facts.in_flight(times_s) | crashed & inside(times_s, lain)
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
    physics="The autopilot compares measurements with its own limits and acts; that action can be the incident.",
    evidence="its own statement in flight",
    counter=(
        "it states what the autopilot saw, which may not be the cause: an earlier finding comes first",
        "announcements on the ground and after a loss of control are left out, except the detection of a crash",
    ),
    needs=(),
    plots=("attitude", "ratios", "battery"),
    judge=_judge,
)
