"""The verdict on a log as one HTML page with its evidence drawn, which loads and runs nothing."""

from __future__ import annotations

from collections.abc import Iterator
from io import StringIO
from typing import TYPE_CHECKING

import numpy as np

from monitor.bus.alarm_text import utc
from monitor.views.palette import LIGHT
from monitor.views.plot_style import WIDTH_IN
from replay.reports.plot import SVG_BINS, drawing, page_svg, style
from replay.reports.plot_panels import envelope
from replay.reports.report_html import Html, element, facts, page, section, table
from replay.review.facts.log_facts import LogSignal
from replay.review.review import LogReview

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_PANEL_IN = 1.3
"""Height of a panel in inches. Chosen by eye: three below each other fit on a screen."""
_BEFORE_S, _AFTER_S = 20.0, 15.0
"""Seconds drawn about a finding. Chosen: what led to it is longer than what came of it."""
_SPAN_ALPHA = 0.25
"""Chosen by eye."""


def review_page(review: LogReview) -> str:
    """Return the page."""
    first = review.first
    mark = first.judgement.weight if first is not None else "" if review.facts.flight else "unknown"
    said = review.facts
    kind = " ".join(word for word in (said.autopilot, said.vehicle) if word)
    return page(
        f"{review.log.name}: review",
        element("h1", f"{review.log.name}: what happened"),
        element("div", review.sentence, class_=f"verdict {mark}".strip()),
        element(
            "p",
            f"{utc(said.start_ns)} · {said.duration_s:.0f} s, {said.flight_s:.0f} s of flight · {kind}",
            class_="note",
        ),
        section("Findings", *_findings(review)),
        section("Time line", table(("s", "what", ""), _entries(review), numbers=[0])),
        section("What was looked for and not there", element("p", ", ".join(review.watched) or "Nothing.")),
        section("What could not be judged, and why", table(("finding", "why"), review.unjudged.items())),
        section("What could not be read", table(("file", "what"), _damage(review))) if review.damage else "",
        section(
            "The flight", _figure(review, ("height", "motors", "attitude", "battery"), 0.0, said.duration_s, "flight")
        ),
    )


def _findings(review: LogReview) -> Iterator[Html]:
    if not review.findings:
        yield element("p", "Nothing: what is listed below was looked for and is not there.")
    for number, one in enumerate(review.findings):
        said = one.judgement
        yield element(
            "article",
            element(
                "h3", (f"{one.rank.capitalize()}: " if one.rank else "") + f"{said.start_s:.1f} s: {one.rule.title}"
            ),
            element("p", said.text[0].upper() + said.text[1:] + "."),
            facts(
                [
                    ("how sure", said.confidence),
                    ("where", one.rule.stage),
                    *(("evidence", line) for line in said.evidence),
                    *(("against other causes", line) for line in said.counter),
                    ("physics", one.rule.physics),
                ]
            ),
            _figure(
                review, said.plots, said.start_s - _BEFORE_S, said.start_s + _AFTER_S, f"finding{number}", said.start_s
            ),
            class_=said.weight if said.weight != "information" else "",
        )


def _entries(review: LogReview) -> Iterator[tuple[str, str, object]]:
    for at, kind, text in review.timeline():
        yield f"{at:.1f}", kind, element("strong", text) if kind == "finding" else text


def _damage(review: LogReview) -> Iterator[tuple[str, str]]:
    return ((one.file, "; ".join(one.found)) for one in review.damage)


def _figure(
    review: LogReview, names: tuple[str, ...], start_s: float, end_s: float, salt: str, at_s: float | None = None
) -> Html:
    """Return the signals of some names between two times, a panel each."""
    start_s, end_s = max(start_s, 0.0), min(end_s, review.facts.duration_s)
    known = [(name, review.facts.signals[name]) for name in names if name in review.facts.signals]
    shown = [(name, part) for name, whole in known if len((part := whole.during(start_s, end_s)).time_s)]
    if not shown:
        return element("p", "The log holds nothing to draw of it.", class_="note")
    from matplotlib.figure import Figure

    buffer = StringIO()
    with drawing({**style(LIGHT), "svg.fonttype": "none", "svg.hashsalt": salt}):
        figure = Figure(figsize=(WIDTH_IN, _PANEL_IN * len(shown) + 0.3), layout="constrained")
        panels = figure.subplots(len(shown), 1, sharex=True, squeeze=False)[:, 0]
        for panel, (name, part) in zip(panels, shown, strict=True):
            _draw(panel, name, part)
            if at_s is not None:
                panel.axvline(at_s, color=LIGHT.severity["critical"], linewidth=0.8, linestyle="--")
        panels[-1].set_xlabel("seconds since the log's begin")
        figure.savefig(
            buffer, format="svg", transparent=True, metadata=dict.fromkeys(("Creator", "Date", "Format", "Type"))
        )
    alone = element("div", Html(page_svg(buffer.getvalue())), class_="picture", role="img", aria_label=", ".join(names))
    return element("figure", alone)


def _draw(panel: Axes, name: str, part: LogSignal) -> None:
    for column, label in enumerate(part.names):
        times, values = envelope(part.time_s, part.values[:, column], np.zeros(len(part.time_s), np.bool_), SVG_BINS)
        panel.plot(times, values, color=LIGHT.series[column % len(LIGHT.series)], label=label)
    unit = f", {part.unit}" if part.unit else ""
    panel.set_title(f"{name.replace('_', ' ')}{unit} ({part.origin})", loc="left", fontsize=8)
    if len(part.names) > 1:
        panel.legend(loc="upper right", ncols=len(part.names), fontsize=7)
