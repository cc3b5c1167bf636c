"""Recording live telemetry without a profile, and what is made of it."""

from __future__ import annotations

import contextlib
import json
import resource
import signal
import socket
import subprocess
import time
from itertools import islice
from pathlib import Path

import pytest
from daemons import ENVIRONMENT, FAUIO, Flight, free_ports
from loopback import publisher, until
from packet_stream import PacketStream

import fauio
from adapters.logs.recordings import read_recording
from adapters.logs.tlog import TlogReader
from adapters.mavlink.mavlink_message import message_number
from adapters.simulation.pacing import paced
from adapters.source import MAVLINK, ZENOH
from adapters.zenoh.zenoh_session import open_session

PATIENCE_S = 30.0
ATTITUDE, COMMAND_LONG = 30, 76


class Recording:
    """``fauio record`` in a process of its own."""

    def __init__(self, out: Path, *options: str) -> None:
        self.log = out.with_suffix(".log")
        with self.log.open("w") as log:
            command = [*FAUIO, "record", "-o", str(out), "--json", *options]
            self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, env=ENVIRONMENT, text=True)
        self.until('"recording"')

    def until(self, text: str) -> None:
        """Wait until its log holds a text."""
        until(lambda: text in self.log.read_text(), 0.02)

    def end(self, number: signal.Signals | None = None) -> tuple[int, str]:
        """Let it end; return its status and what it printed."""
        if number is not None:
            self.process.send_signal(number)
        said, _ = self.process.communicate(timeout=PATIENCE_S)
        return self.process.returncode, said


def telemetry(path: Path) -> list[tuple[str, str]]:
    return [(one.name, repr(one.fields)) for one in read_recording(path) if one.source in (MAVLINK, ZENOH)]


def by_system(path: Path, count: int | None = None) -> dict[int, list[tuple[str, str]]]:
    """Return what each system of a MAVLink recording's first messages has sent, in order."""
    found: dict[int, list[tuple[str, str]]] = {}
    for one in islice((one for one in read_recording(path) if one.source is MAVLINK), count):
        found.setdefault(one.system, []).append((one.name, repr(one.fields)))
    return found


def arrived(path: Path, count: int) -> None:
    """Wait until so many messages are in a recording that goes on."""
    until(lambda: len(telemetry(path)) >= count, 0.2)


def test_every_message_of_a_link_is_recorded(data: Path, tmp_path: Path) -> None:
    [port] = free_ports(1, socket.SOCK_DGRAM)
    out = tmp_path / "monday.mcap"
    recording = Recording(out, "--mavlink", f"udpin:127.0.0.1:{port}")
    packets = [packet for _, packet in TlogReader(data / "copter_5s.tlog.xz").packets()][:600]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for packet in packets:
            sender.sendto(packet, ("127.0.0.1", port))
            time.sleep(0.0005)
    arrived(out, 500)
    status, said = recording.end(signal.SIGTERM)
    found = json.loads(said)
    assert (status, found["file"], found["dropped"], found["interrupted"]) == (0, str(out), 0, False)
    sent, there = by_system(data / "copter_5s.tlog.xz", 600), by_system(out)
    # each sender waits in a queue of its own: their order among one another is that of the turns they take
    assert there.keys() == sent.keys()
    assert all(messages == sent[system][: len(messages)] for system, messages in there.items())
    assert sum(map(len, there.values())) == found["messages"] >= 500
    assert 1 in found["systems"]


def test_it_ends_by_itself_and_what_it_made_can_be_looked_at_and_fitted_to(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    [port] = free_ports(1, socket.SOCK_DGRAM)
    out = tmp_path / "monday.mcap"
    recording = Recording(out, "--mavlink", f"udpin:127.0.0.1:{port}", "--seconds", "3")
    with Flight(data / "copter_healthy_square.tlog.xz", [port], 0.0):
        status, said = recording.end()
    assert status == 0
    assert 2.5 <= json.loads(said)["seconds"] <= 10.0
    assert fauio.main(["info", str(out)]) == 0
    assert "multirotor at" in capsys.readouterr().out
    # three seconds are too few: but it got as far as that
    assert fauio.main(["fit", "--vehicle", "multirotor", str(out), "-o", str(tmp_path / "quad")]) == 2
    assert "s of healthy flight in the logs" in capsys.readouterr().err


def test_what_comes_over_zenoh_is_recorded_and_ctrl_c_is_told_from_the_end(tmp_path: Path) -> None:
    [port] = free_ports(1)
    endpoint, out = f"tcp/127.0.0.1:{port}", tmp_path / "arm.mcap"
    recording = Recording(out, "--zenoh", "arm/telemetry", "--listen", endpoint)
    with open_session(connect=[endpoint]) as session:
        sender = publisher(session, "arm/telemetry")
        for k in range(20):
            sender.put(json.dumps({"time_ns": 10**18 + k, "y": [float(k)]}))
        arrived(out, 20)
        status, said = recording.end(signal.SIGINT)
    assert (status, json.loads(said)["messages"], json.loads(said)["interrupted"]) == (130, 20, True)
    assert [one.fields["y"] for one in read_recording(out)] == [[float(k)] for k in range(20)]


def test_a_full_disk_ends_it_with_a_line_and_what_was_recorded_stands(data: Path, tmp_path: Path) -> None:
    [port] = free_ports(1, socket.SOCK_DGRAM)
    out = tmp_path / "monday.mcap"
    recording = Recording(out, "--mavlink", f"udpin:127.0.0.1:{port}")
    # no file may grow beyond this: writing fails as on a full disk
    resource.prlimit(recording.process.pid, resource.RLIMIT_FSIZE, (30_000, resource.RLIM_INFINITY))
    with Flight(data / "copter_healthy_square.tlog.xz", [port], 0.0):
        status, said = recording.end()
    assert (status, said) == (2, "")
    assert f"fauio: {out}: File too large; telemetry up to a second before is in it" in recording.log.read_text()
    messages = list(read_recording(out))
    assert (messages[-1].received_ns - messages[0].received_ns) / 1e9 > 0.5


def test_it_asks_for_the_rates_of_a_configuration_whose_profile_is_yet_to_be_made(data: Path, tmp_path: Path) -> None:
    [port] = free_ports(1, socket.SOCK_DGRAM)
    config = tmp_path / "fauio.toml"
    config.write_text(
        f'profile = "quad"\nmavlink = "udpin:127.0.0.1:{port}"\n[send]\nallow = true\nrates = {{ ATTITUDE = 100 }}\n'
    )
    recording = Recording(tmp_path / "monday.mcap", "--config", str(config))
    log = ((time_ns, packet) for time_ns, packet in TlogReader(data / "copter_healthy_square.tlog.xz").packets())
    slow = ((time_ns, packet) for time_ns, packet in log if message_number(packet) != ATTITUDE)
    asked: set[int] = set()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle:
        vehicle.setblocking(False)
        for packet in paced(slow, 1.0):
            vehicle.sendto(packet, ("127.0.0.1", port))
            with contextlib.suppress(BlockingIOError):
                asked |= {message_number(packet) for packet in PacketStream().packets(vehicle.recv(4096))}
            if COMMAND_LONG in asked:
                break
    assert COMMAND_LONG in asked
    assert recording.end(signal.SIGTERM)[0] == 0


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ([], "no telemetry to listen to: give --mavlink URL or --zenoh KEYEXPR"),
        (["--mavlink", "udpin:0.0.0.0:14550"], "allow"),
        (["--mavlink", "carrier-pigeon:1"], "carrier-pigeon"),
        (["--mavlink", "udpin:127.0.0.1:0", "--seconds", "-1"], "'-1' is no time in seconds above 0"),
    ],
)
def test_a_wrong_option_is_one_line_and_no_file(
    options: list[str], complaint: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "monday.mcap"
    command = ["record", "-o", str(out), *options]
    try:
        status = fauio.main(command)
    except SystemExit as error:
        status = int(str(error.code))
    assert status == 2
    said = capsys.readouterr().err
    assert complaint in said
    assert len(said.strip().splitlines()) == 1
    assert not out.exists()


def test_a_recording_is_never_written_over(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "monday.mcap"
    out.write_text("precious")
    assert fauio.main(["record", "-o", str(out), "--mavlink", "udpin:127.0.0.1:0"]) == 2
    assert "already exists" in capsys.readouterr().err
    assert out.read_text() == "precious"


def test_a_recording_to_which_nothing_came_is_not_left_behind(tmp_path: Path) -> None:
    out = tmp_path / "monday.mcap"
    recording = Recording(out, "--mavlink", "udpin:127.0.0.1:0")
    assert recording.end(signal.SIGTERM) == (2, "")
    assert "not written: nothing was received over udpin:127.0.0.1:0" in recording.log.read_text()
    assert not out.exists()
