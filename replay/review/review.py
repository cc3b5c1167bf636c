"""The verdict on a log: its findings, which one was first, and what could not be judged."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from adapters.logs.damage import Damage
from replay.review.facts.log_facts import SIGNALS, LogFacts
from replay.review.facts.reading import read_facts
from replay.review.findings.rule import STAGES, WEIGHTS, Judgement, Rule, UnjudgedError, Weight
from replay.review.rules import RULES

_SAME_S: Final = 0.5
"""Two findings within this time are ordered by causes, seconds. Chosen: the slower signals of logs come at 2 Hz."""
_QUIET = 5
"""MAVLink's and syslog's severity of a notice: texts of lower severity are routine."""


@dataclass(frozen=True, slots=True)
class ReviewFinding:
    """A judgement, the rule that made it, and its rank in time: information alone has no rank."""

    rule: Rule
    judgement: Judgement
    rank: Literal["first", "later", "throughout", ""]

    @property
    def counter(self) -> tuple[str, ...]:
        """Other causes that look the same, and why they are excluded."""
        return *self.rule.counter, *self.judgement.counter


@dataclass(frozen=True, slots=True, eq=False)
class LogReview:
    """The verdict on one log."""

    log: Path
    facts: LogFacts
    findings: tuple[ReviewFinding, ...]
    watched: tuple[str, ...]  # findings that were looked for and not found
    unjudged: Mapping[str, str]  # findings that could not be judged, and why
    damage: tuple[Damage, ...] = ()

    @property
    def first(self) -> ReviewFinding | None:
        """The first finding: the first thing that stopped following."""
        return next((finding for finding in self.findings if finding.rank == "first"), None)

    @property
    def sentence(self) -> str:
        """The verdict in one sentence."""
        first = self.first
        if not self.facts.flight:
            armed_s = sum(end - start for start, end in self.facts.armed)
            why = (
                f"it was armed for {armed_s:.0f} s and never seen to leave the ground"
                if armed_s
                else "it was never armed"
            )
            return f"The log shows no flight, {why}: nothing was judged."
        if first is None:
            watched = f"{len(self.watched)} of {len(self.watched) + len(self.unjudged)} findings could be looked for"
            return f"Nothing wrong found in {self.facts.flight_text}; {watched}."
        text = first.judgement.text
        said = f"First, at {first.judgement.start_s:.1f} s, {text} ({first.judgement.confidence})."
        critical = (finding for finding in self.findings if finding.judgement.weight == "critical")
        worst = next((finding for finding in critical if finding is not first), None)
        if worst is not None and first.judgement.weight != "critical":
            said += f" Then, at {worst.judgement.start_s:.1f} s, {worst.judgement.text}."
        return said[0].upper() + said[1:]

    @property
    def severity(self) -> Weight:
        """The highest severity of its findings."""
        weights = (finding.judgement.weight for finding in self.findings)
        return max(weights, key=WEIGHTS.index, default="information")

    @property
    def wrong(self) -> bool:
        """Whether there is a finding that is more than information."""
        return self.severity != "information"

    def reasons(self) -> Iterator[tuple[str, str]]:
        """Yield the findings that could not be judged, joined if they have the same reason, and the reason."""
        for why in dict.fromkeys(self.unjudged.values()):
            yield ", ".join(title for title, reason in self.unjudged.items() if reason == why), why

    def timeline(self) -> list[tuple[float, str, str]]:
        """Return the statements of the log and the findings, in order: time, kind, text."""
        stated = [
            (said.time_s, said.kind, said.text)
            for said in self.facts.statements
            if said.kind != "text" or said.level < _QUIET or "etected" in said.text
        ]
        judged = [(finding.judgement.start_s, "finding", finding.judgement.text) for finding in self.findings]
        return sorted([*stated, *judged], key=lambda entry: entry[0])

    def to_json(self) -> dict[str, Any]:
        """Return the verdict as a JSON object."""
        return {
            "log": str(self.log),
            "autopilot": self.facts.autopilot,
            "vehicle": self.facts.vehicle,
            "duration_s": round(self.facts.duration_s, 3),
            "flight_s": round(self.facts.flight_s, 3),
            "verdict": self.sentence,
            "wrong": self.wrong,
            "severity": self.severity,
            "first": None if self.first is None else self.first.rule.name,
            "findings": [_finding_json(finding) for finding in self.findings],
            "watched": list(self.watched),
            "not_judged": dict(self.unjudged),
            "timeline": [{"time_s": round(at, 3), "kind": kind, "text": text} for at, kind, text in self.timeline()],
            "damage": [part.to_json() for part in self.damage],
        }


def review_log(path: Path, *, learn: bool = True) -> LogReview:
    """Return the verdict on a log.

    ``learn`` tells whether to watch the log with a profile learned from its begin, which takes seconds.
    """
    facts, damage = read_facts(path)
    if learn:
        from replay.review.learning import learned

        facts = learned(path, facts)
    else:
        facts = replace(facts, lacks={**facts.lacks, "watch": "left out, as asked (--quick)"})
    return judged(path, facts, damage)


def judged(path: Path, facts: LogFacts, damage: Sequence[Damage] = ()) -> LogReview:
    """Return the verdict on the facts of a log."""
    found: list[tuple[Rule, Judgement]] = []
    watched: list[str] = []
    unjudged: dict[str, str] = {}
    for rule in RULES:
        reason = "".join(list(_lacking(rule, facts))[:1])
        if reason:
            unjudged[rule.title] = reason
            continue
        try:
            with np.errstate(invalid="ignore", divide="ignore"):
                judgements = list(rule.judge(facts, *(facts.signals[name] for name in rule.needs if name != "watch")))
        except UnjudgedError as error:
            unjudged[rule.title] = str(error)
            continue
        found += ((rule, judgement) for judgement in judgements)
        if not judgements:
            watched.append(rule.title)
    if facts.watch is not None:
        unjudged["A fault from take-off on"] = _taught(facts, facts.watch.until_s)
    return LogReview(path, facts, tuple(_ordered(found, facts)), tuple(watched), unjudged, tuple(damage))


def _taught(facts: LogFacts, until_s: float) -> str:
    """Return a note on the begin, learned as healthy, with the commands that reveal a motor weak from the begin."""
    said = f"a fault from before {until_s:.0f} s was learned as a property of the vehicle"
    motors = facts.signal("motors")
    if not motors:
        return said
    during = motors.values[facts.in_flight(motors.time_s) & (motors.time_s < until_s)]
    shares = zip(motors.names, 100.0 * during.mean(axis=0), strict=True) if len(during) else ()
    return f"{said}; mean commands until then: {', '.join(f'{name} {share:.0f} %' for name, share in shares)}"


def _lacking(rule: Rule, facts: LogFacts) -> Iterator[str]:
    if not facts.flight:
        yield "the log shows no flight"
    if rule.multirotor and facts.vehicle != "multirotor":
        kind = f"a {facts.vehicle}" if facts.vehicle else "not known to be one"
        yield f"for multirotors alone; the vehicle is {kind}"
    for name in rule.needs:
        if name == "watch" and facts.watch is not None:
            continue
        if name not in facts.signals:
            yield facts.lacks.get(name) or f"the log has no {SIGNALS[name]}"
        elif facts.signals[name].rate_hz < rule.least_hz:
            signal = facts.signals[name]
            yield f"{signal.origin} comes {signal.rate_hz:.2g} times a second; it takes {rule.least_hz:g} to tell"


def _ordered(found: Sequence[tuple[Rule, Judgement]], facts: LogFacts) -> Iterator[ReviewFinding]:
    """Yield findings by time; causes come first among findings that begin together."""
    by_time = sorted(found, key=lambda entry: entry[1].start_s)
    first = None
    heavy = [entry for entry in by_time if entry[1].weight != "information"]
    heavy = [entry for entry in heavy if entry[1].event] or heavy
    if heavy:
        same_s = _same_s(facts, heavy[0][0])
        together = [entry for entry in heavy if entry[1].start_s - heavy[0][1].start_s <= same_s]
        first = min(together, key=lambda entry: (STAGES.index(entry[0].stage), entry[1].start_s))
    for rule, judgement in by_time:
        rank: Literal["first", "later", "throughout", ""] = "later" if judgement.event else "throughout"
        if first is not None and judgement is first[1]:
            rank = "first"
        yield ReviewFinding(rule, judgement, "" if judgement.weight == "information" else rank)


def _same_s(facts: LogFacts, rule: Rule) -> float:
    """Return the time by which another finding may have begun earlier: two samples of the rule's signals."""
    slowest = max(
        (1.0 / max(facts.signals[name].rate_hz, 1e-9) for name in rule.needs if name != "watch"), default=_SAME_S
    )
    return min(2.0 * slowest, _SAME_S)


def _finding_json(finding: ReviewFinding) -> dict[str, Any]:
    judgement = finding.judgement
    return {
        "name": finding.rule.name,
        "stage": finding.rule.stage,
        "severity": judgement.weight,
        "confidence": judgement.confidence,
        "rank": finding.rank or None,
        "start_s": round(judgement.start_s, 3),
        "end_s": round(judgement.span[1], 3),
        "text": judgement.text,
        "evidence": list(judgement.evidence),
        "counter_evidence": list(finding.counter),
    }
