"""The autopilot's controller used a position that its estimator did not have."""

from collections.abc import Iterator

import numpy as np

from replay.review.facts.log_facts import LogFacts, LogSignal
from replay.review.findings.loss_of_control import spans_in_control
from replay.review.findings.rule import Judgement, Rule

_APART_M = 2.5
"""Metres that half of a receiver's errors exceed (data sheet of u-blox's M8): a smaller difference takes no vehicle off
course. Measured: 0.0 m in 88 logs without such an attack, and up to 63 m for less than a second on ten real flights
whose estimator changed its lane."""
_LEAST_S = 1.0
"""Shortest difference, seconds: a reset or a change of lane reaches the controller with the next record, a tenth of
that later."""


def _judge(facts: LogFacts, apart: LogSignal) -> Iterator[Judgement]:
    for start, end in spans_in_control(facts, apart, apart.only > _APART_M, _LEAST_S)[:1]:
        during = apart.during(start, end).only
        yield Judgement(
            span=(start, end),
            text=f"the autopilot controlled a position up to {during.max():.0f} m off its own estimate "
            f"for {end - start:.1f} s: something inside it altered the position",
            evidence=(
                f"{apart.origin}: {during[0]:.1f} m apart at {start:.1f} s, {np.median(during):.1f} m in the middle",
            ),
            confidence="certain",
            weight="critical",
        )


RULE = Rule(
    title="Position altered inside the autopilot",
    stage="decision",
    physics="A controller uses the position of the estimator unchanged. If the two differ by metres, something between "
    "them changes it: an attack on the autopilot's program, or a fault of it. Sensors and estimator agree all the "
    "time, but the vehicle goes astray.",
    evidence=f"{_APART_M} m between the controller's position and each lane of the estimator, for a second",
    counter=(
        "a reset of the estimator and a change of its lane reach the controller within a tenth of a second",
        "a spoofed GPS takes the estimate along: both agree then, and this finding does not appear",
    ),
    needs=("position_apart",),
    plots=("position_apart", "position", "ratios"),
    judge=_judge,
)
