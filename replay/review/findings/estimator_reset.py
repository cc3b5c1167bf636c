"""The estimator reset its position or height in flight."""

from collections.abc import Iterator

import numpy as np

from replay.review.facts.log_facts import LogFacts, LogSignal
from replay.review.findings.loss_of_control import in_control, struck
from replay.review.findings.rule import Judgement, Rule

_AFTER_S = 5.0
"""Time after take-off in which a reset is usual, seconds: yaw and height are aligned again when the ground no longer
disturbs the compass and the barometer (PX4 does so from 1.5 m on)."""
_STEPS = {
    "position": (slice(0, 2), "m"),
    "height": (slice(2, 3), "m"),
    "velocity": (slice(3, 5), "m/s"),
    "climb": (slice(5, 6), "m/s"),
}
"""For each counter: its columns of the steps, and their unit."""


def _judge(facts: LogFacts, resets: LogSignal) -> Iterator[Judgement]:
    steps = facts.signal("reset_steps")
    judged = in_control(facts, resets.time_s) & (resets.time_s > facts.flight[0][0] + _AFTER_S)
    for k, name in enumerate(resets.names):
        times_s = resets.time_s[1:][(np.diff(resets.values[:, k]) > 0) & judged[1:]]
        if late := [at for at in times_s.tolist() if not struck(facts, at)]:
            columns, unit = _STEPS[name]
            largest = np.nanmax(np.linalg.norm(steps.at(np.array(late))[:, columns], axis=1)) if steps else np.nan
            by = "by up to " if len(late) > 1 else "by "
            yield Judgement(
                span=(late[0], late[-1]),
                text=f"the estimator reset its {name} {len(late)} time{'s' * (len(late) > 1)} {facts.when}"
                + (f", {by}{float(f'{largest:.2g}'):g} {unit}" if np.isfinite(largest) else ""),
                evidence=(f"{resets.origin}: counter of {name} from {late[0]:.1f} s on",),
                weight="warning" if name in ("position", "height") else "information",
            )


RULE = Rule(
    title="Estimator reset in flight",
    stage="estimator",
    physics="An estimator that has refused a source for seconds jumps when it accepts the source again.",
    evidence="its counter of resets increases in flight",
    counter=(
        f"resets within {_AFTER_S:g} s of take-off are usual and are left out",
        "the vehicle was still controlled: no fall, no blow and no stopped motors came before",
    ),
    needs=("resets",),
    plots=("resets", "ratios", "height_estimate"),
    judge=_judge,
)
