"""`fauio review`: find out what happened in a log, without a profile."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from adapters.command_line import option, remark, say, say_json
from replay.runs.replay_command import LOG_HELP

if TYPE_CHECKING:
    from replay.review.review import LogReview

_STATUS = {"information": 0, "warning": 1, "critical": 5}
"""Exit status by the severity of what was found: 1 as of linters; 2 to 4 have their meaning for all commands."""


def add_review(subparsers: Any) -> None:
    """Add the command to the command line."""
    parser = subparsers.add_parser(
        "review",
        help="find out what happened in a log, without a profile",
        description="Report what happened in a log: the first step in the chain of decision, commands, motors, "
        "motion and estimator that went wrong, its evidence, evidence against other causes, and what could not be "
        "judged. Exit status: 0 nothing wrong found, 1 a warning is the worst finding, 2 bad input, 5 a finding is "
        "critical; of several logs that of the worst.",
        epilog="example: fauio review --quick healthy.tlog --report healthy.html",
    )
    option(parser, "logs LOG", LOG_HELP, Path, nargs="+")
    option(parser, "--report OUT.html", "write a page with charts of the evidence; for several logs a folder")
    option(parser, "--quick", "use the rules only: do not learn the vehicle from the first 40 s of the flight")
    option(parser, "--json", "print one JSON object per log")
    parser.set_defaults(handler=run_review)


def run_review(args: argparse.Namespace) -> int:
    """Run ``fauio review``."""
    from adapters.errors import TelemetryError
    from adapters.output_file import write_file
    from replay.review.review import review_log
    from replay.runs.log_list import check_outputs, find_logs, target

    logs = find_logs(args.logs)
    many = len(logs) > 1 or logs[0].path != args.logs[0]
    pages = [target("--report", args.report, log, ".html", many=many) for log in logs]
    wanted = [page for page in pages if page is not None]
    check_outputs(logs, wanted, f"--report {args.report}: names the same file for several logs; put {{log}} into it")
    failed, status = False, 0
    for log, report in zip(logs, pages, strict=True):
        try:
            review = review_log(log.path, learn=not args.quick)
        except TelemetryError as error:
            if not many:
                raise
            failed = True
            remark(str(error))
            continue
        remark(*(f"{damage.line()}; all else was read" for damage in review.damage))
        if report is not None:  # first: `fauio review ... | head` closes the output early
            from replay.review.review_page import review_page

            write_file(report, review_page(review))
        if args.json:
            say_json(review.to_json())
        else:
            say(*review_lines(review))
        status = max(status, _STATUS[review.severity])
    return 2 if failed else status


_MOST_STATED = 40
"""Entries of the time line that are printed: a screen holds them beside the findings. The page and JSON have them
all."""


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
        # other causes that the rule excludes for all of its findings are printed once
        counter = finding.judgement.counter if finding.rule.name in explained else finding.counter
        explained.add(finding.rule.name)
        yield from (f"      other causes: {line}" for line in counter)
    entries = review.timeline()
    if entries:
        yield "  time line:"
        yield from (f"    {at:8.1f} s  {kind}: {text}" for at, kind, text in entries[:_MOST_STATED])
        if len(entries) > _MOST_STATED:
            yield f"    ... and {len(entries) - _MOST_STATED} more"
    if review.watched:
        yield f"  looked for, not found: {', '.join(review.watched)}"
    yield from (f"  not judged: {titles}: {why}" for titles, why in review.reasons())
