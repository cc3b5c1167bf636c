"""The vehicle turned over in flight while its motors were commanded to turn."""

from collections.abc import Iterator

from replay.review.facts.log_facts import LogFacts, LogSignal
from replay.review.findings.loss_of_control import stops, tilts_deg, tumbles
from replay.review.findings.rule import Judgement, Rule

_ON_PURPOSE = ("Acro", "ACRO", "FLIP", "RATTITUDE")
_STAYED_S = 1.0
"""Time before the flight's end, seconds. Chosen: a vehicle that is upside down in it did not fly on."""


def _judge(facts: LogFacts, attitude: LogSignal, _: LogSignal) -> Iterator[Judgement]:
    stopped = [start for start, _, _ in stops(facts)]
    for start, end in tumbles(facts)[:1]:
        if any(at < start for at in stopped):
            return
        modes = [
            statement.text for statement in facts.statements if statement.kind == "mode" and statement.time_s <= start
        ]
        stayed = any(until > facts.flight[-1][1] - _STAYED_S for _, until in tumbles(facts))
        meant = bool(modes) and any(word in modes[-1] for word in _ON_PURPOSE) and not stayed
        most = tilts_deg(attitude.during(start, end + 0.1)).max()
        yield Judgement(
            span=(start, end),
            text=f"the vehicle turned over: {most:.0f} degrees from level for {end - start:.1f} s",
            evidence=(f"{attitude.origin}: beyond 100 degrees from level from {start:.2f} s on",),
            counter=(
                f"the mode was {modes[-1].removeprefix('mode ') if modes else 'not recorded'}"
                + (", in which pilots turn over on purpose" if meant else ""),
            ),
            confidence="possible" if meant else "certain",
            weight="information" if meant else "critical",
        )


RULE = Rule(
    title="Turned over",
    stage="motion",
    physics="Without a motor or a propeller, or with a wrong attitude, a multirotor tumbles within a second.",
    evidence="100 degrees from level for 0.3 s in flight",
    counter=(
        "its motors had not been commanded to stop before",
        "flips in acro modes, after which it flies on, are information only",
        "if only the estimator were wrong, there would be no blow, no fall, and no acceleration of hanging upside down",
    ),
    needs=("attitude", "throttle"),
    plots=("attitude", "motors", "throttle", "height"),
    judge=_judge,
    multirotor=True,
)
