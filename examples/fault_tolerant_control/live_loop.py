"""The loop over Zenoh: the simulated arm, its controller and ``fauio run``, each with a session of its own.

    arm        -- arm/telemetry: time, torque, measurement -->  controller, monitor
    monitor    -- fauio/arm/estimate/arm ------------------->  controller
    controller -- arm/command: torque ---------------------->  arm

Arm and controller talk to one another without the monitor in between: if it is gone, the loop goes on without
compensation.
"""

from __future__ import annotations

import json
import queue
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import zenoh
from arm_controller import Controller
from closed_loop import PERIOD_S, PROFILE, TELEMETRY, Estimates
from numpy.typing import NDArray

from fauio import open_session

COMMAND = "arm/command"
ESTIMATE = "fauio/arm/estimate/arm"
TOKEN = "fauio/arm/live"  # noqa: S105 - a liveliness token is no password

_CONFIG = PROFILE.parent / "monitor.toml"
_START_S = 30.0
_STOP_S = 10.0
# At the start the monitor says nothing for a few samples; later it is waited for, where nothing is in a hurry.
_FIRST_PATIENCE_S = 0.02
_PATIENCE_S = 5.0


class ControllerNode(threading.Thread):
    """A controller on Zenoh: it answers each sample of the arm, with the estimate of that sample if it comes in time.

    Parameters
    ----------
    session : zenoh.Session
        Connected to arm and monitor.
    controller : Controller
        What computes the torque.
    patience_s : float
        How long a sample waits for its estimate; then the newest one there is has to do.
    """

    def __init__(self, session: zenoh.Session, controller: Controller, patience_s: float) -> None:
        super().__init__(name="controller", daemon=True)
        self._inbox: queue.SimpleQueue[tuple[str, dict[str, Any]] | None] = queue.SimpleQueue()
        self._controller = controller
        self._patience_s = patience_s
        self._command = session.declare_publisher(COMMAND, congestion_control=zenoh.CongestionControl.DROP)
        # callbacks only queue: one that computes would hold up its whole session
        self._subscribers: list[Any] = [session.declare_subscriber(key, self._take) for key in (TELEMETRY, ESTIMATE)]

    def _take(self, sample: zenoh.Sample) -> None:
        self._inbox.put((str(sample.key_expr), json.loads(sample.payload.to_bytes())))

    def stop(self) -> None:
        """End the thread."""
        self._inbox.put(None)
        self.join()

    def run(self) -> None:
        """Answer samples until told to stop."""
        newest: Estimates = None
        waiting: dict[str, Any] | None = None
        due = 0.0
        while True:
            try:
                taken = self._inbox.get(timeout=max(due - time.monotonic(), 0.0) if waiting else None)
            except queue.Empty:
                taken = ("", {})
            if taken is None:
                return
            key, content = taken
            if key == ESTIMATE:
                newest = content
            elif key == TELEMETRY:
                waiting = content
                due = time.monotonic() + (self._patience_s if newest else _FIRST_PATIENCE_S)
            if waiting and (_answers(newest, waiting) or time.monotonic() >= due):
                self._answer(waiting, newest)
                waiting = None

    def _answer(self, sample: dict[str, Any], estimate: Estimates) -> None:
        torque = self._controller.step(sample["time_ns"] / 1e9, np.array(sample["y"]), estimate)
        self._command.put(json.dumps({"time_ns": sample["time_ns"], "torque": torque, "estimate": estimate}))


def _answers(estimate: Estimates, sample: dict[str, Any]) -> bool:
    return estimate is not None and estimate["vehicle_time_ms"] * 1_000_000 >= sample["time_ns"]


class Loop:
    """The arm's end of the loop, with the daemon and the controller started around it.

    Parameters
    ----------
    controller : Controller
        The controller.
    folder : Path
        For the daemon's configuration and log.
    speed : float | None
        Times real time; the arm takes what command there is when its time has come. None: it waits for each, as fast
        as the answers come, which gives the same result every time.

    Attributes
    ----------
    late : int
        Samples whose command came too late or not at all; the arm held the one before.
    answered_s : list[float]
        For each other sample the time from its measurement to its command.
    """

    def __init__(self, controller: Controller, folder: Path, speed: float | None = None) -> None:
        self.late = 0
        self.answered_s: list[float] = []
        self._speed = speed
        self._next: float | None = None
        monitor, arm = (f"tcp/127.0.0.1:{_free_port()}" for _ in range(2))
        self._daemon = _start_monitor(folder, monitor)
        self._commands: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        self._session = open_session(connect=[monitor], listen=[arm])
        self._theirs = open_session(connect=[monitor, arm])
        try:
            _wait_for_monitor(self._session, self._daemon)
            self._subscriber: Any = self._session.declare_subscriber(COMMAND, self._take)
            self._telemetry = self._session.declare_publisher(
                TELEMETRY, congestion_control=zenoh.CongestionControl.DROP
            )
            patience_s = _PATIENCE_S if speed is None else 0.5 * PERIOD_S / speed
            self._node = ControllerNode(self._theirs, controller, patience_s)
            self._node.start()
            _wait_until_all_hear(self._telemetry, self._theirs)
        except BaseException:
            self._end()
            raise

    def exchange(self, now_s: float, torque: float, y: NDArray[np.float64]) -> tuple[float, Estimates]:
        """Publish a sample and return the next torque with the estimate that it was computed with."""
        time_ns = round(now_s * 1e9)
        sent = time.monotonic()
        if self._next is None:
            self._next = sent
        self._next = sent + 2 * _PATIENCE_S if self._speed is None else self._next + PERIOD_S / self._speed
        self._telemetry.put(json.dumps({"time_ns": time_ns, "u": [torque], "y": y.tolist()}))
        answer = self._answer_to(time_ns, self._next)
        if answer is None:
            self.late += 1
            return torque, None
        self.answered_s.append(time.monotonic() - sent)
        if self._speed is not None:
            time.sleep(max(self._next - time.monotonic(), 0.0))
        return answer["torque"], answer["estimate"]

    def _answer_to(self, time_ns: int, until: float) -> dict[str, Any] | None:
        while True:
            try:
                command = self._commands.get(timeout=max(until - time.monotonic(), 0.0))
            except queue.Empty:
                return None
            if command["time_ns"] == time_ns:
                return command

    def _take(self, sample: zenoh.Sample) -> None:
        self._commands.put(json.loads(sample.payload.to_bytes()))

    def _end(self) -> None:
        self._theirs.close()  # type: ignore[no-untyped-call]
        self._session.close()  # type: ignore[no-untyped-call]
        self._daemon.send_signal(signal.SIGTERM)
        try:
            self._daemon.wait(_STOP_S)
        except subprocess.TimeoutExpired:
            self._daemon.kill()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._node.stop()
        self._end()


def _start_monitor(folder: Path, endpoint: str) -> subprocess.Popen[bytes]:
    text = _CONFIG.read_text().replace('"arm/"', json.dumps(str(PROFILE))).replace("tcp/127.0.0.1:7447", endpoint)
    config = folder / "monitor.toml"
    config.write_text(text)
    with (folder / "monitor.log").open("wb") as log:
        command = [sys.executable, "-m", "fauio", "run", "--config", str(config)]
        return subprocess.Popen(command, stderr=log)  # noqa: S603 - our own program with our own arguments


def _wait_for_monitor(session: zenoh.Session, daemon: subprocess.Popen[bytes]) -> None:
    """Wait for the daemon's liveliness token: from then on it hears and answers."""
    deadline = time.monotonic() + _START_S
    while not any(reply.ok for reply in session.liveliness().get(TOKEN, timeout=0.5)):
        if daemon.poll() is not None or time.monotonic() > deadline:
            raise RuntimeError("the monitor did not start; monitor.log says why")
        time.sleep(0.05)


def _wait_until_all_hear(telemetry: zenoh.Publisher, controller: zenoh.Session) -> None:
    """Wait until the arm's samples and the controller's commands have somebody who gets them."""
    deadline = time.monotonic() + _START_S
    with controller.declare_publisher(COMMAND) as commands:
        while len(list(controller.info.peers_zid())) < 2 or not all(
            _has_subscriber(one) for one in (telemetry, commands)
        ):
            if time.monotonic() > deadline:
                raise RuntimeError("arm, controller and monitor do not hear each other; is loopback TCP blocked?")
            time.sleep(0.02)
    # what the controller subscribed to has to reach the other two
    time.sleep(0.2)


def _has_subscriber(publisher: Any) -> bool:
    # Zenoh's type stub calls it a bool; it is an object.
    return bool(publisher.matching_status.matching)


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
