"""Charts of a run for a page: series thinned to what a screen shows, as data that ``report.js`` draws."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from monitor.trace import AlarmSpan, Trace, alarm_spans
from monitor.views.panels import RunView, evidence, fault_limits, in_display_units
from replay.reports.plot_panels import DOUBT_DEVIATIONS, held, kept_rows, unwatched, usual_range, usual_size
from replay.reports.report_html import Html, element

BINS = 700
"""Chosen: a chart is 600 to 900 pixels wide; each bin is two points, 15 bytes of the page for each series."""
LEAST_BINS = 60
"""Chosen: of ten series in one chart, nobody follows one in more."""
_DIGITS = 4
"""Chosen: a chart of 250 pixels shows three."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Chart:
    """One chart: a title, and what ``report.js`` draws."""

    title: str
    content: dict[str, Any]


class Charts:
    """The charts of one page, in the order in which they were added; each is drawn where its element is.

    ``run`` is the run that charts of observers and their channels are of, with sizes in the profile's units.
    """

    def __init__(self, run: RunView | None = None) -> None:
        self._run = in_display_units(run or RunView((), (), {}))
        self._contents: list[dict[str, Any]] = []

    def add(self, chart: Chart) -> Html:
        """Add a chart; return the element in which it is drawn."""
        self._contents.append(chart.content)
        place = element("div", data_chart=str(len(self._contents) - 1), role="img", aria_label=chart.title)
        return element("figure", element("figcaption", chart.title), place)

    def add_fault(self, observer: str, channel: str) -> Html:
        """Add the chart of a fault channel."""
        return self.add(fault_chart(self._run, self._trace(observer), channel))

    def add_observer(self, observer: str) -> Iterator[Html]:
        """Add all of an observer."""
        for chart in observer_charts(self._run, self._trace(observer)):
            yield self.add(chart)

    def _trace(self, observer: str) -> Trace:
        return next(trace for trace in self._run.traces if trace.layout.observer == observer)

    def to_json(self) -> str:
        """Return the charts as JSON that ends no element of a page."""
        text = json.dumps(self._contents, separators=(",", ":"), allow_nan=False)
        return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")


def origin_ns(traces: Sequence[Trace]) -> int:
    """Return the vehicle's time of a run's first sample, the zero of all its charts; 0 where there is none."""
    return min((int(trace.vehicle_ns[0]) for trace in traces if len(trace.vehicle_ns)), default=0)


def fault_chart(run: RunView, trace: Trace, channel: str) -> Chart:
    """Return the chart of one fault channel: its estimate with uncertainty, threshold, truth, and its alarms.

    The run and its trace are in the units that people say.
    """
    layout, zero_ns = trace.layout, origin_ns(run.traces)
    key, place = (layout.observer, channel), layout.faults.index(channel)
    estimate = trace.isolated[:, place]
    series = [("estimate", "estimate", estimate)]
    threshold = run.thresholds.get(key)
    if key not in run.without_sd:
        sd = np.where(trace.armed & held(trace, estimate), DOUBT_DEVIATIONS * trace.sd[:, place], np.nan)
        series += [("", "low", estimate - sd), ("", "high", estimate + sd)]
    else:
        threshold = None
    if channel in run.truth:
        times_s, sizes = run.truth[channel]
        known = np.interp(trace.vehicle_ns / 1e9, times_s, sizes, np.nan, np.nan)
        series.append(("truth", "truth", known))
    content = _content(trace, zero_ns, series) | {
        "unit": layout.fault_units[place],
        "limits": [_short(end) for end in fault_limits(trace, [place], run.thresholds, run.truth)],
        "threshold": None if threshold is None else _short(threshold),
        "spans": _spans(run, zero_ns, lambda span: (span.observer, span.channel) == key),
    }
    return Chart(channel, content)


def observer_charts(run: RunView, trace: Trace) -> Iterator[Chart]:
    """Yield all of an observer: channels over their thresholds, residuals over their usual size, inputs."""
    layout, zero_ns = trace.layout, origin_ns(run.traces)
    faults = [
        (name, trace.isolated[:, place] / threshold)
        for place, name in enumerate(layout.faults)
        if (threshold := run.thresholds.get((layout.observer, name)))
    ]
    residuals = [
        (name, trace.residual[:, place] / (usual_size(evidence(trace, trace.residual[:, place])) or 1.0))
        for place, name in enumerate(layout.outputs)
    ]
    inputs = []
    for place, name in enumerate(layout.inputs):
        low, high = usual_range(evidence(trace, trace.u[:, place]))
        inputs.append((name, (trace.u[:, place] - low) / ((high - low) or 1.0)))
    spans = _spans(run, zero_ns, lambda span: span.observer == layout.observer)
    for title, unit, limits, named in (
        ("channels", "of the threshold", _around(faults, 1.5), faults),
        ("residuals", "of the usual size", [-3.0, 3.0], residuals),
        ("inputs", "of the usual range", [-0.2, 1.2], inputs),
    ):
        if named:
            series = [("line", name, values) for name, values in named]
            yield Chart(title, _content(trace, zero_ns, series) | {"unit": unit, "limits": limits, "spans": spans})


def signal_chart(title: str, times_s: Floats, columns: Floats, names: Sequence[str], unit: str) -> Chart:
    """Return the chart of k series of a log (n, k); add ``spans`` and ``marks`` to its content."""
    steady = np.zeros(len(times_s), np.bool_)
    kept = [kept_rows(column, steady, max(LEAST_BINS, BINS // len(names))) for column in columns.T]
    rows = np.unique(np.concatenate(kept))
    series = [
        {"kind": "line" if len(names) > 1 else "estimate", "name": name, "y": [_short(value) for value in column[rows]]}
        for name, column in zip(names, columns.T, strict=True)
    ]
    content = {"x": [round(float(time), 3) for time in times_s[rows]], "series": series, "unit": unit, "limits": None}
    return Chart(title, content | {"spans": [], "unwatched": [], "marks": []})


def _content(trace: Trace, zero_ns: int, series: Sequence[tuple[str, str, NDArray[np.float64]]]) -> dict[str, Any]:
    each = max(LEAST_BINS, BINS // len(series))
    drawn = [values for kind, _, values in series if kind]
    rows = np.unique(np.concatenate([kept_rows(values, trace.restart, each) for values in drawn]))
    # lines break where the observer started afresh
    breaks = np.flatnonzero(trace.restart[rows] & (rows > 0))
    times = np.insert(
        (trace.vehicle_ns[rows] - zero_ns) / 1e9, breaks, (trace.vehicle_ns[rows[breaks]] - zero_ns) / 1e9
    )
    columns = [np.insert(values[rows], breaks, np.nan) for _, _, values in series]
    return {
        "x": [round(float(time), 3) for time in times],
        "series": [
            {"kind": kind, "name": name, "y": [_short(value) for value in column]}
            for (kind, name, _), column in zip(series, columns, strict=True)
        ],
        "unwatched": [
            [round(start_s, 2), round(end_s, 2)]
            for start_s, end_s in unwatched(trace, zero_ns, float((trace.vehicle_ns[-1] - zero_ns) / 1e9))
        ],
    }


def _spans(run: RunView, zero_ns: int, concerns: Callable[[AlarmSpan], bool]) -> list[dict[str, Any]]:
    return [
        {
            "from": round((span.start_vehicle_ns - zero_ns) / 1e9, 2),
            "to": None if span.end_vehicle_ns is None else round((span.end_vehicle_ns - zero_ns) / 1e9, 2),
            "severity": span.severity,
        }
        for span in alarm_spans(run.events)
        if concerns(span)
    ]


def _around(named: Sequence[tuple[str, NDArray[np.float64]]], least: float) -> list[float]:
    """Return the ends of an axis that holds most of what is drawn."""
    largest = max((usual_size(values[np.isfinite(values)]) for _, values in named), default=0.0)
    return [-max(least, largest), max(least, largest)]


def _short(value: float) -> float | None:
    return float(f"{value:.{_DIGITS}g}") if np.isfinite(value) else None
