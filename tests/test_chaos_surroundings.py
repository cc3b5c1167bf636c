"""What breaks around a monitor that watches: it goes on or says so, and the failing motor is alarmed."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path

import chaos
import pytest
from chaos import Sufferer
from chaos_run import MOTOR1, Monitor, monitoring, name_of, waits
from loopback import free_port

pytestmark = pytest.mark.long

FAULT_BEGINS_S = 8.0
"""How long what goes on is done: the fault begins 8.6 s after the first packet."""


def freeze(monitor: Monitor) -> None:
    """Stop the whole process for 5 s."""
    monitor.process.send_signal(signal.SIGSTOP)
    time.sleep(5.0)
    monitor.process.send_signal(signal.SIGCONT)


def delete_recordings(monitor: Monitor) -> None:
    shutil.rmtree(monitor.folder / "recordings")


def cut_journal(monitor: Monitor) -> None:
    """Cut the journal's files to half, all of them."""
    for path in monitor.folder.glob("journal.db*"):
        with path.open("r+b") as file:
            file.truncate(path.stat().st_size // 2)


def delete_journal(monitor: Monitor) -> None:
    """Delete the journal's files, all of them."""
    for path in monitor.folder.glob("journal.db*"):
        path.unlink()


def send_for(monitor: Monitor, seconds: float, packets: Sequence[bytes], pause_s: float) -> None:
    """Send packets again and again, with a pause after each round."""
    host, port = monitor.udp.split(":")
    until_s = time.monotonic() + seconds
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        while time.monotonic() < until_s:
            for packet in packets:
                out.sendto(packet, (host, int(port)))
            time.sleep(pause_s)


def crowd(monitor: Monitor) -> None:
    """Announce 64 vehicles, ten times a second while the fault begins."""
    kinds = chaos.ardupilotmega
    beat = kinds.MAVLink_heartbeat_message(2, 3, 209, 0, 4, 3)
    attitude = kinds.MAVLink_attitude_message(5, *[0.1] * 6)
    senders = [kinds.MAVLink(None, srcSystem=system, srcComponent=1) for system in range(100, 164)]
    packets = [bytes(message.pack(sender)) for sender in senders for message in (beat, attitude)]
    send_for(monitor, FAULT_BEGINS_S, packets, 0.1)


def flood(monitor: Monitor) -> None:
    """Let the other vehicle send some ten thousand packets a second."""
    packets = [packet for _, packet in Sufferer(2, MOTOR1, "none", 1.0).packets(time.time_ns())]
    send_for(monitor, FAULT_BEGINS_S, packets[:200], 0.01)


def command(monitor: Monitor) -> None:
    """Let a stranger steer the vehicle and disarm it, some thousand messages a second."""
    kinds, sender = chaos.ardupilotmega, chaos.ardupilotmega.MAVLink(None, srcSystem=66, srcComponent=1)
    steers = kinds.MAVLink_manual_control_message(1, 900, 0, 500, 0, 0)
    disarms = kinds.MAVLink_command_long_message(1, 1, 400, 0, 0.0, 21196.0, 0, 0, 0, 0, 0)
    send_for(monitor, FAULT_BEGINS_S, [bytes(message.pack(sender)) for message in (steers, disarms)] * 10, 0.01)
    (raised,) = [one for one in monitor.hear() if (one.channel, one.state) == ("command", "raised")]
    assert "system 66, component 1, which had not commanded before, disarms" in raised.message


def half_open_peers(monitor: Monitor) -> None:
    """Connect to Zenoh again and again: peers that say nothing, and others that say nonsense."""
    host, port = monitor.endpoint.removeprefix("tcp/").split(":")
    with ExitStack() as stack:
        for number in range(100):
            peer = stack.enter_context(socket.create_connection((host, int(port))))
            if number % 2:
                peer.sendall(random.Random(number).randbytes(1000))
        time.sleep(FAULT_BEGINS_S)


def busy_host(monitor: Monitor) -> None:
    """Let other programs use every processor, twice over."""
    idle = [sys.executable, "-c", "while True: pass"]
    others = [subprocess.Popen(idle) for _ in range(2 * (os.cpu_count() or 1))]
    try:
        time.sleep(FAULT_BEGINS_S)
    finally:
        for other in others:
            other.kill()
            other.wait()


TROUBLES: dict[str, Callable[[Monitor], None]] = {
    "frozen for 5 s": freeze,
    "recordings deleted": delete_recordings,
    "journal cut": cut_journal,
    "journal deleted": delete_journal,
    "64 vehicles at once": crowd,
    "another vehicle floods": flood,
    "a stranger commands": command,
    "half-open Zenoh peers": half_open_peers,
    "busy host": busy_host,
}


@pytest.mark.parametrize("what", TROUBLES)
def test_the_fault_is_alarmed_whatever_breaks_around_the_monitor(tmp_path: Path, what: str) -> None:
    with monitoring(tmp_path, [1, 2]) as monitor:
        sender = chaos.send([Sufferer(1, MOTOR1, "none", 12.0)], f"udp:{monitor.udp}")
        try:
            waits(lambda: monitor.statuses.get(name_of(1), {}).get("samples", 0) > 100, "samples")
            TROUBLES[what](monitor)
            waits(lambda: monitor.raised(1), "the motor's alarm", 20.0)
            sent = json.loads(sender.communicate(timeout=60)[0])
        finally:
            sender.kill()
            sender.communicate()
        assert sent["1"] > 0
        assert [event.channel for event in monitor.raised(1)] == ["motor1"]
        assert monitor.stop() == 0
    assert "Traceback" not in (tmp_path / "daemon.log").read_text()


def test_telemetry_that_comes_ten_seconds_late_is_not_called_healthy(tmp_path: Path) -> None:
    port = free_port()
    packets = Sufferer(1, MOTOR1, "none", 30.0).packets(time.time_ns())
    late_s, sent = 10.0, 0
    with monitoring(tmp_path, [1], f'metrics.listen = "127.0.0.1:{port}"') as monitor:
        host, to = monitor.udp.split(":")

        def said() -> str:
            """Send what is due; return what is not right."""
            nonlocal sent
            since_s = time.monotonic() - begun_s
            due_ns = 1e9 * (since_s if since_s < 3.0 else max(3.0, since_s - late_s))
            while sent < len(packets) and packets[sent][0] <= due_ns:
                out.sendto(packets[sent][1], (host, int(to)))
                sent += 1
            try:
                with urllib.request.urlopen(f"http://127.0.0.1:{port}/healthz", timeout=2.0) as answer:
                    return str(answer.read().decode())
            except urllib.error.HTTPError as refusal:
                return refusal.read().decode()
            except urllib.error.URLError:
                return ""  # not listening yet

        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            begun_s = time.monotonic()
            waits(lambda: "s late by its own clock" in said(), "healthz tells of late telemetry", 3.0 + late_s + 15.0)
