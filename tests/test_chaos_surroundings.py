"""What breaks around a monitor that watches: it goes on or says so, and the failing motor is alarmed."""

from __future__ import annotations

import json
import shutil
import signal
import socket
import time
from collections.abc import Callable
from pathlib import Path

import chaos
import pytest
from chaos import Sufferer
from chaos_run import MOTOR1, Monitor, monitoring, name_of, waits

pytestmark = pytest.mark.long


def freeze(monitor: Monitor) -> None:
    """Stop the whole process for 5 s."""
    monitor.process.send_signal(signal.SIGSTOP)
    time.sleep(5.0)
    monitor.process.send_signal(signal.SIGCONT)


def delete_recordings(monitor: Monitor) -> None:
    shutil.rmtree(monitor.folder / "recordings")


def cut_journal(monitor: Monitor) -> None:
    """Cut the journal to half; its shared memory is left, as a program whose mapped memory is cut gets a signal."""
    for path in (monitor.folder / "journal.db", monitor.folder / "journal.db-wal"):
        with path.open("r+b") as file:
            file.truncate(path.stat().st_size // 2)


def crowd(monitor: Monitor) -> None:
    """Announce 64 vehicles at once."""
    host, port = monitor.udp.split(":")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        for system in range(100, 164):
            sender = chaos.ardupilotmega.MAVLink(None, srcSystem=system, srcComponent=1)
            beat = chaos.ardupilotmega.MAVLink_heartbeat_message(2, 3, 209, 0, 4, 3)
            out.sendto(beat.pack(sender), (host, int(port)))


TROUBLES: dict[str, Callable[[Monitor], None]] = {
    "frozen for 5 s": freeze,
    "recordings deleted": delete_recordings,
    "journal cut": cut_journal,
    "64 vehicles at once": crowd,
}


@pytest.mark.parametrize("what", TROUBLES)
def test_the_fault_is_alarmed_whatever_breaks_around_the_monitor(tmp_path: Path, what: str) -> None:
    with monitoring(tmp_path, [1]) as monitor:
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
