"""The estimator set its position or height anew in flight."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from replay.review.facts.log_facts import LogFacts
from replay.review.findings.loss_of_control import lost_s
from replay.review.findings.rule import Judgement, Rule

_AFTER_S = 5.0
"""Seconds after take-off in which a reset is usual: yaw and height are aligned anew when the ground no longer disturbs
the compass and the barometer (PX4 does so from 1.5 m on)."""


def _judge(facts: LogFacts) -> Iterator[Judgement]:
    resets = facts.signals["resets"]
    times, end_s = resets.time_s, lost_s(facts)
    for k, name in enumerate(resets.names):
        at = np.flatnonzero(np.diff(resets.values[:, k]) > 0) + 1
        begin_s = facts.flight[0][0] + _AFTER_S if facts.flight else 0.0
        in_flight = facts.in_flight(times)
        late = [int(row) for row in at if in_flight[row] and begin_s < times[row] < end_s]
        if late:
            first = float(times[late[0]])
            yield Judgement(
                start_s=first,
                end_s=float(times[late[-1]]),
                text=f"the estimator set its {name} anew {len(late)} time{'s' * (len(late) > 1)} in flight",
                evidence=(f"{resets.origin}: counter of {name} from {first:.1f} s on",),
                counter=(f"resets within {_AFTER_S:g} s of take-off are usual, and were left out",),
                confidence="likely",
                weight="warning" if name in ("position", "height") else "information",
                plots=("resets", "ratios", "height_estimate"),
            )


RULE = Rule(
    name="estimator_reset",
    title="Estimator reset in flight",
    stage="estimator",
    physics="An estimator that has refused a source for seconds takes it up again by a jump.",
    evidence="its counter of resets goes up in flight",
    counter="alignment after take-off; after a fall or stopped motors",
    needs=("resets",),
    judge=_judge,
)
