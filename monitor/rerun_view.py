"""A run as a Rerun recording that opens on what matters: faults with thresholds, alarms, residuals."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from monitor.event import AlarmEvent
from monitor.palette import BLACK, GREY, SEVERITY, rgba, series_colour
from monitor.trace import Trace

Truth = Mapping[str, tuple[NDArray[np.float64], NDArray[np.float64]]]

APPLICATION = "fauio"
BATCH_ROWS = 1 << 16
FLUSH_TIMEOUT_S = 30.0

_LEVELS = {"warning": rr.TextLogLevel.WARN, "critical": rr.TextLogLevel.CRITICAL}


def write_rrd(
    path: str | os.PathLike[str],
    traces: Sequence[Trace],
    events: Sequence[AlarmEvent],
    thresholds: Mapping[str, float],
    truth: Truth | None = None,
) -> None:
    """Write a run to an ``.rrd`` file with its blueprint inside.

    Time lines are ``vehicle_time`` (seconds of the vehicle's clock) and ``unix_time``. Entities per observer:
    ``<observer>/fault``, ``/isolated``, ``/residual``, ``/state``, ``/input`` and ``/output`` with one series
    per channel, ``/threshold/<value>``, ``/truth/<channel>``; alarms are states in
    ``alarms/<observer>/<channel>`` and lines of text in ``log``. No viewer is needed.

    Parameters
    ----------
    path : str | PathLike
        File to write.
    traces : Sequence[Trace]
        One per observer.
    events : Sequence[AlarmEvent]
        All alarm events of the run.
    thresholds : Mapping[str, float]
        Alarm threshold by fault channel.
    truth : Mapping[str, tuple[NDArray, NDArray]] | None
        By fault channel: times on the vehicle's clock (s) and the true size at them.
    """
    recording = rr.RecordingStream(APPLICATION)
    try:
        recording.save(os.fspath(path), default_blueprint=_blueprint(traces))
        for trace in traces:
            _send_trace(recording, trace)
            _send_thresholds(recording, trace, thresholds)
            _send_truth(recording, trace, truth or {})
        _send_alarms(recording, events)
        recording.flush(timeout_sec=FLUSH_TIMEOUT_S)
    finally:
        recording.disconnect()


def _blueprint(traces: Sequence[Trace]) -> rrb.Blueprint:
    """Return the layout of the viewer: a tab per observer above the alarms' states and texts."""
    tabs = [_observer_tab(trace.layout.observer) for trace in traces]
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


def _observer_tab(observer: str) -> rrb.Vertical:
    root = rr.escape_entity_path_part(observer)

    def view(name: str, *parts: str) -> rrb.TimeSeriesView:
        contents = [f"+ /{root}/{part}/**" for part in parts]
        return rrb.TimeSeriesView(origin=f"/{root}", contents=contents, name=name, axis_x=_linked())

    return rrb.Vertical(
        view("faults", "isolated", "threshold", "truth"),
        view("residuals", "residual"),
        rrb.Horizontal(view("inputs", "input"), view("outputs", "output")),
        row_shares=[3, 2, 2],
        name=observer,
    )


def _linked() -> rrb.TimeAxis:
    return rrb.TimeAxis(link=rrb.components.LinkAxis.LinkToGlobal)


def _send_trace(recording: rr.RecordingStream, trace: Trace) -> None:
    layout = trace.layout
    root = rr.escape_entity_path_part(layout.observer)
    groups = {
        "fault": (layout.faults, trace.fault),
        "isolated": (layout.faults, trace.isolated),
        "residual": (layout.outputs, trace.residual),
        "state": (layout.states, trace.x),
        "input": (layout.inputs, trace.u),
        "output": (layout.outputs, trace.y),
    }
    units = dict(zip(layout.faults, layout.fault_units, strict=True))
    for group, (names, values) in groups.items():
        if not names:
            continue
        entity = f"{root}/{group}"
        shown = [f"{name} ({units[name]})" if group in ("fault", "isolated") else name for name in names]
        colours = [rgba(series_colour(index)) for index in range(len(names))]
        recording.log(entity, rr.SeriesLines(names=shown, colors=colours), static=True)
        for start in range(0, len(values), BATCH_ROWS):
            rows = slice(start, start + BATCH_ROWS)
            recording.send_columns(
                entity,
                indexes=_times(trace.vehicle_ns[rows], trace.unix_ns[rows]),
                columns=rr.Scalars.columns(scalars=values[rows]),
            )


def _send_thresholds(recording: rr.RecordingStream, trace: Trace, thresholds: Mapping[str, float]) -> None:
    """Send each distinct threshold as two lines from the first sample to the last."""
    if not len(trace.vehicle_ns):
        return
    ends = [0, -1]
    root = rr.escape_entity_path_part(trace.layout.observer)
    for value in sorted({thresholds[name] for name in trace.layout.faults if name in thresholds}):
        names = ", ".join(name for name in trace.layout.faults if thresholds.get(name) == value)
        entity = f"{root}/threshold/{rr.escape_entity_path_part(f'{value:g}')}"
        lines = rr.SeriesLines(names=[f"threshold of {names}"] * 2, colors=[rgba(GREY)] * 2, widths=[1.0] * 2)
        recording.log(entity, lines, static=True)
        recording.send_columns(
            entity,
            indexes=_times(trace.vehicle_ns[ends], trace.unix_ns[ends]),
            columns=rr.Scalars.columns(scalars=np.array([[value, -value]] * 2)),
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
