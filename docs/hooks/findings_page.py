"""The table of what a review looks for, from its rules."""

from __future__ import annotations

from markup import table

from replay.review.facts.log_facts import SIGNALS
from replay.review.rules import RULES


def findings_page() -> str:
    """Return the page of findings, in the order of causes as the code has them."""
    rows = (
        (
            f"**{rule.title}** `{rule.name}`",
            rule.stage,
            rule.physics,
            rule.evidence,
            "; ".join(rule.counter),
            "; ".join(SIGNALS[name] for name in rule.needs),
        )
        for rule in RULES
    )
    heads = ("finding", "stage", "physics", "evidence", "what else looks so, and why it is not that", "needs")
    return "\n".join(
        [
            "# Findings of a review",
            "",
            "What `fauio review` looks for, and [how it judges](../review.md). The rules: `replay/review/findings`.",
            "",
            table(heads, rows),
            "",
        ]
    )
