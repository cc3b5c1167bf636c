"""The whole path with a built-in example and real processes: sender -> MAVLink UDP -> daemon -> Zenoh -> subscriber.

The demonstration starts ``fauio run`` as a user would and subscribes to its alarms. Another process sends a simulated
or recorded vehicle over UDP. The demonstration compares the alarms with the injected truth, and at the end replays the
daemon's own recording for the plots.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
import webbrowser
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from adapters.command_line import say
from adapters.errors import FauioError, UsageError
from adapters.logs.recordings import read_batches
from adapters.output_file import write_file
from adapters.simulation.arm import SCENARIOS
from adapters.zenoh.zenoh_session import open_session
from monitor.bus.operators import VERBS
from monitor.bus.subscriber import AlarmSubscriber
from monitor.event import AlarmEvent
from monitor.profile import read_profile
from monitor.service.caught_signals import caught_signals
from monitor.trace import Trace
from monitor.views.panels import RunView
from monitor.views.way import WAY_MESSAGES, way_of
from replay.demonstration.arm_profile import write_arm_profile
from replay.player import Replay, play_batches
from replay.reports.plot import plot_png

if TYPE_CHECKING:
    import zenoh


@dataclass(frozen=True, slots=True)
class Truth:
    """One injected fault."""

    channel: str  # the fault channel on which it should be detected
    # when it acts, seconds on the vehicle's clock
    start_s: float
    stop_s: float
    signal: Callable[[float], float]  # its size over time
    relative: bool = False  # whether the size is a share of the command

    def at(self, time_s: float) -> float:
        """Return the size at a time, zero while it does not act."""
        return self.signal(time_s) if self.start_s <= time_s < self.stop_s else 0.0


_CLIPS = "clips"
_DATA = Path(__file__).parent.parent / "data"
_START_TIMEOUT_S = 30.0
"""Longest wait for the daemon's start, seconds. Chosen: ten times a cold start on a desktop, for small boards."""
_LAST_EVENTS_S = 1.0
"""Wait for events that are on their way when the flight ends, seconds. Chosen: they need milliseconds."""
_PAGE_S = 30.0
"""Longest wait for a browser, seconds. Chosen: the time to open a page on another machine through a tunnel; then the
flight begins without one."""
_STOP_TIMEOUT_S = 10.0
"""Longest wait for the daemon's end, seconds. Chosen: the daemon closes its files within a second or hangs."""


@dataclass(frozen=True, slots=True)
class DemoScene:
    """One scene to demonstrate."""

    title: str  # one sentence for the user
    profile: Path
    sender: Callable[[str, float], list[str]]  # command line of the sender for an address ``host:port`` and a speed
    truth: tuple[Truth, ...]


def demo(vehicle: str, out: Path, speed: float | None, console: bool = False) -> int:
    """Run the demonstration and return the exit status: 0 if every injected fault raised its alarm, else 1.

    With ``console`` a web page shows it, until it is interrupted.
    """
    from monitor.views.rerun_view import write_rrd

    out.mkdir(parents=True, exist_ok=True)
    scene = _arm_scene(out) if vehicle == "arm" else _copter_scene()
    pace = speed or (1.0 if console else 2.0 if vehicle == "arm" else 4.0)
    say(scene.title)
    record = out / f"{vehicle}.mcap"
    events = _run_live(scene, record, pace, _monitor_config(out) if console else None)
    replayed = play_batches(read_profile(scene.profile), read_batches(record), keep_traces=True)
    curves = {truth.channel: _true_course(truth, replayed.traces[0]) for truth in scene.truth}
    way = way_of(read_batches(record, WAY_MESSAGES))
    shown = RunView(replayed.traces, replayed.events, replayed.thresholds, curves, way=way)
    plot_png(out / f"{vehicle}.png", shown, scene.title)
    write_rrd(out / f"{vehicle}.rrd", shown)
    return _report(scene, events, replayed, out, vehicle)


def _arm_scene(out: Path) -> DemoScene:
    say("designing the arm's observer and calibrating its alarms ...")
    profile = out / "arm-profile"
    write_arm_profile(profile)
    names = {"f_a": "motor", "f_s": "encoder"}
    return DemoScene(
        title="A flexible-joint arm, disturbed; its motor gets 2 N m too much, later its encoder reads 2 rad off.",
        profile=profile,
        sender=lambda address, pace: [
            *(sys.executable, "-m", "fauio", "simulate", "arm", "--scenario", "case2", "--duration", "40"),
            *("--mavlink", f"udpout:{address}", "--speed", str(pace)),
        ],
        truth=tuple(
            Truth(names[fault.channel], fault.start_s, fault.stop_s, fault.signal)
            for fault in SCENARIOS["case2"].faults
        ),
    )


def _copter_scene() -> DemoScene:
    return DemoScene(
        title="A recorded flight of a quadcopter in gusts; its motor 1 loses 5 % of its command for 50 s.",
        profile=_DATA / "quad",
        sender=lambda address, pace: [
            *(sys.executable, "-m", "adapters.simulation.tlog_sender", str(_DATA / "copter_motor1.tlog.xz")),
            *(f"udp:{address}", "--speed", str(pace), "--renumber"),
        ],
        truth=(Truth("motor1", 112.594, 162.594, lambda _: -0.05, relative=True),),
    )


def _monitor_config(out: Path) -> Path:
    """Return the path of a configuration that allows the page to send commands and to offer clips."""
    (out / _CLIPS).mkdir(exist_ok=True)
    verbs = ", ".join(f'"{verb}"' for verb in VERBS)
    config = out / "monitor.toml"
    write_file(config, f'[commands]\nallow = [{verbs}]\n\n[black_box]\nfolder = "{_CLIPS}"\n')
    return config


def _run_live(scene: DemoScene, record: Path, speed: float, config: Path | None) -> list[AlarmEvent]:
    """Run daemon, sender and subscriber, and the console if there is a configuration; return the received events."""
    udp = f"127.0.0.1:{_free_port(socket.SOCK_DGRAM)}"
    endpoint = f"tcp/127.0.0.1:{_free_port(socket.SOCK_STREAM)}"
    daemon = subprocess.Popen(  # noqa: S603 - our own program with our own arguments
        [
            *(sys.executable, "-m", "fauio", "run", str(scene.profile), "--mavlink", f"udpin:{udp}"),
            *("--listen", endpoint, "--record", str(record)),
            *(() if config is None else ("--config", str(config))),
        ],
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        session = open_session(connect=[endpoint])
        try:
            subscriber = AlarmSubscriber(session)
            _wait_for_monitor(subscriber, daemon)
            say(f"monitor listens to MAVLink on udp {udp} and publishes on Zenoh at {endpoint}")
            if config is None:
                return _watch(scene, subscriber, scene.sender(udp, speed), None)
            with caught_signals() as signals, _page(session, config.parent, signals):
                return _watch(scene, subscriber, scene.sender(udp, speed), signals)
        finally:
            session.close()  # type: ignore[no-untyped-call]
    finally:
        daemon.send_signal(signal.SIGTERM)
        with contextlib.suppress(subprocess.TimeoutExpired):
            daemon.communicate(timeout=_STOP_TIMEOUT_S)
        daemon.kill()


@contextlib.contextmanager
def _page(session: zenoh.Session, out: Path, signals: Sequence[int]) -> Iterator[None]:
    """Serve the console, and wait until somebody opens it."""
    from monitor.console.web_server import ConsoleOptions, ConsoleServer

    options = ConsoleOptions(commands=True, clips=out / _CLIPS)
    try:
        server = ConsoleServer(session, options)
    except UsageError:  # the port is taken
        server = ConsoleServer(session, replace(options, listen="127.0.0.1:0"))
    with contextlib.closing(server):
        say(f"open {server.url} in a browser; Ctrl-C ends")
        if os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY") or sys.platform == "darwin":
            webbrowser.open(server.url)
        until = time.monotonic() + _PAGE_S
        while not (server.streams or signals) and time.monotonic() < until:
            time.sleep(0.1)
        yield


def _wait_for_monitor(subscriber: AlarmSubscriber, daemon: subprocess.Popen[str]) -> None:
    deadline = time.monotonic() + _START_TIMEOUT_S
    while not subscriber.live:
        if daemon.poll() is not None:
            said = daemon.stderr.read().strip() if daemon.stderr is not None else ""
            raise FauioError(f"the monitor did not start: {said.splitlines()[-1] if said else 'no reason given'}")
        if time.monotonic() > deadline:
            raise FauioError(f"no monitor on Zenoh within {_START_TIMEOUT_S:g} s; is loopback TCP blocked?")
        time.sleep(0.05)


def _watch(
    scene: DemoScene, subscriber: AlarmSubscriber, sender_command: Sequence[str], signals: Sequence[int] | None
) -> list[AlarmEvent]:
    """Start the sender and collect events until a second after its end and, if there is a page, until a signal."""
    events: list[AlarmEvent] = []
    # in a session of its own: Ctrl-C is for this process alone
    sender = subprocess.Popen(sender_command, stdout=subprocess.DEVNULL, process_group=0)  # noqa: S603 - as above
    try:
        until: float | None = None
        while until is None or time.monotonic() < until or (signals is not None and not signals):
            event = subscriber.receive(0.1)
            if event is not None and event.kind not in ("stale", "blind"):
                events.append(event)
                say(_announce(scene, event))
            if until is None and signals:
                raise KeyboardInterrupt
            if until is None and sender.poll() is not None:
                until = time.monotonic() + _LAST_EVENTS_S
                if signals is not None:
                    say("the flight is over; the page stays until Ctrl-C")
    finally:
        sender.kill()
        sender.wait()
    if sender.returncode != 0:
        raise FauioError(f"the sender failed with status {sender.returncode}")
    return events


def _announce(scene: DemoScene, event: AlarmEvent) -> str:
    time_s = event.vehicle_time_ms / 1000
    line = f"  {time_s:8.2f} s  {event.channel:<8} {event.state:<8}"
    truth = next((t for t in scene.truth if t.channel == event.channel), None)
    if truth is None:
        return f"{line} {event.message}  (nothing was injected here)"
    shown = event.relative if truth.relative else event.estimate
    estimate = "" if shown is None else f" estimate {_size(shown, truth)}  truth {_size(truth.at(time_s), truth)}"
    since = time_s - (truth.stop_s if event.state == "cleared" else truth.start_s)
    word = "end" if event.state == "cleared" else "onset"
    delay = f"  {since:.2f} s after {word}" if event.state in ("raised", "cleared") else ""
    return f"{line}{estimate}{delay}"


def _report(scene: DemoScene, events: Sequence[AlarmEvent], replayed: Replay, out: Path, vehicle: str) -> int:
    same = [event for event in replayed.events if event.kind not in ("stale", "blind")] == list(events)
    say(f"replaying the recording gives the same {len(events)} events: {'yes' if same else 'NO'}")
    missing = [
        truth.channel
        for truth in scene.truth
        if not any(event.channel == truth.channel and event.state == "raised" for event in events)
    ]
    wrong = sorted({event.channel for event in events} - {truth.channel for truth in scene.truth})
    for channel in missing:
        say(f"MISSED: {channel}")
    for channel in wrong:
        say(f"FALSE: {channel}")
    say(f"left in {out}/: {vehicle}.mcap (recording), {vehicle}.rrd (open with 'rerun'), {vehicle}.png (plot)")
    return 0 if same and not missing and not wrong else 1


def _true_course(truth: Truth, trace: Trace) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return times (s) and true sizes in the unit of the estimates."""
    times_s = trace.vehicle_ns / 1e9
    size = np.array([truth.at(time_s) for time_s in times_s.tolist()])
    if truth.relative:
        size = size * trace.u[:, trace.layout.inputs.index(truth.channel)]
    return times_s, size


def _size(value: float, truth: Truth) -> str:
    return f"{100 * value:+.1f} %" if truth.relative else f"{value:+.3f}"


def _free_port(kind: socket.SocketKind) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
