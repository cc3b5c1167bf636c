"""What the autopilot's estimator made of the measurements, and how the autopilot reacted: the rules of these stages."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from replay.review.facts.log_facts import LogFacts, LogSignal
from replay.review.findings.loss_of_control import in_control, lost_s, spans_in_control
from replay.review.findings.rule import Judgement, Rule

_REFUSED = 1.0
"""By definition: the innovation is at its gate."""
_REFUSED_S = 1.0
"""ArduPilot's EKF check fails as long (10 times in a row at 10 Hz)."""


def _innovations_refused(facts: LogFacts, ratios: LogSignal) -> Iterator[Judgement]:
    for k, name in enumerate(ratios.names):
        for start, end in spans_in_control(facts, ratios, ratios.values[:, k] > _REFUSED, _REFUSED_S)[:1]:
            most = float(np.nanmax(ratios.during(start, end).values[:, k]))
            yield Judgement(
                start_s=start,
                end_s=end,
                text=f"the estimator refused its measurements of {name} for {end - start:.1f} s",
                evidence=(f"{ratios.origin}: {name} up to {most:.1f} times what it admits, from {start:.1f} s on",),
            )


INNOVATIONS_REFUSED = Rule(
    name="innovations_refused",
    title="Measurements refused by the estimator",
    stage="estimator",
    physics="Motion predicted from gyros and accelerometers and measured by GPS or barometer disagree by more than "
    "their noise: one of the two is wrong.",
    evidence="an innovation beyond its gate for a second in flight",
    counter=("the vehicle was still flown then: what comes after a fall, a blow or stopped motors is left out",),
    needs=("ratios",),
    plots=("ratios", "height", "height_estimate"),
    judge=_innovations_refused,
)


_AFTER_S = 5.0
"""Seconds after take-off in which a reset is usual: yaw and height are aligned anew when the ground no longer disturbs
the compass and the barometer (PX4 does so from 1.5 m on)."""


def _estimator_reset(facts: LogFacts, resets: LogSignal) -> Iterator[Judgement]:
    judged = in_control(facts, resets.time_s) & (resets.time_s > facts.flight[0][0] + _AFTER_S)
    for k, name in enumerate(resets.names):
        late = resets.time_s[1:][(np.diff(resets.values[:, k]) > 0) & judged[1:]].tolist()
        if late:
            yield Judgement(
                start_s=late[0],
                end_s=late[-1],
                text=f"the estimator set its {name} anew {len(late)} time{'s' * (len(late) > 1)} in flight",
                evidence=(f"{resets.origin}: counter of {name} from {late[0]:.1f} s on",),
                weight="warning" if name in ("position", "height") else "information",
            )


ESTIMATOR_RESET = Rule(
    name="estimator_reset",
    title="Estimator reset in flight",
    stage="estimator",
    physics="An estimator that has refused a source for seconds takes it up again by a jump.",
    evidence="its counter of resets goes up in flight",
    counter=(
        f"resets within {_AFTER_S:g} s of take-off are usual, and were left out",
        "the vehicle was still flown: a fall or stopped motors come before none of them",
    ),
    needs=("resets",),
    plots=("resets", "ratios", "height_estimate"),
    judge=_estimator_reset,
)


_LATER_S = 1.0
"""Chosen: the slowest statements of state come once a second; a failsafe that late is of the fall itself."""


def _failsafe(facts: LogFacts) -> Iterator[Judgement]:
    end_s = lost_s(facts) + _LATER_S
    said = [one for one in facts.statements if one.kind == "failsafe" and one.level and one.time_s < end_s]
    flown = facts.in_flight(np.array([one.time_s for one in said]))
    for text in dict.fromkeys(one.text for one in said):
        times = [one.time_s for one, flies in zip(said, flown.tolist(), strict=True) if flies and one.text == text]
        if not times:
            continue
        yield Judgement(
            start_s=times[0],
            end_s=times[-1],
            text=f"the autopilot announced: {text}",
            evidence=(f"at {times[0]:.1f} s" + (f", {len(times)} times" if len(times) > 1 else ""),),
            confidence="certain",
        )


FAILSAFE = Rule(
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
    judge=_failsafe,
)

RULES = INNOVATIONS_REFUSED, ESTIMATOR_RESET, FAILSAFE
