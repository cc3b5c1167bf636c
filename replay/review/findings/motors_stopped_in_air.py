"""All motors were commanded to stop in the air by somebody or something other than the landing detector."""

from __future__ import annotations

from collections.abc import Iterator

from replay.review.facts.log_facts import LogFacts, LogSignal
from replay.review.findings.loss_of_control import stops
from replay.review.findings.rule import Judgement, Rule

_NEAR_S = 1.5
"""Chosen: statements of state are logged once or twice a second by default."""


def _judge(facts: LogFacts, motors: LogSignal, height: LogSignal) -> Iterator[Judgement]:
    for start, end, fell in stops(facts):
        near = [statement for statement in facts.statements if abs(statement.time_s - start) <= _NEAR_S]
        if any(statement.kind == "landing" and statement.level for statement in near):
            continue
        causes = [
            statement
            for statement in near
            if statement.kind in ("kill", "failsafe") or (statement.kind == "arming" and not statement.level)
        ]
        why = f": {causes[0].text}" if causes else ", for a reason that the log does not state"
        yield Judgement(
            span=(min([start, *(cause.time_s for cause in causes)]), end),
            text=f"all motors were commanded to stop in the air{why}; the vehicle fell {fell:.0f} m",
            evidence=(
                f"{motors.origin}: all motors at zero from {start:.2f} to {end:.2f} s",
                f"{height.origin}: {fell:.1f} m lower within 3 s of it",
                *(f"{cause.kind} at {cause.time_s:.2f} s: {cause.text}" for cause in causes),
            ),
            confidence="certain",
            weight="critical",
        )


RULE = Rule(
    title="Motors stopped in the air",
    stage="command",
    physics="A kill switch, a disarming, a termination or a crash detector takes all commands to zero, and the "
    "vehicle falls.",
    evidence="all motors at zero for 0.4 s or longer after they turned, and the barometer falls by 2 m within 3 s",
    counter=(
        "no landing was detected before it, and the barometer falls",
        "the commands themselves are zero: no motor failed",
    ),
    needs=("motors", "height"),
    plots=("motors", "height", "climb"),
    judge=_judge,
    multirotor=True,
)
