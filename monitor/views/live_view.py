"""The live Rerun view of all monitored vehicles: faults with thresholds, residuals, alarms and telemetry.

A thread of its own sends the buffers of the vehicles' monitors to a Rerun process four times a second. A process that
stalls or ends costs the monitors nothing: their buffers drop the oldest rows.

The process is fed through its standard input, so that its failures do not affect the monitor. Rerun's in-process server
listens on all interfaces unless told otherwise, grows without bound behind a client that stalls, and then holds up the
process that ends. A child can be killed, and a server does not outlive its parent.
"""

import contextlib
import os
import resource
import socket
import subprocess
import threading
import uuid
from collections.abc import Collection, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

import rerun as rr
import rerun.blueprint as rrb

from adapters.errors import UsageError
from monitor.estimate import Layout
from monitor.views.live_buffer import VehicleView
from monitor.views.panels import Panels, RunView, Thresholds, choose_panels, in_display_units
from monitor.views.rerun_blueprint import blueprint, observer_tab, raw_tab
from monitor.views.rerun_scene import APPLICATION, RerunScene

ViewMode = Literal["serve", "spawn"]

LOOPBACK = "127.0.0.1"
DEFAULT_PORT = 9876
"""Rerun's own default port."""

_PAGES_FILE = "/proc/{}/statm"
# Seconds until a server that does not end (one with a stalled client does not) is killed: the daemon's end waits.
_STOP_S = 1.0
# Waits until standard input ends: it does when the process at the other end has ended, for whatever reason.
_KILL_AT_EOF = 'read -r _; kill -9 "$1"'
# Seconds to wait for a viewer that may have been closed, so that no zombie remains; an open one is left alone.
_LEAVE_S = 0.3


class RerunProcess:
    """A Rerun server on a port of loopback, or a viewer on this machine's screen, fed with ``.rrd`` bytes.

    ``memory_mb`` is the memory of the server, for viewers that connect later, or of the viewer; the oldest data are
    dropped.
    """

    def __init__(self, mode: ViewMode, port: int, memory_mb: int) -> None:
        self._mode = mode
        options = [f"--bind={LOOPBACK}"]
        if mode == "serve":
            options += ["--serve-grpc", f"--port={port}", f"--server-memory-limit={memory_mb}MB"]
        else:
            options += ["--new", "--hide-welcome-screen", f"--memory-limit={memory_mb}MB"]
        # Rerun sends no usage statistics from continuous integration: a monitor must send none either.
        environment = os.environ | {"CI": "1", "RERUN_APP_ONLY": "true"}
        self._process = subprocess.Popen(  # noqa: S603 - the executable of our own dependency
            [rerun_binary(), "-", *options],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            bufsize=0,
            env=environment,
            start_new_session=True,
        )
        self._guard = self._guarded() if mode == "serve" else None

    def write(self, data: bytes) -> None:
        """Write bytes, waiting for a slow process; raise OSError if the process has ended."""
        if self._process.stdin is None:
            raise BrokenPipeError
        rest = memoryview(data)
        while rest:
            rest = rest[self._process.stdin.write(rest) or 0 :]

    def resident_mb(self) -> float:
        """Return the process's resident memory; 0 if the system does not tell."""
        try:
            pages = int(Path(_PAGES_FILE.format(self._process.pid)).read_text().split()[1])
        except (OSError, IndexError, ValueError):
            return 0.0
        return pages * resource.getpagesize() / 1e6

    def kill(self) -> None:
        """End the process at once, even while another thread waits in :meth:`write`."""
        self._process.kill()

    def close(self) -> None:
        """End a server; leave a viewer open with its data."""
        try:
            self._end()
        finally:
            if self._guard is not None:
                self._guard.kill()
                self._guard.communicate()

    def _guarded(self) -> subprocess.Popen[bytes] | None:
        """Start a process that ends the server if this process is killed; return None if it cannot be started."""
        with contextlib.suppress(OSError):
            return subprocess.Popen(  # noqa: S603 - a constant script
                ["/bin/sh", "-c", _KILL_AT_EOF, "sh", str(self._process.pid)],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,
            )
        return None

    def _end(self) -> None:
        if self._process.stdin is not None:
            with contextlib.suppress(OSError):
                self._process.stdin.close()
        if self._mode == "spawn":
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(_LEAVE_S)
            return
        self._process.terminate()
        try:
            self._process.wait(_STOP_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait(_STOP_S)


def rerun_binary() -> str:
    """Return the path of Rerun's executable; ``RERUN_CLI_PATH`` overrides, as in Rerun itself.

    Raises UsageError if there is none.
    """
    package = find_spec("rerun_cli")
    folders = package.submodule_search_locations if package is not None else None
    path = Path(os.environ.get("RERUN_CLI_PATH") or Path(folders[0] if folders else "", "rerun"))
    if not os.access(path, os.X_OK):
        raise UsageError(f"{path}: Rerun's executable is missing; install rerun-sdk again or set RERUN_CLI_PATH")
    return str(path)


def require_free(port: int) -> None:
    """Raise UsageError if another process listens on a port of loopback, or it is not a valid port."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((LOOPBACK, port))
        except (OSError, OverflowError) as error:
            raise UsageError(
                f"Rerun cannot listen on {LOOPBACK}:{port}: {error}; choose another port (--rerun-port)"
            ) from error


PERIOD_S = 0.25
"""Seconds between sends. Chosen: a plot that moves four times a second looks live."""
DEFAULT_MEMORY_MB = 256
"""Memory for data that were shown, MB. Chosen: minutes of a vehicle, beside a daemon of 150 MB."""

# Seconds until a failed server is started again; chosen so that one that always fails costs little.
_RESTART_S = 5.0
# Seconds that serializing a batch may take, and that ending may take: the monitor waits only for the latter.
_FLUSH_S = 1.0
_CLOSE_S = 1.0
# Memory of the server itself, MB, beside the data it keeps.
_OWN_MB = 128


class LiveView:
    """Shows vehicles in one Rerun recording, a tab each, all alarms below.

    It serves on a port of loopback to ``rerun rerun+http://127.0.0.1:PORT/proxy``, or opens a viewer. ``memory_mb`` is
    the memory for data that were shown; the oldest are dropped. A server that ends, or that exceeds its memory because
    one of its viewers stalls, is restarted; a viewer whose window was closed stays closed. Raises UsageError if the
    port is in use, or Rerun's executable is missing.

    ``batches`` counts the batches sent, ``failures`` how often the process ended, grew too large or could not be
    started.
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
        """Show one more vehicle; one of that name is replaced. Return the buffer that collects its data."""
        view = VehicleView(name, layouts, thresholds, messages)
        with self._lock:
            self._vehicles = self._vehicles | {name: view}
        return view

    @property
    def dropped(self) -> int:
        """Rows and events dropped because they were not read in time."""
        return sum(view.dropped for view in self._vehicles.values())

    def close(self) -> None:
        """Send the rest if that takes little time, and end; a second call does nothing."""
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
                # a failed view must not end the monitor
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
