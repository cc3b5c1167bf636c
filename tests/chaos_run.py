"""A daemon in a process of its own, what a client hears of it, and what it leaves on the disk."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import zenoh
from chaos import KEY, Sufferer, send
from loopback import free_port
from own_records import own_records

from adapters.logs.recordings import read_recording, session_files
from adapters.zenoh.zenoh_session import open_session
from monitor.bus.subscriber import AlarmSubscriber
from monitor.event import AlarmEvent
from monitor.profile import read_profile
from monitor.recording.journal import Journal
from replay.player import play

ROOT = Path(__file__).parent.parent
QUAD = ROOT / "replay" / "data" / "quad"
MOTOR1 = ROOT / "replay" / "data" / "copter_motor1.tlog.xz"
MOTOR1_ONSET_MS = 112_594
WAIT_S = 60.0


def waits(condition: Any, what: str, limit_s: float = WAIT_S) -> None:
    """Wait for a condition; fail with what was waited for."""
    deadline = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < deadline, f"{what}: did not happen within {limit_s:g} s"
        time.sleep(0.02)


def name_of(system: int) -> str:
    return f"copter-{system}"


@dataclass
class Monitor:
    """A daemon, started by :func:`monitoring`, and what a client hears."""

    folder: Path
    udp: str
    endpoint: str
    config: Path
    process: subprocess.Popen[str]
    statuses: dict[str, dict[str, Any]] = field(default_factory=dict)
    events: list[AlarmEvent] = field(default_factory=list)
    subscriber: AlarmSubscriber | None = None

    def alive(self) -> bool:
        return self.process.poll() is None

    def hear(self) -> list[AlarmEvent]:
        """Return all events heard so far."""
        assert self.subscriber is not None
        while (event := self.subscriber.receive(0.0)) is not None:
            self.events.append(event)
        return self.events

    def raised(self, system: int) -> list[AlarmEvent]:
        """Return the alarms of a vehicle about itself, as they were raised."""
        own = [event for event in self.hear() if event.vehicle == name_of(system) and event.state == "raised"]
        return [event for event in own if event.observer != "link"]

    def silent(self) -> set[str]:
        """Return the vehicles whose telemetry is missing by the last alarm event about it."""
        latest = {event.vehicle: event.state for event in self.hear() if event.kind == "stale"}
        return {vehicle for vehicle, state in latest.items() if state != "cleared"}

    def settled_size(self, raised: AlarmEvent) -> float | None:
        """Return an alarm's size as told last within 1.5 s: updates come once a second, the first size is rough."""
        until_ms = raised.vehicle_time_ms + 1500
        told = [event for event in self.events if event.id == raised.id and event.state != "cleared"]
        return [event.relative for event in told if event.vehicle_time_ms <= until_ms][-1]

    def wait_until_live(self, systems: Sequence[int]) -> None:
        names = {name_of(system) for system in systems}

        def live() -> bool:
            assert self.alive(), (self.folder / "daemon.log").read_text()[-2000:]
            return self.subscriber is not None and self.subscriber.live >= names

        waits(live, "all vehicles' tokens")

    def restart(self) -> None:
        self.process = start(self.folder, self.config)

    def stop(self) -> int:
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(WAIT_S)

    def journal(self) -> list[AlarmEvent]:
        journal = Journal(self.folder / "journal.db")
        try:
            return journal.events(limit=100_000)
        finally:
            journal.close()


def start(folder: Path, config: Path) -> subprocess.Popen[str]:
    with (folder / "daemon.log").open("a") as log:
        return subprocess.Popen(
            [sys.executable, "-m", "fauio", "run", "--config", str(config)], cwd=ROOT, stderr=log, text=True
        )


@contextmanager
def monitoring(folder: Path, systems: Sequence[int], more: str = "") -> Iterator[Monitor]:
    """Run a daemon for these vehicles, with journal, recordings, clips and a signing key, and a client of it."""
    udp = f"127.0.0.1:{free_port(socket.SOCK_DGRAM)}"
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    key = folder / "signing.key"
    key.write_bytes(KEY.secret)
    key.chmod(0o600)
    lines = [
        f'mavlink = "udpin:{udp}"',
        f'listen = ["{endpoint}"]',
        "estimate_rate_hz = 2",
        'recording.folder = "recordings"',
        'black_box.folder = "clips"',
        'journal.path = "journal.db"',
        'signing.key_file = "signing.key"',
        # some of its senders have no key
        "signing.require = false",
        more,
    ]
    for system in systems:
        lines += ["[[vehicle]]", f'name = "{name_of(system)}"', f'profile = "{QUAD}"', f"system = {system}"]
    config = folder / "chaos.toml"
    config.write_text("\n".join(lines) + "\n")
    monitor = Monitor(folder, udp, endpoint, config, start(folder, config))
    session = open_session(connect=[endpoint])

    def on_status(sample: zenoh.Sample) -> None:
        monitor.statuses[str(sample.key_expr).split("/")[1]] = json.loads(bytes(sample.payload))

    try:
        monitor.subscriber = AlarmSubscriber(session)
        statuses = session.declare_subscriber("fauio/*/status", on_status)
        monitor.wait_until_live(systems)
        yield monitor
        statuses.undeclare()
    finally:
        session.close()
        monitor.process.kill()
        monitor.process.wait()


@dataclass(frozen=True)
class Run:
    """What is left of a run: the daemon is stopped."""

    monitor: Monitor
    sent: Mapping[int, int]
    exit_status: int


def suffer(folder: Path, sufferers: Sequence[Sufferer]) -> Run:
    """Let one daemon monitor all that suffer, at the same time, from begin to end."""
    systems = [one.system for one in sufferers]
    with monitoring(folder, systems) as monitor:
        sender = send(sufferers, f"udp:{monitor.udp}")
        try:
            said = sender.communicate(timeout=100)[0]
        finally:
            sender.kill()
            sender.wait()
        # The end of the telemetry is told like any silence: all that was sent before has been heard then.
        waits(lambda: all(one["state"] == "stale" for one in monitor.statuses.values()), "statuses: stale")
        waits(lambda: monitor.silent() >= {name_of(system) for system in systems}, "alarms: stale")
        status = monitor.stop()
        return Run(monitor, {int(system): count for system, count in json.loads(said).items()}, status)


def assert_live_equals_replay(run: Run, system: int, folder: Path) -> None:
    """Replay the daemon's own recording: the same samples, estimates and events, bit for bit."""
    name = name_of(system)
    recording = run.monitor.folder / "recordings" / name
    copy = folder / f"{name}.mcap"
    replay = play(read_profile(QUAD), read_recording(recording), vehicle=name, record=copy)
    assert list(replay.events) == [event for event in run.monitor.events if event.vehicle == name]
    live, again = own_records(session_files(recording)), own_records([copy])
    assert set(live) == set(again)
    assert {topic: len(records) for topic, records in live.items()} == {
        topic: len(records) for topic, records in again.items()
    }
    assert live == again


def assert_nothing_reported_is_lost(run: Run, systems: Sequence[int]) -> None:
    """Everything that was heard is in the journal and in the recordings, once."""
    heard = sorted(run.monitor.events, key=lambda event: (event.vehicle, event.seq))
    assert sorted(run.monitor.journal(), key=lambda event: (event.vehicle, event.seq)) == heard
    for system in systems:
        records = own_records(session_files(run.monitor.folder / "recordings" / name_of(system)))
        alarms = [json.loads(data) for data in records["/fauio/alarm_json"]]
        assert alarms == [event.to_json() for event in heard if event.vehicle == name_of(system)]
