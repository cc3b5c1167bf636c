"""The verdict on a log as one HTML page with charts of its evidence, which loads nothing."""

from collections.abc import Iterator

from monitor.bus.alarm_text import utc
from replay.reports.charts import Charts, signal_chart
from replay.reports.report_html import Html, element, facts, joined_html, page, section, table
from replay.review.review import LogReview

_BEFORE_S, _AFTER_S = 20.0, 15.0
"""Time that is drawn before and after a finding, seconds. Chosen: its causes take longer than its consequences."""

_FIRST_DRONE_NS = 10**18
"""September 2001: an earlier date counts from a boot without a clock."""

_OVERVIEW = ("height", "motors", "attitude", "battery")
"""Signals that show a whole flight at a glance."""


def review_page(review: LogReview) -> str:
    """Return the page."""
    charts = Charts()
    mark = review.severity if review.first is not None else "" if review.facts.flight else "unknown"
    said = review.facts
    kind = " ".join(word for word in (said.autopilot, said.vehicle) if word)
    begun = utc(said.start_ns) if said.start_ns > _FIRST_DRONE_NS else "date not recorded"
    entries = [
        (f"{at:.1f}", kind, element("strong", text) if kind == "finding" else text)
        for at, kind, text in review.timeline()
    ]
    damage = [(part.file, "; ".join(part.found)) for part in review.damage]
    return page(
        f"{review.log.name}: review",
        element("h1", f"{review.log.name}: what happened"),
        element("div", review.sentence, class_=f"verdict {mark}".strip()),
        element("p", f"{begun} · {said.duration_s:.0f} s, {said.flight_text} · {kind}", class_="note"),
        section("Findings", *_findings(review, charts)),
        section("Time line", table(("s", "kind", "what"), entries, numbers=[0])),
        section("Looked for, not found", element("p", ", ".join(review.watched) or "Nothing.")),
        section("What could not be judged, and why", table(("findings", "why"), review.reasons())),
        section("What could not be read", table(("file", "what"), damage)) if review.damage else "",
        section("The flight", _signals(review, charts, _OVERVIEW, 0.0, said.duration_s)),
        charts=charts.to_json(),
    )


def _findings(review: LogReview, charts: Charts) -> Iterator[Html]:
    if not review.findings:
        why = "everything listed below was looked for and not found" if review.facts.flight else "no flight was judged"
        yield element("p", f"Nothing: {why}.")
    for finding in review.findings:
        said = finding.judgement
        # a condition of the whole flight is drawn over the whole log
        window = said.start_s - _BEFORE_S, said.start_s + _AFTER_S
        start_s, end_s = window if said.event else (0.0, review.facts.duration_s)
        yield element(
            "article",
            element("h3", f"{(finding.rank or said.weight).capitalize()}: {said.start_s:.1f} s: {finding.rule.title}"),
            element("p", said.text[0].upper() + said.text[1:] + "."),
            facts(
                [
                    ("how sure", said.confidence),
                    ("stage", finding.rule.stage),
                    *(("evidence", line) for line in said.evidence),
                    *(("other causes", line) for line in finding.counter),
                    ("physics", finding.rule.physics),
                ]
            ),
            _signals(review, charts, (*said.plots, *finding.rule.plots), start_s, end_s, said.start_s),
            class_=said.weight if said.weight != "information" else "",
        )


def _signals(
    review: LogReview, charts: Charts, names: tuple[str, ...], start_s: float, end_s: float, at_s: float | None = None
) -> Html:
    """Return charts of the named signals between two times, one below the other."""
    start_s, end_s = max(start_s, 0.0), min(end_s, review.facts.duration_s)
    shown = [(name, part) for name in names if (part := review.facts.signal(name).during(start_s, end_s))]
    if not shown:
        return element("p", "The log holds nothing to draw of it.", class_="note")
    drawn = []
    for name, part in shown:
        title = f"{name.replace('_', ' ')} ({part.origin})"
        # a turn about the vertical is no finding, and its scale hides roll and pitch
        columns = [k for k, column in enumerate(part.names) if column != "yaw"]
        labels = [part.names[k] for k in columns]
        chart = signal_chart(title, part.time_s, part.values[:, columns], labels, part.unit)
        chart.content["marks"] = [] if at_s is None else [[round(at_s, 3), ""]]
        chart.content["window"] = [round(start_s, 3), round(end_s, 3)]
        drawn.append(charts.add(chart))
    return joined_html(drawn)
