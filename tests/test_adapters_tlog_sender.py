"""Sending a recorded flight: the very packets, over a real socket, from the command line as well."""

from __future__ import annotations

import subprocess
import sys
import threading
from pathlib import Path

import pytest

from adapters.batch import messages as each
from adapters.errors import TelemetryError
from adapters.logs.recordings import read_recording
from adapters.mavlink.mavlink_link import MavlinkLink
from adapters.message import Message
from adapters.simulation.tlog_sender import main, send_tlog
from replay.demonstration.demo import _copter_scene

ROOT = Path(__file__).parent.parent
FLIGHT = ROOT / "tests" / "data" / "copter_5s.tlog.xz"


def contents(messages: list[Message]) -> list[tuple[str, int, str]]:
    """Return what was sent, system by system: a link that is behind takes turns among them."""
    return sorted(
        ((message.name, message.system, repr(dict(message.fields))) for message in messages), key=lambda one: one[1]
    )


def test_renumbered_packets_lack_none(port: int) -> None:
    expected = contents(list(read_recording(FLIGHT)))
    with MavlinkLink(f"udpin:127.0.0.1:{port}") as link:
        sender = threading.Thread(
            target=send_tlog, args=(FLIGHT, f"udp:127.0.0.1:{port}", 10.0), kwargs={"renumber": True}
        )
        sender.start()
        received: list[Message] = []
        while len(received) < len(expected):
            received += each(link.receive(0.2))
        sender.join()
        assert contents(received) == expected
        assert sum(link.statistics().lost_by_system.values()) == 0


def test_a_link_receives_what_the_log_holds(port: int) -> None:
    expected = contents(list(read_recording(FLIGHT)))
    with MavlinkLink(f"udpin:127.0.0.1:{port}") as link:
        sender = threading.Thread(target=send_tlog, args=(FLIGHT, f"udp:127.0.0.1:{port}", 10.0))
        sender.start()
        received: list[Message] = []
        while len(received) < len(expected):
            received += [*each(link.receive(0.2))]
        sender.join()
    assert contents(received) == expected


def test_another_process_sends_from_the_command_line(port: int) -> None:
    command = [
        sys.executable,
        "-m",
        "adapters.simulation.tlog_sender",
        str(FLIGHT),
        f"udp:127.0.0.1:{port}",
        "--speed",
        "20",
    ]
    with MavlinkLink(f"udpin:127.0.0.1:{port}") as link:
        sender = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True)
        received: list[Message] = []
        while len(received) < 1_000:
            received += [*each(link.receive(0.2))]
        _, said = sender.communicate()
    assert sender.returncode == 0
    assert said.endswith(" packets sent\n")


def test_the_demonstrations_flight_is_sent(port: int) -> None:
    with MavlinkLink(f"udpin:127.0.0.1:{port}") as link:
        sender = subprocess.Popen(_copter_scene().sender(f"127.0.0.1:{port}", 50.0), cwd=ROOT, stderr=subprocess.PIPE)
        received: list[Message] = []
        while len(received) < 100:
            assert sender.poll() is None
            received += each(link.receive(0.2))
        sender.kill()
        sender.communicate()


@pytest.mark.parametrize(
    "args",
    [
        ["none.tlog", "udp:127.0.0.1:9"],
        [str(FLIGHT), "127.0.0.1:9"],
        [str(FLIGHT), "udp:here"],
        [str(FLIGHT), "tcp:127.0.0.1:9"],
    ],
)
def test_what_cannot_be_sent_is_reported_in_one_line(args: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(args) == 2
    said = capsys.readouterr().err
    assert said.startswith("tlog_sender: ")
    assert said.count("\n") == 1


def test_an_unknown_host_is_reported() -> None:
    with pytest.raises(TelemetryError, match="cannot be resolved"):
        send_tlog(FLIGHT, "udp:no-such-host.invalid:9")
