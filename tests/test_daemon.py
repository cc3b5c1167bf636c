"""One daemon with several vehicles: who appears, who commands, what is kept, and what changes while it runs."""

import json
import shutil
import signal
import socket
import subprocess
import sys
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from loopback import free_port, heard, until
from packet_edit import readdressed

import fauio
from adapters.logs.recordings import read_recording
from adapters.logs.tlog import TlogReader
from adapters.simulation.pacing import paced
from adapters.zenoh.zenoh_session import open_session
from monitor.bus.subscriber import AlarmSubscriber
from monitor.event import AlarmEvent
from monitor.profile import Profile
from monitor.recording.journal import Journal
from replay.player import play

FAUIO = (sys.executable, "-m", "fauio")
PATIENCE_S = 60.0


class RunningDaemon:
    """A daemon with its files, and a session of a client of it."""

    def __init__(self, folder: Path, profile: Path, extra: str) -> None:
        self.folder = folder
        self.senders: list[threading.Thread] = []
        self.closed = threading.Event()
        self.udp = f"127.0.0.1:{free_port(socket.SOCK_DGRAM)}"
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        self.metrics = f"127.0.0.1:{free_port()}"
        self.config = folder / "fauio.toml"
        self.write_config(profile, extra)
        command = [*FAUIO, "run", "--config", str(self.config), "--json"]
        self.log = (folder / "log.jsonl").open("w")
        self.process = subprocess.Popen(command, stderr=self.log)
        self.session = open_session(connect=[self.endpoint])

    def write_config(self, profile: Path, extra: str) -> None:
        top = f'profile = "{profile}"\nmavlink = "udpin:{self.udp}"\nlisten = ["{self.endpoint}"]\n'
        self.config.write_text(f'{top}{extra}\n[metrics]\nlisten = "{self.metrics}"\n')

    def logged(self, event: str) -> list[dict[str, Any]]:
        lines = (self.folder / "log.jsonl").read_text().splitlines()
        found = [json.loads(line) for line in lines if line.startswith("{") and line.endswith("}")]
        return [line for line in found if line["event"] == event]

    def command(self, vehicle: str, verb: str, **fields: Any) -> dict[str, Any]:
        replies = self.session.get(f"fauio/{vehicle}/command/{verb}", payload=json.dumps(fields))
        [reply] = list(replies)
        payload = reply.ok.payload if reply.ok is not None else reply.err.payload
        return dict(json.loads(payload.to_bytes()))

    def status(self, vehicle: str) -> dict[str, Any]:
        found: list[dict[str, Any]] = []
        key = f"fauio/{vehicle}/status"
        with self.session.declare_subscriber(key, lambda s: found.append(json.loads(s.payload.to_bytes()))):
            until(lambda: found)
        return found[-1]

    def fetch(self, path: str) -> str:
        with urllib.request.urlopen(f"http://{self.metrics}{path}", timeout=10) as answer:
            return str(answer.read().decode())

    def problems(self) -> list[str]:
        """Return what /healthz, which is renewed once a second, says is wrong."""
        try:
            answer = self.fetch("/healthz")
        except urllib.error.HTTPError as error:
            answer = error.read().decode()
        return list(json.loads(answer)["problems"])

    def send(self, log: Path, system: int, start_s: float = 0.0, speed: float = 2.0) -> threading.Thread:
        """Send a flight from a second on, by default twice as fast as it was flown."""
        arguments = log, self.udp, system, self.closed, start_s, speed
        self.senders.append(threading.Thread(target=relay, args=arguments))
        self.senders[-1].start()
        return self.senders[-1]

    def close(self) -> None:
        self.closed.set()
        for sender in self.senders:
            sender.join()
        self.session.close()
        self.process.kill()
        self.process.wait()
        self.log.close()


CONFIG = """
[[vehicle]]
name = "first"
system = 1
latched = ["motors/motor2"]
[new_vehicles]
profile = "{profile}"
limit = 1
[recording]
folder = "recordings"
file_minutes = 0.1
[black_box]
folder = "clips"
before_s = 3
after_s = 2
[journal]
path = "journal.db"
[commands]
allow = ["ack", "shelve", "unshelve", "reset"]
"""


@pytest.fixture
def daemon(tmp_path: Path, quad_folder: Path) -> Iterator[RunningDaemon]:
    found = RunningDaemon(tmp_path, quad_folder, CONFIG.format(profile=quad_folder))
    try:
        yield found
    finally:
        found.close()


def raised(events: list[AlarmEvent]) -> list[tuple[str, str]]:
    return [(event.vehicle, event.channel) for event in events if event.state == "raised" and event.kind != "stale"]


def test_vehicles_named_and_new_are_watched_commanded_recorded_and_journaled(
    daemon: RunningDaemon, data: Path, quad_profile: Profile, quad_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    subscriber = AlarmSubscriber(daemon.session)
    until(lambda: "first" in subscriber.live)
    senders = [
        daemon.send(data / "copter_motor2_080.tlog.xz", 1),
        daemon.send(data / "copter_motor3_090.tlog.xz", 7),
    ]
    until(lambda: "vehicle-7" in subscriber.live)
    senders.append(daemon.send(data / "copter_wind_step.tlog.xz", 9))
    events = heard(subscriber, lambda found: len(raised(found)) >= 2)
    assert sorted(raised(events)) == [("first", "motor2"), ("vehicle-7", "motor3")]
    assert "vehicle-9" not in subscriber.live
    [refused] = until(lambda: daemon.logged("vehicle refused"), 0.02)
    assert (refused["system"], refused["reason"]) == (9, "[new_vehicles] limit is reached")
    [motor2] = {event.id for event in events if event.channel == "motor2"}

    answer = daemon.command("first", "ack", id=motor2, by="eve")
    assert answer["ok"]
    assert (answer["event"]["state"], answer["event"]["acknowledged"]) == ("acknowledged", True)
    assert "acknowledged by eve" in answer["event"]["message"]
    assert daemon.command("first", "ack", id="01NONE")["error"].startswith("no alarm '01NONE' is active")
    shelved = daemon.command("vehicle-7", "shelve", channel="motors/motor3", minutes=5)
    assert shelved["event"]["state"] == "shelved"
    assert "motors/motor3" in daemon.status("vehicle-7")["shelved"]
    for sender in senders:
        sender.join(PATIENCE_S)
    until(lambda: daemon.status("first")["state"] == "stale")
    rest = heard(subscriber, lambda found: sum(event.kind == "stale" for event in found) >= 2)
    assert not raised(rest)

    page = daemon.fetch("/metrics")
    assert 'fauio_observer_samples_total{observer="motors",vehicle="first"}' in page
    assert 'fauio_vehicle_active_alarms{severity="critical",vehicle="first"} 1.0' in page
    ended = [f"{name}: telemetry ended in flight: nothing is watched" for name in ("first", "vehicle-7")]
    until(lambda: daemon.problems() == ended)
    daemon.process.send_signal(signal.SIGTERM)
    assert daemon.process.wait(PATIENCE_S) == 0
    journal = Journal(daemon.folder / "journal.db")
    try:
        history = journal.events("first")
        frame = journal.frame(motor2)
    finally:
        journal.close()
    first = history[0].seq
    assert [event.seq for event in history] == list(range(first, first + len(history)))
    assert frame is not None
    assert frame["observers"]["motors"]["thresholds"]["motor2"] > 0
    recording = daemon.folder / "recordings" / "first"
    assert len(list(recording.iterdir())) > 1
    assert list(play(quad_profile, read_recording(recording), vehicle="first").events) == history
    capsys.readouterr()
    assert fauio.main(["replay", str(quad_folder), str(recording), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["alarms"] == [event.to_json() for event in history]
    [clip] = (daemon.folder / "clips" / "first").glob(f"*{motor2}.mcap")
    again = play(quad_profile, read_recording(clip), vehicle="first").events
    assert "motor2" in {event.channel for event in again if event.state == "raised"}


def test_a_reload_changes_thresholds_without_losing_a_sample_and_a_wrong_one_changes_nothing(
    tmp_path: Path, quad_folder: Path, data: Path
) -> None:
    profile = Path(shutil.copytree(quad_folder, tmp_path / "quad"))
    daemon = RunningDaemon(tmp_path, profile, '[[vehicle]]\nname = "first"\nsystem = 1\n')
    try:
        subscriber = AlarmSubscriber(daemon.session)
        until(lambda: "first" in subscriber.live)
        # a busy machine holds a daemon up for longer than a port holds twice as many packets
        sender = daemon.send(data / "copter_motor2_080.tlog.xz", 1, start_s=7.0, speed=1.0)
        until(lambda: daemon.status("first")["samples"] > 0)
        daemon.config.write_text("inbox = -1\n")
        daemon.process.send_signal(signal.SIGHUP)
        until(lambda: daemon.logged("reload failed"), 0.02)
        text = (profile / "profile.toml").read_text()
        place = text.index("[observers.motors.alarms.motor2]")
        head, tail = text[:place], text[place:]
        (profile / "profile.toml").write_text(head + tail.replace("threshold = ", "threshold = 9", 1))
        daemon.write_config(
            profile, '[[vehicle]]\nname = "first"\nsystem = 1\n[[vehicle]]\nname = "second"\nsystem = 2\n'
        )
        daemon.process.send_signal(signal.SIGHUP)
        until(lambda: daemon.logged("reloaded"), 0.02)
        until(lambda: "second" in subscriber.live)
        sender.join(PATIENCE_S)
        status = until(lambda: (found := daemon.status("first"))["state"] == "stale" and found)
        motors = status["observers"]["motors"]
        assert (motors["skipped"], motors["restarts"], motors["incomplete"]) == (0, 1, 0)
    finally:
        daemon.close()


def relay(log: Path, address: str, system: int, closed: threading.Event, start_s: float, speed: float) -> None:
    """Send a log under another system id."""
    host, port = address.split(":")
    packets = list(TlogReader(log).packets())
    since_ns = packets[0][0] + round(start_s * 1e9)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        for number, packet in enumerate(paced([one for one in packets if one[0] >= since_ns], speed)):
            if closed.is_set():
                return
            out.sendto(readdressed(packet, system, number % 256), (host, int(port)))
