"""A run as a Rerun recording that opens on what matters: faults with thresholds, alarms, residuals."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from monitor.event import AlarmEvent
from monitor.palette import BLACK, BLUE, GREY, SEVERITY, rgba, series_colour
from monitor.panels import Panels, Thresholds, Truth, choose_panels, fault_limits, same_scale
from monitor.trace import Trace

APPLICATION = "fauio"
BATCH_ROWS = 1 << 16
FLUSH_TIMEOUT_S = 30.0
FAULTS_BELOW = 4
QUIET_LIMITS = (-1.3, 1.3)

_LEVELS = {"warning": rr.TextLogLevel.WARN, "critical": rr.TextLogLevel.CRITICAL}


def write_rrd(
    path: str | os.PathLike[str],
    traces: Sequence[Trace],
    events: Sequence[AlarmEvent],
    thresholds: Thresholds,
    truth: Truth | None = None,
) -> None:
    """Write a run to an ``.rrd`` file with its blueprint inside.

    Time lines are ``vehicle_time`` (seconds of the vehicle's clock) and ``unix_time``. Entities per observer:
    ``<observer>/fault``, ``/residual``, ``/state``, ``/input`` and ``/output`` with one series per channel,
    ``/isolated/<channel>``, ``/threshold/<channel>``, ``/truth/<channel>``, and ``/quiet`` for the channels that share
    a view; alarms are states in ``alarms/<observer>/<channel>`` and lines of text in ``log``. No viewer is needed.
    The blueprint has a tab per observer.

    Parameters
    ----------
    path : str | PathLike
        File to write.
    traces : Sequence[Trace]
        One per observer.
    events : Sequence[AlarmEvent]
        All alarm events of the run.
    thresholds : Mapping[tuple[str, str], float]
        Alarm threshold by observer and fault channel.
    truth : Mapping[str, tuple[NDArray, NDArray]] | None
        By fault channel: times on the vehicle's clock (s) and the true size at them.
    """
    truth = truth or {}
    alarmed = {(event.observer, event.channel) for event in events}
    chosen = choose_panels([trace.layout for trace in traces], alarmed, truth, thresholds)
    tabs = [_observer_tab(*pair, thresholds, truth) for pair in zip(traces, chosen, strict=True)]
    recording = rr.RecordingStream(APPLICATION)
    try:
        recording.save(os.fspath(path), default_blueprint=_blueprint(tabs))
        for trace, panels in zip(traces, chosen, strict=True):
            _send_trace(recording, trace)
            _send_quiet(recording, trace, panels.together, thresholds)
            _send_thresholds(recording, trace, thresholds)
            _send_truth(recording, trace, truth)
        _send_alarms(recording, events)
        recording.flush(timeout_sec=FLUSH_TIMEOUT_S)
    finally:
        recording.disconnect()


def _blueprint(tabs: Sequence[rrb.Vertical]) -> rrb.Blueprint:
    """Return the layout of the viewer: a tab per observer above the alarms' states and texts."""
    alarms = rrb.Horizontal(
        rrb.StateTimelineView(origin="/alarms", name="alarms", time_view=_linked()),
        rrb.TextLogView(origin="/log", name="alarm events"),
        column_shares=[3, 2],
    )
    rows: list[Any] = [rrb.Tabs(*tabs), alarms] if tabs else [alarms]
    return rrb.Blueprint(
        rrb.Vertical(*rows, row_shares=[4, 1][: len(rows)]),
        rrb.TimePanel(timeline="vehicle_time", state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
    )


def _observer_tab(trace: Trace, panels: Panels, thresholds: Thresholds, truth: Truth) -> rrb.Vertical:
    """Return an observer's views, one below the other, faults scaled by what they were while alarms were armed."""
    layout = trace.layout
    root = rr.escape_entity_path_part(layout.observer)

    def view(name: str, *parts: str, limits: tuple[float, float] | None = None) -> rrb.TimeSeriesView:
        return rrb.TimeSeriesView(
            origin=f"/{root}",
            contents=[f"+ /{root}/{part}/**" for part in parts],
            name=f"{layout.observer} / {name}",
            axis_x=_linked(),
            axis_y=None if limits is None else rrb.ScalarAxis(range=limits),
        )

    faults = []
    for place in panels.alone:
        part = rr.escape_entity_path_part(layout.faults[place])
        limits = fault_limits(trace, same_scale(layout, panels, place), thresholds, truth)
        parts = (f"{group}/{part}" for group in ("isolated", "threshold", "truth"))
        faults.append(view(layout.faults[place], *parts, limits=limits))
    rows: list[Any] = []
    if faults:
        rows.append(rrb.Grid(*faults, grid_columns=-(-len(faults) // FAULTS_BELOW), name="faults"))
    if panels.together:
        rows.append(view("quiet channels, in units of their thresholds", "quiet", limits=QUIET_LIMITS))
    rows.append(view("residuals", "residual"))
    rows.append(rrb.Horizontal(view("inputs", "input"), view("outputs", "output")))
    shares = [min(len(faults), FAULTS_BELOW)] * bool(faults) + [1.5] * (len(rows) - bool(faults))
    return rrb.Vertical(*rows, row_shares=shares, name=layout.observer)


def _linked() -> rrb.TimeAxis:
    return rrb.TimeAxis(link=rrb.components.LinkAxis.LinkToGlobal)


def _send_trace(recording: rr.RecordingStream, trace: Trace) -> None:
    layout = trace.layout
    root = rr.escape_entity_path_part(layout.observer)
    shown = [f"{name} ({unit})" for name, unit in zip(layout.faults, layout.fault_units, strict=True)]
    groups = {
        "fault": (shown, trace.fault),
        "residual": (layout.outputs, trace.residual),
        "state": (layout.states, trace.x),
        "input": (layout.inputs, trace.u),
        "output": (layout.outputs, trace.y),
    }
    for group, (names, values) in groups.items():
        colours = [series_colour(index) for index in range(len(names))]
        _send_series(recording, trace, f"{root}/{group}", names, values, colours)
    for place, name in enumerate(layout.faults):
        entity = f"{root}/isolated/{rr.escape_entity_path_part(name)}"
        _send_series(recording, trace, entity, shown[place : place + 1], trace.isolated[:, place : place + 1], [BLUE])


def _send_quiet(recording: rr.RecordingStream, trace: Trace, places: Sequence[int], thresholds: Thresholds) -> None:
    """Send the channels that had no alarm, each in units of its own threshold, and the band they stayed in."""
    if not places:
        return
    names = [trace.layout.faults[place] for place in places]
    units = np.array([thresholds[trace.layout.observer, name] for name in names])
    colours = [series_colour(index) for index in range(len(names))]
    entity = f"{rr.escape_entity_path_part(trace.layout.observer)}/quiet"
    _send_series(recording, trace, f"{entity}/estimate", names, trace.isolated[:, list(places)] / units, colours)
    _send_level(recording, trace, f"{entity}/threshold", "threshold", 1.0)


def _send_thresholds(recording: rr.RecordingStream, trace: Trace, thresholds: Thresholds) -> None:
    root = rr.escape_entity_path_part(trace.layout.observer)
    for name in trace.layout.faults:
        level = thresholds.get((trace.layout.observer, name))
        if level is not None:
            entity = f"{root}/threshold/{rr.escape_entity_path_part(name)}"
            _send_level(recording, trace, entity, f"threshold of {name}", level)


def _send_series(
    recording: rr.RecordingStream,
    trace: Trace,
    entity: str,
    names: Sequence[str],
    values: NDArray[np.float64],
    colours: Sequence[str],
) -> None:
    """Send series over the samples' times to one entity, in batches."""
    if not names:
        return
    recording.log(entity, rr.SeriesLines(names=list(names), colors=[rgba(colour) for colour in colours]), static=True)
    for start in range(0, len(values), BATCH_ROWS):
        rows = slice(start, start + BATCH_ROWS)
        recording.send_columns(
            entity,
            indexes=_times(trace.vehicle_ns[rows], trace.unix_ns[rows]),
            columns=rr.Scalars.columns(scalars=values[rows]),
        )


def _send_level(recording: rr.RecordingStream, trace: Trace, entity: str, name: str, level: float) -> None:
    """Send two lines from the first sample to the last, one above and one below zero."""
    if not len(trace.vehicle_ns):
        return
    ends = [0, -1]
    lines = rr.SeriesLines(names=[name] * 2, colors=[rgba(GREY)] * 2, widths=[1.0] * 2)
    recording.log(entity, lines, static=True)
    recording.send_columns(
        entity,
        indexes=_times(trace.vehicle_ns[ends], trace.unix_ns[ends]),
        columns=rr.Scalars.columns(scalars=np.array([[level, -level]] * 2)),
    )


def _send_truth(recording: rr.RecordingStream, trace: Trace, truth: Truth) -> None:
    root = rr.escape_entity_path_part(trace.layout.observer)
    for name in trace.layout.faults:
        if name not in truth or not len(trace.vehicle_ns):
            continue
        times, values = truth[name]
        vehicle_ns = np.round(np.asarray(times) * 1e9).astype(np.int64)
        offset = int(trace.unix_ns[0] - trace.vehicle_ns[0])
        entity = f"{root}/truth/{rr.escape_entity_path_part(name)}"
        recording.log(entity, rr.SeriesLines(names=f"truth of {name}", colors=rgba(BLACK)), static=True)
        recording.send_columns(
            entity,
            indexes=_times(vehicle_ns, vehicle_ns + offset),
            columns=rr.Scalars.columns(scalars=np.asarray(values, dtype=np.float64)),
        )


def _send_alarms(recording: rr.RecordingStream, events: Sequence[AlarmEvent]) -> None:
    """Send alarms as states, which stand until the next, and every event as a line of text."""
    channels: dict[str, list[AlarmEvent]] = {}
    for event in events:
        parts = (rr.escape_entity_path_part(part) for part in (event.observer, event.channel))
        channels.setdefault("/".join(("alarms", *parts)), []).append(event)
    styles = rr.StateConfiguration(values=list(SEVERITY), colors=[rgba(colour) for colour in SEVERITY.values()])
    for entity, history in channels.items():
        recording.log(entity, styles, static=True)
        # an empty state ends the one before
        states = ["" if event.state == "cleared" else event.severity for event in history]
        recording.send_columns(entity, indexes=_event_times(history), columns=rr.StateChange.columns(state=states))
    if events:
        texts = [f"{event.channel} {event.state}: {event.message}" for event in events]
        levels = ["INFO" if event.state == "cleared" else _LEVELS[event.severity] for event in events]
        recording.send_columns(
            "log", indexes=_event_times(events), columns=rr.TextLog.columns(text=texts, level=levels)
        )


def _event_times(events: Sequence[AlarmEvent]) -> list[rr.TimeColumn]:
    vehicle_ns = np.array([event.vehicle_time_ms * 1_000_000 for event in events], dtype=np.int64)
    return _times(vehicle_ns, np.array([event.time_ns for event in events], dtype=np.int64))


def _times(vehicle_ns: NDArray[np.int64], unix_ns: NDArray[np.int64]) -> list[rr.TimeColumn]:
    return [
        rr.TimeColumn("vehicle_time", duration=vehicle_ns.astype("timedelta64[ns]")),
        rr.TimeColumn("unix_time", timestamp=unix_ns.astype("datetime64[ns]")),
    ]
