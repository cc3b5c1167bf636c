"""The result of a run in one sentence, for readers of this sentence alone."""

from collections.abc import Sequence
from pathlib import Path

from adapters.errors import FauioError
from monitor.bus.alarm_text import utc
from monitor.display import doubt_text, fault_text
from replay.reports.findings import Finding
from replay.review.facts.log_facts import UNKNOWN_LEVEL, LogFacts, Statement
from replay.review.facts.reading import read_facts

WARNING_LEVEL = 4
"""Severity of a text up to which it is a warning or worse: MAV_SEVERITY_WARNING."""
AFTER_S = 10.0
"""Texts of the autopilot up to so many seconds after an alarm's end belong to it. Chosen: failsafes wait some seconds
before they act (PX4's COM_FAIL_ACT_T is 5 s)."""


def stated_facts(log: Path) -> LogFacts | None:
    """Return the statements of a log about the flight; None if it is not an autopilot's log, or is unreadable."""
    try:
        facts, _ = read_facts(log)
    except FauioError:
        return None
    return facts if facts.autopilot else None


def run_sentence(results: Sequence[Finding], facts: LogFacts | None) -> str:
    """Return a sentence about the most important alarm: the first one of the highest severity.

    ``facts`` are the statements of the log, None if it is not an autopilot's log.
    """
    worst = "critical" if any(result.alarm.severity == "critical" for result in results) else "warning"
    main = next(result for result in results if result.alarm.severity == worst)
    others = len(results) - 1
    more = f"; {others} other alarm{'s' if others > 1 else ''}" if others else ""
    return f"{main.message} {_when(main)}{_autopilot(main, facts)}{more}"


def alarm_summary(finding: Finding) -> str:
    """Return a line about one alarm: time, channel, severity, message, two standard deviations of its size, peak."""
    alarm, event = finding.alarm, finding.largest
    end = "to the end" if alarm.end_ns is None else f"to {utc(alarm.end_ns)[11:19]}"
    # a lost effect is not a fixed share of its estimate
    steady = finding.relative is not None and finding.effect is None
    share = (finding.relative or 0.0) / finding.size if steady and finding.size else None
    peak = max((event.peak for event in alarm.history if event.peak is not None), key=abs, default=None)
    doubt = []
    if finding.size is not None and finding.deviation is not None:
        doubt.append(f"± {doubt_text(2.0 * finding.deviation, event.unit, share)}")
    if peak is not None:
        doubt.append(f"peak {fault_text(alarm.channel, peak, None if share is None else peak * share, event.unit)}")
    channel = f"{alarm.observer}/{alarm.channel}"
    parts = (f"{utc(alarm.start_ns)[:19]}Z {end}", event.vehicle, channel, alarm.severity, finding.message)
    return "  ".join(parts) + (f" ({', '.join(doubt)})" if doubt else "")


def _when(finding: Finding) -> str:
    clock = utc(finding.alarm.start_ns)[11:19]
    if finding.alarm.end_vehicle_ns is None:
        return f"from {clock} to the end"
    return f"from {clock} on for {span_text((finding.alarm.end_vehicle_ns - finding.alarm.start_vehicle_ns) / 1e9)}"


def _autopilot(finding: Finding, facts: LogFacts | None) -> str:
    if facts is None:
        return ""
    if said := said_about(finding, facts):
        return f"; the autopilot said “{said[0].text}”"
    # silence of the autopilot means something only if the log has the severity of its texts
    severe = any(text.kind == "text" and text.level < UNKNOWN_LEVEL for text in facts.statements)
    return "; the autopilot said nothing" if severe else ""


def said_about(finding: Finding, facts: LogFacts) -> list[Statement]:
    """Return the autopilot's warnings and failsafes during an alarm, and shortly after it."""
    start_s = (finding.alarm.start_ns - facts.start_ns) / 1e9
    end_s = (
        facts.duration_s if finding.alarm.end_ns is None else (finding.alarm.end_ns - facts.start_ns) / 1e9 + AFTER_S
    )
    return [
        said
        for said in facts.statements
        if (said.kind == "failsafe" and said.level) or (said.kind == "text" and said.level <= WARNING_LEVEL)
        if start_s <= said.time_s <= end_s
    ]


def span_text(seconds: float) -> str:
    """Return a duration for people."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"
