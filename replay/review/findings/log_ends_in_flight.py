"""The log ends while the vehicle is armed and in the air."""

from collections.abc import Iterator

from replay.review.facts.log_facts import LogFacts, LogSignal
from replay.review.findings.rule import Judgement, Rule

_HIGH_M = 3.0
"""Smallest height above the begin, metres: larger than a barometer's error beside turning rotors."""
_AT_END_S = 1.5
"""Time before the log's end that counts as its end, seconds. Chosen: the slowest statements of state come once a
second."""


def _judge(facts: LogFacts, height: LogSignal) -> Iterator[Judgement]:
    late = facts.duration_s - _AT_END_S
    last = height.only[height.time_s > late]
    ends = [spans[-1][1] for spans in (facts.flight, facts.armed) if spans]
    if not facts.flies or len(ends) < 2 or min(ends) < late or not len(last) or last[-1] < _HIGH_M:
        return
    battery = facts.signal("battery")
    volts = f"; the last voltage is {battery.values[-1, 0]:.1f} V" if battery else ""
    yield Judgement(
        span=(facts.duration_s, facts.duration_s),
        text=f"the log ends in the air, {last[-1]:.0f} m above its begin: power was lost, or recording stopped",
        evidence=(f"{height.origin}: {last[-1]:.1f} m at the end, armed and not landed{volts}",),
        confidence="possible",
        weight="information",
    )


RULE = Rule(
    title="Log ends in flight",
    stage="supply",
    physics="An autopilot without power stops writing.",
    evidence="armed, not landed and 3 m high in the last second and a half",
    counter=("a cut file or a stopped recording looks the same",),
    needs=("height",),
    plots=("height", "battery"),
    judge=_judge,
)
