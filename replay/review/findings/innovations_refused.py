"""The estimator refused measurements while the vehicle was still controlled."""

from collections.abc import Iterator

import numpy as np

from replay.review.facts.log_facts import Floats, LogFacts, LogSignal
from replay.review.findings.loss_of_control import spans_in_control, struck
from replay.review.findings.rule import Judgement, Rule

_REFUSED = 1.0
"""Innovation over its gate from which measurements are refused, by definition."""
_LEAST_S = 1.0
"""Shortest refusal, seconds: ArduPilot's EKF check fails after as long (10 times in a row at 10 Hz)."""


def _judge(facts: LogFacts, ratios: LogSignal) -> Iterator[Judgement]:
    for k, name in enumerate(ratios.names):
        spans = spans_in_control(facts, ratios, ratios.values[:, k] > _REFUSED, _LEAST_S)
        told = (span for span in spans if _measured(ratios.during(*span).values[:, k], *span))
        for start, end in [span for span in told if not struck(facts, span[0])][:1]:
            most = float(np.nanmax(ratios.during(start, end).values[:, k]))
            yield Judgement(
                span=(start, end),
                text=f"the estimator refused its measurements of {name} for {end - start:.1f} s",
                evidence=(f"{ratios.origin}: {name} up to {most:.1f} times its gate, from {start:.1f} s on",),
            )


def _measured(values: Floats, start_s: float, end_s: float) -> bool:
    """Return whether ratios change as innovations do, with every measurement.

    Each differs from the one before to the last bit, and sources come once a second at least, or as often as the ratio.
    """
    return bool(2 * np.count_nonzero(np.diff(values)) >= min(len(values) - 1, end_s - start_s))


RULE = Rule(
    title="Measurements refused by the estimator",
    stage="estimator",
    physics="Motion predicted from gyros and accelerometers differs from GPS or barometer by more than the noise: one "
    "of the two is wrong.",
    evidence="an innovation beyond its gate for a second in flight",
    counter=(
        "the vehicle was still controlled; refusals after a fall, a blow or stopped motors are left out",
        "the ratio changed with every measurement: some controllers send the state of something else in its place",
    ),
    needs=("ratios",),
    plots=("ratios", "height", "height_estimate"),
    judge=_judge,
)
