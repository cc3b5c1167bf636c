"""The receiver repeated one position for seconds, and then jumped to another."""

from collections.abc import Iterator

import numpy as np

from replay.review.facts.log_facts import LogFacts, LogSignal
from replay.review.findings.loss_of_control import spans_in_control
from replay.review.findings.rule import Judgement, Rule

_LEAST_S = 2.0
"""Shortest repetition, seconds. Chosen: ten fixes at the usual rate of receivers."""
_JUMP_M = 5.0
"""Smallest jump, metres: twice the 2.5 m that half of a receiver's errors exceed (data sheet of u-blox's M8). Measured
in 239 simulated and public logs: of the positions repeated for 2 s in flight only those of three logs with a faulty
GPS are followed by such a jump."""


def _judge(facts: LogFacts, position: LogSignal) -> Iterator[Judgement]:
    steps = np.append(np.hypot(*np.diff(position.values, axis=0).T), np.nan)
    for start, end in spans_in_control(facts, position, steps == 0.0, _LEAST_S):
        jump = float(steps[np.searchsorted(position.time_s, end)])
        if jump > _JUMP_M:
            yield Judgement(
                span=(start, end),
                text=f"GPS repeated one position for {end - start:.1f} s and then was {jump:.0f} m away",
                evidence=(
                    f"{position.origin}: the same position from {start:.1f} to {end:.1f} s, then {jump:.1f} m off",
                ),
            )


RULE = Rule(
    title="GPS repeated a position",
    stage="sensor",
    physics="Fixes of a working receiver differ by a centimetre each time. A stuck receiver, or a last fix that is "
    "sent again and again, holds the estimator at an old position.",
    evidence="the same position for 2 s of flight, the next one more than 5 m away",
    counter=(
        "a receiver may hold its position in hover, but then shows no jump afterwards",
        "if the estimator does not use it (vision, flow), it has no effect, but is stuck all the same",
    ),
    needs=("position",),
    plots=("position", "ratios", "height_estimate"),
    judge=_judge,
)
