"""A run in Rerun, live or replayed: entity paths, names, colours, and how values are sent."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from monitor.event import AlarmEvent
from monitor.trace import AlarmSpan, Trace
from monitor.views.palette import BLUE, GREEN, GREY, SEVERITY, VERMILION, any_ground_colour, rgba
from monitor.views.panels import Panels, Thresholds, TrueSizes
from monitor.views.way import Way

APPLICATION = "fauio"
BATCH_ROWS = 1 << 16
"""Rows sent at once. Chosen: 11 min at 100 Hz; a viewer draws a recording while it reads it, batch by batch."""
SPAN_WIDTH = 6.0
"""Width of a threshold's line while its alarm is active, in points; other lines have 1."""

_BODY = [[3.0, 0.0, 0.0], [0.0, 1.5, 0.0], [0.0, 0.0, -1.5]]
"""Lengths of the arrows ahead, to the right and up, metres. Chosen: visible beside a flight of some tens of metres."""
_AXES = (VERMILION, GREEN, BLUE)

_LEVELS = {"warning": rr.TextLogLevel.WARN, "critical": rr.TextLogLevel.CRITICAL}
_QUIET_STATES = ("acknowledged", "shelved", "cleared")
_STATES: dict[str, str] = {**{str(name): colour for name, colour in SEVERITY.items()}, "shelved": GREY}


def entity_path(*parts: str) -> str:
    """Return the path of an entity; parts may hold any characters."""
    return "/".join(rr.escape_entity_path_part(part) for part in parts)


class RerunScene:
    """Sends a run to a Rerun recording; the style of an entity is sent once, before its first values.

    Time lines are ``vehicle_time`` (seconds of the vehicle's clock) and ``unix_time``. Entities per observer, all below
    ``root``: ``<observer>/fault``, ``/residual``, ``/state``, ``/input`` and ``/output`` with one series per channel,
    ``/isolated/<channel>``, ``/threshold/<channel>``, ``/span/<channel>``, ``/truth/<channel>``, and ``/quiet`` for the
    channels that share a view; alarms are states in ``alarms/<observer>/<channel>`` and lines of text in ``log``;
    ``map`` and ``space`` hold the way, ``space/vehicle`` the pose; telemetry is in ``raw/<message>``, on ``unix_time``
    only.
    """

    def __init__(self, recording: rr.RecordingStream, root: tuple[str, ...] = ()) -> None:
        self._recording = recording
        self._root = root
        self._described: set[str] = set()

    def trace(self, trace: Trace, panels: Panels, thresholds: Thresholds, *, shown_only: bool = False) -> None:
        """Send samples and estimates of one observer; ``shown_only`` omits entities without a view in the blueprint."""
        layout = trace.layout
        units = [f"{name} ({unit})" for name, unit in zip(layout.faults, layout.fault_units, strict=True)]
        groups = {
            "residual": (layout.outputs, trace.residual),
            "input": (layout.inputs, trace.u),
            "output": (layout.outputs, trace.y),
        }
        if not shown_only:
            groups |= {"fault": (tuple(units), trace.fault), "state": (layout.states, trace.x)}
        for group, (names, values) in groups.items():
            colours = [any_ground_colour(index) for index in range(len(names))]
            self._series(trace, (layout.observer, group), names, values, colours)
        for place in panels.alone if shown_only else range(len(layout.faults)):
            name = layout.faults[place]
            column = trace.isolated[:, place : place + 1]
            self._series(trace, (layout.observer, "isolated", name), units[place : place + 1], column, [BLUE])
            level = thresholds.get((layout.observer, name))
            if level is not None:
                self._level(trace, (layout.observer, "threshold", name), f"threshold of {name}", level)
        self._quiet(trace, panels.together, thresholds)

    def truth(self, trace: Trace, truth: TrueSizes) -> None:
        """Send the true sizes of faults, if known."""
        for name in trace.layout.faults:
            if name not in truth or not len(trace.vehicle_ns):
                continue
            times, values = truth[name]
            vehicle_ns = np.round(np.asarray(times) * 1e9).astype(np.int64)
            offset = int(trace.unix_ns[0] - trace.vehicle_ns[0])
            entity = (trace.layout.observer, "truth", name)
            path = self._describe(entity, rr.SeriesLines(names=f"truth of {name}", colors=rgba(GREEN)))
            self._scalars(path, _times(vehicle_ns, vehicle_ns + offset), np.asarray(values, dtype=np.float64))

    def spans(self, trace: Trace, spans: Sequence[AlarmSpan], thresholds: Thresholds) -> None:
        """Send the times at which the alarms of an observer were active, as thick parts of their thresholds' lines."""
        layout = trace.layout
        for name in layout.faults:
            own = [span for span in spans if (span.observer, span.channel) == (layout.observer, name)]
            level = thresholds.get((layout.observer, name))
            if not own or level is None or not len(trace.vehicle_ns):
                continue
            for severity, colour in SEVERITY.items():
                active = [span for span in own if span.severity == severity]
                if not active:
                    continue
                entity = (layout.observer, "span", name, severity)
                style = rr.SeriesLines(
                    names=[f"{severity} alarm of {name}"] * 2, colors=[rgba(colour)] * 2, widths=[SPAN_WIDTH] * 2
                )
                vehicle_ns, unix_ns, levels = _span_lines(trace, active, level)
                path = self._describe(entity, style)
                self._scalars(path, _times(vehicle_ns, unix_ns), levels)

    def events(self, events: Sequence[AlarmEvent]) -> None:
        """Send alarms as states, each of which lasts until the next, and every event as a line of text."""
        channels: dict[tuple[str, ...], list[AlarmEvent]] = {}
        for event in events:
            channels.setdefault(("alarms", event.observer, event.channel), []).append(event)
        styles = rr.StateConfiguration(values=list(_STATES), colors=[rgba(colour) for colour in _STATES.values()])
        for entity, history in channels.items():
            path = self._describe(entity, styles)
            states = [_state(event) for event in history]
            self._send(path, _event_times(history), rr.StateChange.columns(state=states))
        if events:
            texts = [f"{event.channel} {event.state}: {event.message}" for event in events]
            levels = ["INFO" if event.state in _QUIET_STATES else _LEVELS[event.severity] for event in events]
            self._send(self._path(("log",)), _event_times(events), rr.TextLog.columns(text=texts, level=levels))

    def raw(self, message: str, fields: Sequence[str], unix_ns: NDArray[np.int64], values: NDArray[np.float64]) -> None:
        """Send a message's numeric fields: times of arrival (N,), values (N, fields)."""
        colours = [rgba(any_ground_colour(index)) for index in range(len(fields))]
        path = self._describe(("raw", message), rr.SeriesLines(names=list(fields), colors=colours))
        self._scalars(path, [_unix(unix_ns)], values)

    def way(self, way: Way, traces: Sequence[Trace]) -> None:
        """Send the positions by GPS and those corrected by the estimates, for a map and in space with attitudes."""
        base = max(traces, key=lambda trace: len(trace.unix_ns))
        real = way.real(traces)
        for name, places, colour in (("gps", way.places, VERMILION), ("track", real, BLUE)):
            colours = [rgba(colour)]
            path = self._path(("map", name))
            lines = rr.GeoLineStrings(lat_lon=[places[:, :2]], radii=rr.Radius.ui_points(2.0), colors=colours)
            self._recording.log(path, lines, static=True)
            line = rr.LineStrips3D([way.metres(places)], colors=colours, radii=rr.Radius.ui_points(1.5))
            self._recording.log(self._path(("space", name)), line, static=True)
            times = _of_vehicle(base, way.unix_ns)
            dot = rr.GeoPoints.from_fields(radii=rr.Radius.ui_points(6.0), colors=colours)
            self._send(self._describe(("map", name, "now"), dot), times, rr.GeoPoints.columns(positions=places[:, :2]))
        if not len(way.attitude_ns):
            return
        vehicle = self._describe(("space", "vehicle"), rr.Arrows3D(vectors=_BODY, colors=[rgba(c) for c in _AXES]))
        at = np.column_stack([np.interp(way.attitude_ns, way.unix_ns, column) for column in way.metres(real).T])
        poses = rr.Transform3D.columns(translation=at, mat3x3=way.rotations().transpose(0, 2, 1).reshape(-1, 9))
        self._send(vehicle, _of_vehicle(base, way.attitude_ns), poses)

    def _quiet(self, trace: Trace, places: Sequence[int], thresholds: Thresholds) -> None:
        """Send the channels that share a view, each in units of its threshold, with the band between thresholds."""
        if not places:
            return
        layout = trace.layout
        names = [layout.faults[place] for place in places]
        units = np.array([thresholds[layout.observer, name] for name in names])
        colours = [any_ground_colour(index) for index in range(len(names))]
        self._series(
            trace, (layout.observer, "quiet", "estimate"), names, trace.isolated[:, list(places)] / units, colours
        )
        self._level(trace, (layout.observer, "quiet", "threshold"), "threshold", 1.0)

    def _series(
        self,
        trace: Trace,
        entity: tuple[str, ...],
        names: Sequence[str],
        values: NDArray[np.float64],
        colours: Sequence[str],
    ) -> None:
        """Send series over the samples' times to one entity, in batches."""
        if not names:
            return
        path = self._describe(entity, rr.SeriesLines(names=list(names), colors=[rgba(colour) for colour in colours]))
        for start in range(0, len(values), BATCH_ROWS):
            rows = slice(start, start + BATCH_ROWS)
            self._scalars(path, _times(trace.vehicle_ns[rows], trace.unix_ns[rows]), values[rows])

    def _level(self, trace: Trace, entity: tuple[str, ...], name: str, level: float) -> None:
        """Send two lines from the first sample to the last, one above and one below zero."""
        if not len(trace.vehicle_ns):
            return
        ends = [0, -1]
        path = self._describe(entity, rr.SeriesLines(names=[name] * 2, colors=[rgba(GREY)] * 2, widths=[1.0] * 2))
        levels = np.array([[level, -level]] * 2)
        self._scalars(path, _times(trace.vehicle_ns[ends], trace.unix_ns[ends]), levels)

    def _path(self, entity: tuple[str, ...]) -> str:
        return entity_path(*self._root, *entity)

    def _describe(self, entity: tuple[str, ...], style: rr.AsComponents) -> str:
        """Send the style of an entity unless it was sent; return its path."""
        path = self._path(entity)
        if path not in self._described:
            self._recording.log(path, style, static=True)
            self._described.add(path)
        return path

    def _scalars(self, path: str, indexes: Sequence[rr.TimeColumn], values: NDArray[np.float64]) -> None:
        self._send(path, indexes, rr.Scalars.columns(scalars=values))

    def _send(self, path: str, indexes: Sequence[rr.TimeColumn], columns: Any) -> None:
        self._recording.send_columns(path, indexes=indexes, columns=columns)


def _span_lines(
    trace: Trace, spans: Sequence[AlarmSpan], level: float
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Return vehicle's times, Unix times and values of two lines that are shown while alarms were active."""
    vehicle_ns: list[int] = []
    unix_ns: list[int] = []
    levels: list[list[float]] = []
    for span in spans:
        stop_vehicle_ns = trace.vehicle_ns[-1] if span.end_vehicle_ns is None else span.end_vehicle_ns
        stop_ns = trace.unix_ns[-1] if span.end_ns is None else span.end_ns
        vehicle_ns += [span.start_vehicle_ns, int(stop_vehicle_ns), int(stop_vehicle_ns) + 1]
        unix_ns += [span.start_ns, int(stop_ns), int(stop_ns) + 1]
        levels += [[level, -level], [level, -level], [np.nan, np.nan]]
    return np.array(vehicle_ns, np.int64), np.array(unix_ns, np.int64), np.array(levels)


def _state(event: AlarmEvent) -> str:
    """Return the name of an alarm's state after an event; an empty name ends the previous state."""
    if event.state == "cleared":
        return ""
    return "shelved" if event.shelved_until_ns is not None else event.severity


def _of_vehicle(trace: Trace, unix_ns: NDArray[np.int64]) -> list[rr.TimeColumn]:
    """Return times of arrival with the vehicle's times, interpolated between the samples of a trace."""
    first = int(trace.unix_ns[0])
    offsets = np.interp(unix_ns - first, trace.unix_ns - first, trace.vehicle_ns - trace.unix_ns)
    return _times(unix_ns + offsets.round().astype(np.int64), unix_ns)


def _event_times(events: Sequence[AlarmEvent]) -> list[rr.TimeColumn]:
    vehicle_ns = np.array([event.vehicle_time_ms * 1_000_000 for event in events], dtype=np.int64)
    return _times(vehicle_ns, np.array([event.time_ns for event in events], dtype=np.int64))


def _times(vehicle_ns: NDArray[np.int64], unix_ns: NDArray[np.int64]) -> list[rr.TimeColumn]:
    return [rr.TimeColumn("vehicle_time", duration=vehicle_ns.astype("timedelta64[ns]")), _unix(unix_ns)]


def _unix(unix_ns: NDArray[np.int64]) -> rr.TimeColumn:
    return rr.TimeColumn("unix_time", timestamp=unix_ns.astype("datetime64[ns]"))
