"""The fix of a GPS that the estimator used was lost in flight."""

from collections.abc import Iterator

import numpy as np

from replay.review.facts.log_facts import FIX_3D, LogFacts, LogSignal
from replay.review.findings.loss_of_control import in_control, spans_in_control
from replay.review.findings.rule import Judgement, Rule

_LEAST_S = 1.0
"""Shortest loss, seconds. Chosen: five fixes at the usual rate of receivers."""


def _judge(facts: LogFacts, gps: LogSignal) -> Iterator[Judgement]:
    known = np.logical_or.accumulate((gps.only >= FIX_3D) & in_control(facts, gps.time_s))
    for start, end in spans_in_control(facts, gps, known & (gps.only < FIX_3D), _LEAST_S)[:1]:
        fewest = int(gps.during(start, end).values[:, 1].min())
        yield Judgement(
            span=(start, end),
            text=f"GPS lost its fix for {end - start:.1f} s {facts.when}, with {fewest} satellites",
            evidence=(f"{gps.origin}: fix below 3 from {start:.1f} to {end:.1f} s, {fewest} satellites at least",),
            confidence="certain",
        )


RULE = Rule(
    title="GPS fix lost in flight",
    stage="sensor",
    physics="Without a fix the estimator uses inertial sensors only, and drifts by metres within seconds.",
    evidence="no 3D fix for a second in flight, after there was one",
    counter=(
        "the estimator used GPS in this flight; with vision or flow the receiver has no effect",
        "it had a fix before",
    ),
    needs=("gps",),
    plots=("gps", "ratios", "height_estimate"),
    judge=_judge,
)
