"""Vibration was so strong that the accelerometers cannot be trusted."""

from collections.abc import Iterator

import numpy as np

from replay.review.facts.log_facts import LogFacts, LogSignal, spans_where
from replay.review.findings.loss_of_control import in_control
from replay.review.findings.rule import Judgement, Rule

_ARDUPILOT, _PX4 = 60.0, 9.81
"""Limits of vibration, m/s2. ArduPilot's documentation: above 60 problems with height are nearly certain (below 30 is
normal); PX4's flight review draws its metric red from 9.81 on."""
_SHARE = 0.2
"""Smallest share of the flight above the limit. Chosen: a fifth; single peaks are landings and touches."""
_CLIPPED = 100
"""Smallest count of clipped samples in a flight. ArduPilot's documentation: a steadily rising count, above 100 in a
flight, is a problem."""
_BLOW = 2
"""Records that may show one blow, if it falls between two: a count that rises in no more records does not rise
steadily."""


def _judge(facts: LogFacts, vibration: LogSignal) -> Iterator[Judgement]:
    limit = _ARDUPILOT if facts.autopilot == "ArduPilot" else _PX4
    times = vibration.time_s
    judged = in_control(facts, times)
    high = judged & (vibration.only > limit)
    clipped = _clipped(facts)
    if not judged.any() or (high.sum() < _SHARE * judged.sum() and clipped < _CLIPPED):
        return
    most = float(np.max(vibration.only[judged]))
    spans = spans_where(times, high) or [(float(times[judged][0]), float(times[judged][-1]))]
    yield Judgement(
        span=(spans[0][0], spans[-1][1]),
        text=_said(most, clipped, bool(high.any())),
        evidence=(
            f"{vibration.origin}: above {limit:g} m/s2 in {100 * high.sum() / judged.sum():.0f} % of the flight",
            *([f"{facts.signals['clipping'].origin}: {clipped:.0f} clipped samples in flight"] if clipped else []),
        ),
        weight="warning" if clipped >= _CLIPPED else "information",
        event=False,
    )


def _said(most: float, clipped: float, strong: bool) -> str:
    if not strong:
        return f"an accelerometer was at the end of its range in {clipped:.0f} samples, with vibration below the limit"
    also = f", and {clipped:.0f} clipped samples of an accelerometer" if clipped else ""
    return f"strong vibration, up to {most:.0f} m/s2{also}"


def _clipped(facts: LogFacts) -> float:
    clipping = facts.signal("clipping")
    rises = np.diff(clipping.only[in_control(facts, clipping.time_s)])
    return float(rises.sum()) if (rises > 0).sum() > _BLOW else 0.0


RULE = Rule(
    title="Strong vibration",
    stage="sensor",
    physics="Vibration beyond an accelerometer's range is clipped more on one side than on the other: the estimator "
    "sees a false acceleration, first in height.",
    evidence="the autopilot's own level beyond its documented limit in a fifth of the flight, or 100 clipped samples",
    counter=("landings, blows and falls are left out", "with little clipping it is information only"),
    needs=("vibration",),
    plots=("vibration", "clipping", "acceleration"),
    judge=_judge,
)
