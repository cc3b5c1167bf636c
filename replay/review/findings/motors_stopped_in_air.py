"""All motors were commanded to stop in the air, by the landing detector, a person or another part of the autopilot."""

from collections.abc import Iterator

from replay.review.facts.log_facts import LogFacts, LogSignal, Statement
from replay.review.findings.loss_of_control import stops
from replay.review.findings.rule import Judgement, Rule

_NEAR_S = 1.5
"""Time around the stop in which a statement may be its cause, seconds. Chosen: statements of state are logged once or
twice a second by default."""
_LANDED_S = (-2.0, 0.5)
"""Time from the stop in which a landing detector may have caused it, seconds: PX4 stops motors at once and disarms
after 2 s (COM_DISARM_LAND), ArduPilot after 0.5 to 10 s (DISARM_DELAY). A later report is a touch-down."""


def _judge(facts: LogFacts, motors: LogSignal, height: LogSignal) -> Iterator[Judgement]:
    for start, end, fell in stops(facts):
        about = [(said.time_s - start, said) for said in facts.statements]
        landed = [(after, said) for after, said in about if said.kind == "landing" and said.level]
        causes = [said for after, said in landed if _LANDED_S[0] <= after <= _LANDED_S[1]][-1:]
        if not causes and any(abs(after) <= _NEAR_S for after, _ in landed):
            continue
        why = "the landing detector reported 'landed' in the air; the motors were stopped"
        if not causes:
            causes = [said for after, said in about if abs(after) <= _NEAR_S and _stops(said)]
            reason = f": {causes[0].text}" if causes else ", for a reason that the log does not state"
            why = f"all motors were commanded to stop in the air{reason},"
        yield Judgement(
            span=(min([start, *(cause.time_s for cause in causes)]), end),
            text=f"{why} and the vehicle fell {fell:.0f} m",
            evidence=(
                f"{motors.origin}: all motors at zero from {start:.2f} to {end:.2f} s",
                f"{height.origin}: {fell:.1f} m lower within 3 s of it",
                *(f"{cause.kind} at {cause.time_s:.2f} s: {cause.text}" for cause in causes),
            ),
            confidence="certain",
            weight="critical",
        )


def _stops(said: Statement) -> bool:
    return said.kind in ("kill", "failsafe") or (said.kind == "arming" and not said.level)


RULE = Rule(
    title="Motors stopped in the air",
    stage="decision",
    physics="A kill switch, a disarming, a termination or a crash detector takes all commands to zero, and the "
    "vehicle falls. A landing detector takes low thrust without vertical motion for the ground; a vehicle that cannot "
    "descend at its least thrust looks the same.",
    evidence="all motors at zero for 0.4 s or longer after they turned, and the barometer falls by 2 m within 3 s",
    counter=(
        "after a landing on a roof or a hill the vehicle does not fall",
        "the barometer reads higher when rotors stop near the ground, not lower",
        "the commands themselves are zero: no motor failed",
    ),
    needs=("motors", "height"),
    plots=("motors", "height", "climb"),
    judge=_judge,
    multirotor=True,
)
