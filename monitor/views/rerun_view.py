"""A run as a Rerun recording that opens on faults with their thresholds, alarms and residuals."""

import errno
import os
from collections.abc import Sequence

import rerun as rr

from monitor.trace import AlarmSpan, Trace, alarm_spans
from monitor.views.panels import Panels, RunView, choose_panels, fault_limits, in_display_units, same_scale
from monitor.views.rerun_blueprint import Limits, Stretch, blueprint, observer_tab
from monitor.views.rerun_scene import APPLICATION, RerunScene

FLUSH_TIMEOUT_S = 30.0
"""Seconds after which a disk that does not accept the recording is an error. Chosen: far more than a healthy disk
needs."""
QUIET_LIMITS = (-1.3, 1.3)
"""Axis of the quiet channels in units of their thresholds: the band between the thresholds with some margin."""

AROUND_NS = 10_000_000_000
"""Time that is marked before and after the first alarm. Chosen: the cause is seen beside it."""
LONGEST_NS = 60_000_000_000
"""Largest marked duration of a long alarm. Chosen: more would flatten its beginning."""


def write_rrd(path: str | os.PathLike[str], run: RunView) -> None:
    """Write a run to an ``.rrd`` file with its blueprint inside; ``RerunScene`` names its entities.

    No viewer is needed. The blueprint has a tab per observer that had a sample, that of the first alarm open, with the
    thresholds of faults as lines that are thick while an alarm is active, scaled by the
    estimates while alarms were armed; below are all alarms as states over time. ``truth`` holds by fault channel times
    on the vehicle's clock (s) and the true size at them.

    Raises
    ------
    OSError
        The file cannot be written.
    """
    run = in_display_units(run)
    thresholds, truth = run.thresholds, run.truth
    traces = [trace for trace in run.traces if len(trace.vehicle_ns)]
    alarmed = {(event.observer, event.channel) for event in run.events}
    chosen = choose_panels([trace.layout for trace in traces], alarmed, truth, thresholds)
    spans = alarm_spans(run.events)
    stretch = _first(traces, spans)
    tabs = [
        observer_tab(trace.layout, panels, _limits(trace, panels, run), QUIET_LIMITS, stretch=stretch)
        for trace, panels in zip(traces, chosen, strict=True)
    ]
    names = [trace.layout.observer for trace in traces]
    active = next((names.index(event.observer) for event in run.events if event.observer in names), 0)
    way = run.way if traces else None
    layout = blueprint(tabs, active=active, stretch=stretch, way=way)
    recording = rr.RecordingStream(APPLICATION)
    try:
        recording.save(os.fspath(path), default_blueprint=layout)
        scene = RerunScene(recording)
        for trace, panels in zip(traces, chosen, strict=True):
            scene.trace(trace, panels, thresholds)
            scene.spans(trace, spans, thresholds)
            scene.truth(trace, truth)
        scene.events(run.events)
        if way is not None:
            scene.way(way, traces)
        recording.flush(timeout_sec=FLUSH_TIMEOUT_S)
    except RuntimeError as error:
        # the error that Rerun raises for a full disk
        raise OSError(errno.EIO, str(error), os.fspath(path)) from error
    finally:
        recording.disconnect()


def _first(traces: Sequence[Trace], spans: Sequence[AlarmSpan]) -> Stretch | None:
    """Return the time range around the first alarm, or None if there is none."""
    if not spans or not traces:
        return None
    span, last_ns = spans[0], max(int(trace.vehicle_ns[-1]) for trace in traces)
    end_ns = last_ns if span.end_vehicle_ns is None else span.end_vehicle_ns
    return span.start_vehicle_ns - AROUND_NS, min(end_ns, span.start_vehicle_ns + LONGEST_NS) + AROUND_NS


def _limits(trace: Trace, panels: Panels, run: RunView) -> dict[int, Limits]:
    scales = {place: same_scale(trace.layout, panels, place) for place in panels.alone}
    return {place: fault_limits(trace, scale, run.thresholds, run.truth) for place, scale in scales.items()}
