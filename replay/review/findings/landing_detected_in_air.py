"""The landing detector said the vehicle had landed while it was in the air, and its motors were stopped."""

from __future__ import annotations

from collections.abc import Iterator

from replay.review.facts.log_facts import LogFacts, LogSignal
from replay.review.findings.loss_of_control import stops
from replay.review.findings.rule import Judgement, Rule

_BEFORE_S = 2.0
"""How long ahead of the stop a detector may have said so: PX4 stops motors at once and disarms after 2 s
(COM_DISARM_LAND), ArduPilot after 0.5 to 10 s (DISARM_DELAY)."""


def _judge(facts: LogFacts, motors: LogSignal, height: LogSignal) -> Iterator[Judgement]:
    landings = [statement for statement in facts.statements if statement.kind == "landing" and statement.level]
    for start, end, fell in stops(facts):
        said = [landing for landing in landings if -_BEFORE_S <= landing.time_s - start <= 0.5]
        if not said:
            continue
        at = said[-1].time_s
        yield Judgement(
            span=(at, end),
            text="the landing detector reported 'landed' in the air; the motors were stopped and the vehicle fell "
            f"{fell:.0f} m",
            evidence=(
                f"landing detector: landed at {at:.2f} s",
                f"{motors.origin}: all motors at zero from {start:.2f} to {end:.2f} s",
                f"{height.origin}: {fell:.1f} m lower within 3 s of it",
            ),
            confidence="certain",
            weight="critical",
        )


RULE = Rule(
    title="Landing detected in the air",
    stage="decision",
    physics="A landing detector takes low thrust without vertical motion for the ground, and the autopilot stops the "
    "motors. A vehicle that cannot descend at its least thrust looks the same.",
    evidence="'landed' before all motors are at zero, and the barometer falls by 2 m or more within 3 s",
    counter=(
        "a landing on a roof or a hill looks the same, but the vehicle does not fall afterwards",
        "the barometer reads higher when rotors stop near the ground, not lower",
    ),
    needs=("motors", "height"),
    plots=("motors", "height", "climb"),
    judge=_judge,
    multirotor=True,
)
