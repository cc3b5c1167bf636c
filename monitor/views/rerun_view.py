"""A run as a Rerun recording that opens on faults with their thresholds, alarms and residuals."""

from __future__ import annotations

import errno
import os

import rerun as rr

from monitor.trace import Trace, alarm_spans
from monitor.views.panels import Panels, RunView, choose_panels, fault_limits, same_scale
from monitor.views.rerun_blueprint import Limits, blueprint, observer_tab
from monitor.views.rerun_scene import APPLICATION, RerunScene

FLUSH_TIMEOUT_S = 30.0
"""Seconds until a disk that does not take the recording is an error. Chosen: far more than a disk that works needs."""
QUIET_LIMITS = (-1.3, 1.3)
"""Axis of the quiet channels in units of their thresholds: the band with some room around it."""


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
    thresholds, truth = run.thresholds, run.truth
    traces = [trace for trace in run.traces if len(trace.vehicle_ns)]
    alarmed = {(event.observer, event.channel) for event in run.events}
    chosen = choose_panels([trace.layout for trace in traces], alarmed, truth, thresholds)
    tabs = [
        observer_tab(trace.layout, panels, _limits(trace, panels, run), QUIET_LIMITS)
        for trace, panels in zip(traces, chosen, strict=True)
    ]
    names = [trace.layout.observer for trace in traces]
    active = next((names.index(event.observer) for event in run.events if event.observer in names), 0)
    spans = alarm_spans(run.events)
    recording = rr.RecordingStream(APPLICATION)
    try:
        recording.save(os.fspath(path), default_blueprint=blueprint(tabs, active=active))
        scene = RerunScene(recording)
        for trace, panels in zip(traces, chosen, strict=True):
            scene.trace(trace, panels, thresholds)
            scene.spans(trace, spans, thresholds)
            scene.truth(trace, truth)
        scene.events(run.events)
        recording.flush(timeout_sec=FLUSH_TIMEOUT_S)
    except RuntimeError as error:
        # Rerun's own kind of error for a full disk
        raise OSError(errno.EIO, str(error), os.fspath(path)) from error
    finally:
        recording.disconnect()


def _limits(trace: Trace, panels: Panels, run: RunView) -> dict[int, Limits]:
    scales = {place: same_scale(trace.layout, panels, place) for place in panels.alone}
    return {place: fault_limits(trace, scale, run.thresholds, run.truth) for place, scale in scales.items()}
