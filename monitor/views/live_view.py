"""The live Rerun view of all monitored vehicles: faults with thresholds, residuals, alarms and telemetry.

A thread of its own sends the buffers of the vehicles' monitors to a Rerun process four times a second. A process that
stalls or ends costs the monitors nothing: their buffers drop the oldest rows.
"""

from __future__ import annotations

import contextlib
import threading
import uuid
from collections.abc import Collection, Sequence

import rerun as rr
import rerun.blueprint as rrb

from monitor.estimate import Layout
from monitor.views.live_buffer import VehicleView
from monitor.views.panels import Panels, RunView, Thresholds, choose_panels, in_display_units
from monitor.views.rerun_blueprint import blueprint, observer_tab, raw_tab
from monitor.views.rerun_process import DEFAULT_PORT, LOOPBACK, RerunProcess, ViewMode, require_free, rerun_binary
from monitor.views.rerun_scene import APPLICATION, RerunScene

PERIOD_S = 0.25
"""Seconds between sends. Chosen: the eye takes a plot that moves four times a second for a running one."""
DEFAULT_MEMORY_MB = 256
"""What a viewer may hold of the past. Chosen: minutes of a vehicle, beside a daemon of 150 MB."""

# Seconds until a server that failed is started again; chosen so that one that always fails costs little.
_RESTART_S = 5.0
# Seconds that serializing a batch may take, and that ending may take: the monitor waits for the latter only.
_FLUSH_S = 1.0
_CLOSE_S = 1.0
# Memory of the server itself, MB, beside the data it keeps.
_OWN_MB = 128


class LiveView:
    """Shows vehicles in one Rerun recording, a tab each, all alarms below.

    It serves on a port of loopback to ``rerun rerun+http://127.0.0.1:PORT/proxy``, or opens a viewer, with so much
    memory for data that were shown; the oldest are dropped. A server that dies, or that grows beyond its memory because
    one of its viewers stalls, is started afresh; a viewer whose window was closed stays closed. Raises UsageError where
    the port is taken, or Rerun's executable is missing.

    ``batches`` counts those sent, ``failures`` how often the process went away, grew too large or could not be started.
    """

    def __init__(
        self, mode: ViewMode = "serve", *, port: int = DEFAULT_PORT, memory_mb: int = DEFAULT_MEMORY_MB
    ) -> None:
        rerun_binary()
        if mode == "serve":
            require_free(port)
        self.url = f"rerun+http://{LOOPBACK}:{port}/proxy" if mode == "serve" else ""
        self._mode: ViewMode = mode
        self._port = port
        self._memory_mb = memory_mb
        self._recording_id = f"live-{uuid.uuid4()}"
        self._vehicles: dict[str, VehicleView] = {}
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._process: RerunProcess | None = None
        self.batches = self.failures = 0
        self._thread = threading.Thread(target=self._run, name="live view", daemon=True)
        self._thread.start()

    def vehicle(
        self, name: str, layouts: Sequence[Layout], thresholds: Thresholds, messages: Collection[str]
    ) -> VehicleView:
        """Show one more vehicle; one of that name is replaced. Return what collects its data."""
        view = VehicleView(name, layouts, thresholds, messages)
        with self._lock:
            self._vehicles = self._vehicles | {name: view}
        return view

    @property
    def dropped(self) -> int:
        """Rows and events dropped because they were not read in time."""
        return sum(view.dropped for view in self._vehicles.values())

    def close(self) -> None:
        """Send the rest if that is quickly done, and end; a second call does nothing."""
        self._stop.set()
        self._thread.join(_CLOSE_S)
        process = self._process
        if self._thread.is_alive() and process is not None:
            process.kill()
            self._thread.join(_CLOSE_S)

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                self._show()
            except Exception:
                # whatever goes wrong with a picture, the monitor goes on
                self.failures += 1
                if self._mode == "spawn":
                    return
                self._stop.wait(_RESTART_S)

    def _show(self) -> None:
        """Start a Rerun process and send batches to it until told to stop or it fails."""
        with contextlib.closing(RerunProcess(self._mode, self._port, self._memory_mb)) as process:
            recording = rr.RecordingStream(APPLICATION, recording_id=self._recording_id)
            stream = recording.binary_stream()
            self._process = process
            shown: dict[str, VehicleView] = {}
            scenes: dict[str, tuple[RerunScene, dict[str, Panels]]] = {}
            try:
                stopping = False
                while not stopping:
                    stopping = self._stop.wait(PERIOD_S)
                    if shown is not self._vehicles:
                        shown = self._vehicles
                        scenes = {name: _scene(recording, view) for name, view in shown.items()}
                        recording.send_blueprint(_blueprint(tuple(shown.values())))
                    for name, view in shown.items():
                        _send(*scenes[name], view)
                    data = stream.read(flush_timeout_sec=_FLUSH_S)
                    if data:
                        process.write(data)
                        self.batches += 1
                    if self._mode == "serve" and process.resident_mb() > 2 * self._memory_mb + _OWN_MB:
                        raise MemoryError("a viewer holds up the server")
            finally:
                self._process = None
                recording.disconnect()


def _scene(recording: rr.RecordingStream, view: VehicleView) -> tuple[RerunScene, dict[str, Panels]]:
    chosen = choose_panels(view.layouts, (), (), view.thresholds)
    panels = dict(zip((layout.observer for layout in view.layouts), chosen, strict=True))
    return RerunScene(recording, (view.vehicle,)), panels


def _send(scene: RerunScene, panels: dict[str, Panels], view: VehicleView) -> None:
    batch = view.drain()
    run = in_display_units(RunView(batch.traces, batch.events, view.thresholds))
    for trace in run.traces:
        scene.trace(trace, panels[trace.layout.observer], run.thresholds, shown_only=True)
    scene.events(batch.events)
    for raw in batch.raw:
        scene.raw(raw.message, raw.fields, raw.unix_ns, raw.values)


def _blueprint(views: Sequence[VehicleView]) -> rrb.Blueprint:
    """Return the layout of the viewer: a tab per vehicle, in it one per observer and one of telemetry."""
    tabs = []
    for view in views:
        root = (view.vehicle,)
        chosen = choose_panels(view.layouts, (), (), view.thresholds)
        inner = [
            observer_tab(layout, panels, {}, None, root) for layout, panels in zip(view.layouts, chosen, strict=True)
        ]
        tabs.append(rrb.Tabs(*inner, raw_tab(view.messages, root), name=view.vehicle))
    return blueprint(tabs, [(view.vehicle,) for view in views], follow=True)
