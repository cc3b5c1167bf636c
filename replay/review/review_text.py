"""The verdict on a log as lines for a terminal."""

from __future__ import annotations

from collections.abc import Iterator

from replay.review.review import LogReview

_MOST_STATED = 40
"""Entries of a time line that a screen holds beside the findings; the page and JSON have them all."""


def review_lines(review: LogReview) -> Iterator[str]:
    """Yield the verdict, the findings with their evidence, the time line, and what could not be judged."""
    facts = review.facts
    kind = " ".join(word for word in (facts.autopilot, facts.vehicle) if word) or "unknown vehicle"
    yield f"{review.log.name}: {kind}, {facts.duration_s:.0f} s, {facts.flight_text}"
    yield f"  {review.sentence}"
    explained: set[str] = set()
    for finding in review.findings:
        mark = finding.rank or finding.judgement.weight
        yield f"  [{mark}] {finding.judgement.start_s:.1f} s, {finding.rule.title} ({finding.judgement.confidence})"
        yield f"      {finding.judgement.text}"
        yield from (f"      evidence: {line}" for line in finding.judgement.evidence)
        # what holds of all findings of a rule is said once
        counter = finding.judgement.counter if finding.rule.name in explained else finding.counter
        explained.add(finding.rule.name)
        yield from (f"      looks alike: {line}" for line in counter)
    entries = review.timeline()
    if entries:
        yield "  time line:"
        yield from (f"    {at:8.1f} s  {kind}: {text}" for at, kind, text in entries[:_MOST_STATED])
        if len(entries) > _MOST_STATED:
            yield f"    ... and {len(entries) - _MOST_STATED} more"
    if review.watched:
        yield f"  looked for and not there: {', '.join(review.watched)}"
    yield from (f"  not judged: {titles}: {why}" for titles, why in review.reasons())
