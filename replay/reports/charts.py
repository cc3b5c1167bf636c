"""Charts of a run: series thinned to the resolution of a screen, as data that ``report.js`` and :mod:`.plot` draw."""

import json
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from monitor.trace import AlarmSpan, Trace, alarm_spans
from monitor.views.panels import RunView, evidence, fault_limits, in_display_units
from replay.reports.recording_facts import GAP_PERIODS, GAP_S
from replay.reports.report_html import Html, element

BINS = 700
"""Bins of a series. Chosen: a chart is 600 to 900 pixels wide; each bin is two points, 15 bytes of the page."""
DOUBT_DEVIATIONS = 2.0
"""Standard deviations that are shaded around an estimate: a band of two contains 95 % of the values."""
USUAL_PERCENT = 99.5
"""Share of the residuals that their scale contains. Chosen: it leaves out the jumps of a fault, which would flatten the
rest."""
LEAST_BINS = 60
"""Fewest bins of a series. Chosen: nobody follows more in one of ten series of a chart."""
_HELD_S = 0.5
"""Time around an isolated fault, in seconds, for which its uncertainty is shown, too. Chosen by eye."""
_ROUNDING = 1e-9
"""A residual below this share of its measurement is zero: the estimates explain every measurement."""
_DIGITS = 4
"""Digits of a chart's numbers. Chosen: a chart of 250 pixels shows three."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Chart:
    """One chart: a title, and its content."""

    title: str
    content: dict[str, Any]


class Charts:
    """The charts of one page, in the order in which they were added; each is drawn in its own element.

    ``run`` is the run of the charts of observers and channels, with sizes in the profile's units.
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
        """Add all charts of an observer."""
        for chart in observer_charts(self._run, self._trace(observer)):
            yield self.add(chart)

    def _trace(self, observer: str) -> Trace:
        return next(trace for trace in self._run.traces if trace.layout.observer == observer)

    def to_json(self) -> str:
        """Return the charts as JSON that cannot close an element of the page."""
        text = json.dumps(self._contents, separators=(",", ":"), allow_nan=False)
        return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")


def origin_ns(traces: Sequence[Trace]) -> int:
    """Return the vehicle's time of a run's first sample, the zero of all its charts; 0 if there is no sample."""
    return min((int(trace.vehicle_ns[0]) for trace in traces if len(trace.vehicle_ns)), default=0)


def fault_chart(run: RunView, trace: Trace, channel: str, scale: Sequence[int] = (), bins: int = BINS) -> Chart:
    """Return the chart of one fault channel: its estimate with uncertainty, threshold, truth, and its alarms.

    The run and its trace are in the units that people use. The axis has the range that the channels at ``scale`` need,
    by default this one.
    """
    layout = trace.layout
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
    content = _content(run, trace, series, bins) | {
        "unit": layout.fault_units[place],
        "limits": [_short(end) for end in fault_limits(trace, scale or [place], run.thresholds, run.truth)],
        "threshold": None if threshold is None else _short(threshold),
        "spans": _spans(run, lambda span: (span.observer, span.channel) == key),
    }
    return Chart(channel, content)


def observer_charts(
    run: RunView, trace: Trace, channels: Collection[str] | None = None, bins: int = BINS
) -> Iterator[Chart]:
    """Yield all charts of an observer: channels over their thresholds, residuals over their usual size, inputs.

    After each name comes the value of one of the chart's units. ``channels`` are the ones to show; None: all. Residuals
    that are only rounding errors are left out.
    """
    layout = trace.layout
    faults, residuals, inputs = [], [], []
    for name, estimate in zip(layout.faults, trace.isolated.T, strict=True):
        if (threshold := run.thresholds.get((layout.observer, name))) and (channels is None or name in channels):
            watched = evidence(trace, estimate / threshold)
            peak = f"{100.0 * np.max(np.abs(watched)):.0f} %" if len(watched) else ""
            faults.append((name, estimate / threshold, peak))
    for name, residual, measured in zip(layout.outputs, trace.residual.T, trace.y.T, strict=True):
        usual = usual_size(evidence(trace, residual))
        if usual > _ROUNDING * usual_size(evidence(trace, measured)):
            residuals.append((name, residual / usual, f"±{usual:.2g}"))
    for name, command in zip(layout.inputs, trace.u.T, strict=True):
        low, high = usual_range(evidence(trace, command))
        said = f"{low:.2g} … {high:.2g}".replace("-", "\N{MINUS SIGN}")
        # a constant command lies in the middle of its lane, where it is visible
        inputs.append((name, (command - low) / (high - low) if high > low else 0.5 + command - low, said))
    # alarms of no observer, such as lost telemetry, concern all observers
    others = {other.layout.observer for other in run.traces} - {layout.observer}
    spans = _spans(run, lambda span: span.observer not in others)
    for title, unit, limits, named in (
        ("channels", "of the threshold", _around([values for _, values, _ in faults], 1.5), faults),
        ("residuals", "of the usual size", [-3.0, 3.0], residuals),
        ("inputs", "of the usual range", [-0.2, 1.2], inputs),
    ):
        if named:
            content = _content(run, trace, [("line", name, values) for name, values, _ in named], bins)
            for one, (_, _, said) in zip(content["series"], named, strict=True):
                one["of"] = said
            yield Chart(title, content | {"unit": unit, "limits": limits, "spans": spans})


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


def _content(
    run: RunView, trace: Trace, series: Sequence[tuple[str, str, NDArray[np.float64]]], bins: int
) -> dict[str, Any]:
    zero_ns, each = origin_ns(run.traces), max(LEAST_BINS, bins // len(series))
    drawn = [values for kind, _, values in series if kind]
    rows = np.unique(np.concatenate([kept_rows(values, trace.restart, each) for values in drawn]))
    # lines are interrupted where the observer restarted
    breaks = np.flatnonzero(trace.restart[rows] & (rows > 0))
    times_s = (trace.vehicle_ns[rows] - zero_ns) / 1e9
    columns = [np.insert(values[rows], breaks, np.nan) for _, _, values in series]
    return {
        "x": [round(float(time), 3) for time in np.insert(times_s, breaks, times_s[breaks])],
        "series": [
            {"kind": kind, "name": name, "y": [_short(value) for value in column]}
            for (kind, name, _), column in zip(series, columns, strict=True)
        ],
        "unwatched": [
            [round(start_s, 2), round(end_s, 2)] for start_s, end_s in unwatched(trace, zero_ns, end_s(run.traces))
        ],
    }


def end_s(traces: Sequence[Trace]) -> float:
    """Return the end of a run, counted from its first sample."""
    last_ns = max((int(trace.vehicle_ns[-1]) for trace in traces if len(trace.vehicle_ns)), default=0)
    return (last_ns - origin_ns(traces)) / 1e9


def _spans(run: RunView, concerns: Callable[[AlarmSpan], bool]) -> list[dict[str, Any]]:
    zero_ns = origin_ns(run.traces)
    return [
        {
            "from": round((span.start_vehicle_ns - zero_ns) / 1e9, 2),
            "to": None if span.end_vehicle_ns is None else round((span.end_vehicle_ns - zero_ns) / 1e9, 2),
            "severity": span.severity,
            "channel": span.channel,
        }
        for span in alarm_spans(run.events)
        if concerns(span)
    ]


def _around(drawn: Sequence[NDArray[np.float64]], least: float) -> list[float]:
    """Return the ends of an axis that contains most of the drawn values."""
    largest = max((usual_size(values[np.isfinite(values)]) for values in drawn), default=0.0)
    return [-max(least, largest), max(least, largest)]


def _short(value: float) -> float | None:
    return float(f"{value:.{_DIGITS}g}") if np.isfinite(value) else None


def kept_rows(values: NDArray[np.float64], restart: NDArray[np.bool_], bins: int) -> NDArray[np.intp]:
    """Return the samples that draw the same line as all N: the smallest and the largest of each bin, in order.

    The first sample after a restart of the observer is kept, too.
    """
    size = -(-len(values) // bins)
    edges = np.union1d(np.flatnonzero(restart), [0, len(values)]).astype(np.intp)
    parts = [np.empty(0, np.intp)]
    for start, stop in pairwise(edges):
        if size > 2 and stop - start > 2 * size:
            parts.append(np.append(start, _extremes(values[start:stop], size) + start))
        else:
            parts.append(np.arange(start, stop))
    return np.unique(np.concatenate(parts))


def _extremes(values: NDArray[np.float64], size: int) -> NDArray[np.intp]:
    """Return the indices of the smallest and the largest value of each run of ``size`` samples, in order."""
    whole = len(values) // size * size
    rest = np.arange(whole, len(values))
    runs = values[:whole].reshape(-1, size)
    runs = np.where(np.isnan(runs), 0.0, runs)
    both = np.sort(np.stack((runs.argmin(axis=1), runs.argmax(axis=1)), axis=1), axis=1)
    picked = (both + np.arange(0, whole, size)[:, None]).ravel()
    if len(rest):
        last = np.where(np.isnan(values[rest]), 0.0, values[rest])
        picked = np.append(picked, whole + np.sort([last.argmin(), last.argmax()]))
    return picked


def unwatched(trace: Trace, origin_ns: int, end_s: float) -> list[tuple[float, float]]:
    """Return the spans (s) in which an observer could raise no alarm, including the gaps between its samples."""
    times_s = (trace.vehicle_ns - origin_ns) / 1e9
    steps_s = np.diff(times_s)
    usual_s = float(np.median(steps_s)) if len(steps_s) else 0.0
    gap = steps_s > max(GAP_S, GAP_PERIODS * usual_s)
    goes_on = trace.armed[:-1] & trace.armed[1:] & ~gap
    first = trace.armed & ~np.append(False, goes_on)
    last = trace.armed & ~np.append(goes_on, False)
    starts_s, stops_s = np.append(0.0, times_s[last]), np.append(times_s[first], end_s)
    return [
        (float(start_s), float(stop_s))
        for start_s, stop_s in zip(starts_s, stops_s, strict=True)
        if stop_s - start_s > 1.5 * usual_s
    ]


def held(trace: Trace, estimate: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return the samples at which, or shortly before or after which, a channel is held responsible: no flicker."""
    held_ns = trace.vehicle_ns[estimate != 0.0]
    if not len(held_ns):
        return np.zeros(len(estimate), np.bool_)
    after = np.searchsorted(held_ns, trace.vehicle_ns)
    since_ns = trace.vehicle_ns - held_ns[np.maximum(after - 1, 0)]
    until_ns = held_ns[np.minimum(after, len(held_ns) - 1)] - trace.vehicle_ns
    near_ns = np.minimum(np.abs(since_ns), np.abs(until_ns))
    return np.asarray(near_ns <= 1e9 * _HELD_S)


def usual_size(values: NDArray[np.float64]) -> float:
    """Return the size that most values do not exceed, 0 if there are no values."""
    return float(np.percentile(np.abs(values), USUAL_PERCENT)) if len(values) else 0.0


def usual_range(values: NDArray[np.float64]) -> tuple[float, float]:
    """Return the range that contains most values."""
    if not len(values):
        return 0.0, 0.0
    low, high = np.percentile(values, (100.0 - USUAL_PERCENT, USUAL_PERCENT))
    return float(low), float(high)
