"""The flight of a run as its log states it: the way on the ground, height, modes, and what the autopilot said."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from monitor.bus.alarm_text import utc
from monitor.trace import AlarmSpan
from replay.reports.charts import BINS, Chart, Charts, signal_chart
from replay.reports.report_html import Html, element, folded, joined_html, table
from replay.review.facts.log_facts import LogFacts, LogSignal

_MAP_PX = 640
"""Units of the map's own, a side; it is drawn as wide as the page. Chosen: then one is about a pixel."""
_MARGIN_PX = 24
"""Chosen by eye."""
_LEAST_M = 20.0
"""Chosen: a hover drawn larger would show the receiver's noise as a way."""
_MOST_LINES = 200
"""Chosen: some pages of text; a log that says more is read with other tools."""
_BARS = (1.0, 2.0, 5.0)
"""Lengths of the bar that shows the scale, times powers of ten: round ones."""


def flight_parts(facts: LogFacts, alarms: Sequence[AlarmSpan], charts: Charts, zero_s: float) -> Iterator[Html]:
    """Yield a map of the way, a chart of height with modes, and a table of what was said.

    ``zero_s`` is the zero of the charts' time, in seconds since the log's begin.
    """
    spans = [
        (
            (alarm.start_ns - facts.start_ns) / 1e9,
            facts.duration_s if alarm.end_ns is None else (alarm.end_ns - facts.start_ns) / 1e9,
            alarm.severity,
        )
        for alarm in alarms
    ]
    way = facts.signals.get("position")
    if way is not None and len(way.time_s) > 1:
        yield _map(way, spans)
    height = facts.signals.get("height_estimate") or facts.signals.get("height")
    if height is not None and len(height.time_s) > 1:
        yield charts.add(_height_chart(height, facts, spans, zero_s))
    said = [statement for statement in facts.statements if statement.kind in ("mode", "text", "failsafe", "arming")]
    if said:
        rows = [
            (utc(facts.start_ns + round(1e9 * statement.time_s))[11:23], statement.kind, statement.text)
            for statement in said[:_MOST_LINES]
        ]
        more = len(said) - len(rows)
        words = f"What the log says, {len(said)} lines" + (f", the first {len(rows)}" if more else "")
        yield folded(words, table(("time", "kind", "text"), rows))


def _height_chart(
    height: LogSignal, facts: LogFacts, spans: Sequence[tuple[float, float, str]], zero_s: float
) -> Chart:
    chart = signal_chart("height, and flight modes", height.time_s - zero_s, height.values[:, :1], ["height"], "m")
    chart.content["spans"] = [
        {"from": round(start - zero_s, 2), "to": round(end - zero_s, 2), "severity": severity}
        for start, end, severity in spans
    ]
    modes = [statement for statement in facts.statements if statement.kind == "mode"]
    chart.content["marks"] = [[round(mode.time_s - zero_s, 2), mode.text] for mode in modes[:_MOST_LINES]]
    return chart


def _map(way: LogSignal, spans: Sequence[tuple[float, float, str]]) -> Html:
    """Return the way seen from above, north up, with the stretches of alarms over it."""
    places = way.values[:, :2]
    known = np.isfinite(places).all(axis=1)
    times_s, places = way.time_s[known], places[known]
    if len(places) < 2:
        return Html("")
    middle = (places.max(axis=0) + places.min(axis=0)) / 2.0
    size_m = max(float(np.ptp(places, axis=0).max()), _LEAST_M)
    scale = (_MAP_PX - 2 * _MARGIN_PX) / size_m
    x = _MAP_PX / 2 + scale * (places[:, 1] - middle[1])
    y = _MAP_PX / 2 - scale * (places[:, 0] - middle[0])
    lines = [_line(x, y, "way")]
    for start_s, end_s, severity in spans:
        first, last = np.searchsorted(times_s, (start_s, end_s))
        lines.append(_line(x[first : last + 1], y[first : last + 1], f"way {severity}"))
    bar_m = max(base * 10.0**power for power in range(-1, 7) for base in _BARS if base * 10.0**power <= size_m / 3.0)
    bar = f'<path class="bar" d="M{_MARGIN_PX} {_MAP_PX - 12}h{bar_m * scale:.1f}"/>'
    words = f'<text x="{_MARGIN_PX}" y="{_MAP_PX - 18}">{bar_m:g} m, north is up</text>'
    begin = f'<circle cx="{x[0]:.1f}" cy="{y[0]:.1f}" r="5"/>'
    drawn = joined_html([*lines, Html(begin), Html(bar), Html(words)])
    svg = element("svg", drawn, viewBox=f"0 0 {_MAP_PX} {_MAP_PX}", role="img", aria_label="the way seen from above")
    return element("figure", element("figcaption", "the way, from the circle on; stretches with alarms are thick"), svg)


def _line(x: NDArray[np.float64], y: NDArray[np.float64], name: str) -> Html:
    step = max(1, len(x) // (2 * BINS))
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x[::step], y[::step], strict=True))
    return Html(f'<polyline class="{name}" points="{points}"/>')
