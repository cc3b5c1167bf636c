"""The daemon beside a real sender, with subscribers in other processes: what comes live equals the replay."""

import json
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from loopback import free_port, heard, until

import fauio
from adapters.logs.recordings import read_recording
from adapters.logs.tlog import TlogReader
from adapters.source import CLOCK, MAVLINK
from adapters.zenoh.zenoh_session import open_session
from monitor.bus.subscriber import AlarmSubscriber
from monitor.event import AlarmEvent, event_from_json
from monitor.profile import Profile
from replay.player import play

FAUIO = (sys.executable, "-m", "fauio")


class Live(NamedTuple):
    """A running daemon."""

    process: subprocess.Popen[str]
    udp: str
    endpoint: str
    record: Path


@pytest.fixture
def live(quad_folder: Path, tmp_path: Path) -> Iterator[Live]:
    udp = f"127.0.0.1:{free_port(socket.SOCK_DGRAM)}"
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    record = tmp_path / "live.mcap"
    command = [*FAUIO, "run", str(quad_folder), "--mavlink", f"udpin:{udp}", "--listen", endpoint]
    process = subprocess.Popen(
        [*command, "--record", str(record)], stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    try:
        yield Live(process, udp, endpoint, record)
    finally:
        process.kill()
        process.communicate()


def send(live: Live, log: Path, speed: float) -> None:
    command = [
        sys.executable,
        "-m",
        "adapters.simulation.tlog_sender",
        str(log),
        f"udp:{live.udp}",
        "--speed",
        str(speed),
    ]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)


def said_next(process: subprocess.Popen[str]) -> dict[str, Any]:
    """Return the next line of the log that does not say how the vehicle's status has changed."""
    assert process.stderr is not None
    while True:
        line: dict[str, Any] = json.loads(process.stderr.readline())
        if line["event"] != "status":
            return line


def unread(port: int) -> int:
    """Return the number of bytes of datagrams that wait for the one who listens on a port of loopback."""
    rows = (row.split() for row in Path("/proc/net/udp").read_text().splitlines()[1:])
    return sum(int(row[4].split(":")[1], 16) for row in rows if row[1] == f"0100007F:{port:04X}")


def essence(events: list[AlarmEvent]) -> list[tuple[object, ...]]:
    """All of an event that does not depend on when its packets happened to arrive."""
    return [
        (e.channel, e.state, e.severity, e.vehicle_time_ms, e.estimate, e.relative, e.message)
        for e in events
        if e.kind != "stale"
    ]


def test_all_who_listen_hear_what_the_replay_says_whatever_garbage_came_and_the_recording_survives_a_kill(
    live: Live, quad_profile: Profile, data: Path
) -> None:
    log = data / "copter_motor2_080.tlog.xz"
    expected = list(play(quad_profile, read_recording(log)).events)
    assert expected
    command = [*FAUIO, "alarms", "--json", "--connect", live.endpoint]
    printer = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    session = open_session(connect=[live.endpoint])
    late_session = open_session(connect=[live.endpoint])
    try:
        subscriber = AlarmSubscriber(session)
        until(lambda: subscriber.live)
        host, port = live.udp.split(":")
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as noise:
            for k in range(200):
                noise.sendto(bytes((k * j) % 256 for j in range(k)), (host, int(port)))
        send(live, log, speed=4.0)
        events = heard(subscriber, lambda found: bool(found) and found[-1].kind == "stale")
        assert essence(events) == essence(expected)
        assert (events[-1].channel, events[-1].state) == ("telemetry", "raised")
        late = AlarmSubscriber(late_session, history=True)
        assert heard(late, lambda found: len(found) >= len(events)) == events
        replies = [reply.ok for reply in late_session.get(f"fauio/{quad_profile.name}/alarms")]
        active = [event_from_json(item) for reply in replies if reply for item in json.loads(bytes(reply.payload))]
        assert sorted(event.channel for event in active) == ["motor2", "telemetry"]
        assert printer.stdout is not None
        first = json.loads(printer.stdout.readline())
        assert (first["channel"], first["state"]) == ("motor2", "raised")
        printer.send_signal(signal.SIGINT)
        assert printer.wait(5) == 130
    finally:
        session.close()
        late_session.close()
        printer.kill()
        printer.communicate()
    assert live.process.poll() is None
    live.process.kill()
    live.process.wait(10)
    assert list(play(quad_profile, read_recording(live.record)).events) == events


def test_a_start_that_fails_says_why_and_nothing_of_monitoring(
    quad_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as station, socket.create_server(("127.0.0.1", 0)) as server:
        station.bind(("127.0.0.1", 0))
        udp = f"udpin:127.0.0.1:{station.getsockname()[1]}"
        before = signal.getsignal(signal.SIGHUP)
        listen = f"tcp/127.0.0.1:{free_port()}"
        assert fauio.main(["run", str(quad_folder), "--mavlink", udp, "--listen", listen]) == 2
        [line] = capsys.readouterr().err.splitlines()
        assert "in use" in line
        taken = f"tcp/127.0.0.1:{server.getsockname()[1]}"
        assert fauio.main(["run", str(quad_folder), "--mavlink", "udpin:127.0.0.1:0", "--listen", taken]) == 2
        assert len(capsys.readouterr().err.splitlines()) == 1
        assert signal.getsignal(signal.SIGHUP) == before


def test_what_it_says_at_the_start_is_true_and_at_the_end_complete(
    quad_folder: Path, data: Path, tmp_path: Path
) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    (tmp_path / "zenoh.json5").write_text(f'{{listen: {{endpoints: ["{endpoint}"]}}}}')
    udp = free_port(socket.SOCK_DGRAM)
    record, journal = tmp_path / "new/flight.mcap", tmp_path / "other/journal.db"
    text = f"""
profile = "{quad_folder}"
mavlink = "udpin:127.0.0.1:{udp}"
zenoh_config = "zenoh.json5"
record = "{record}"
[journal]
path = "{journal}"
"""
    (tmp_path / "fauio.toml").write_text(text)
    command = [*FAUIO, "run", "--config", str(tmp_path / "fauio.toml"), "--json"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        try:
            said = json.loads(process.stderr.readline())
            process.send_signal(signal.SIGHUP)
            assert (said["event"], said["zenoh"]) == ("monitoring", endpoint)
            assert journal.exists()
            assert said_next(process)["event"] == "reloaded"
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
                for _, packet in list(TlogReader(data / "copter_5s.tlog.xz").packets())[:300]:
                    out.sendto(packet, ("127.0.0.1", udp))
            until(lambda: unread(udp) == 0)
            process.send_signal(signal.SIGTERM)
            stopped = said_next(process)
            assert process.wait(10) == 0
        finally:
            process.kill()
    assert stopped["event"] == "stopped"
    recorded = [message for message in read_recording(record) if message.source != CLOCK]
    assert sum(message.source == MAVLINK for message in recorded) > 0
    assert stopped["messages"] == len(recorded)


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["run", "nowhere", "--mavlink", "udpin:127.0.0.1:0"], "nowhere"),
        (["run", "{quad}"], "no telemetry to listen to"),
        (["run", "{quad}", "--mavlink", "carrier-pigeon:1", "--listen", "tcp/127.0.0.1:{port}"], "carrier-pigeon"),
        (["replay", "{quad}", "no-such.tlog"], "no-such.tlog"),
        (["replay", "{quad}", "{quad}/profile.toml"], "unknown kind of recording"),
    ],
)
def test_a_wrong_argument_gets_one_line_and_status_2(
    arguments: list[str], complaint: str, quad_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    known = {"{quad}": str(quad_folder), "{port}": str(free_port())}
    command = []
    for argument in arguments:
        for name, value in known.items():
            argument = argument.replace(name, value)  # noqa: PLW2901 - it is the argument that is completed
        command.append(argument)
    assert fauio.main(command) == 2
    said = capsys.readouterr().err
    assert complaint in said
    assert len(said.strip().splitlines()) == 1


def test_an_arm_on_zenoh_is_watched_like_one_on_mavlink(arm_profile: Profile, tmp_path: Path) -> None:
    folder = tmp_path / "arm"
    folder.mkdir()
    for name, content in arm_profile.files.items():
        (folder / name).write_bytes(content)
    text = (folder / "profile.toml").read_text().replace('"DEBUG_FLOAT_ARRAY"', '"arm/telemetry"')
    for k, field in enumerate(("u[0]", "y[0]", "y[1]", "y[2]")):
        text = text.replace(f'"data[{k}]"', f'"{field}"')
    lines = [line for line in text.splitlines() if ".where]" not in line and 'name = "arm"' not in line]
    (folder / "profile.toml").write_text("\n".join(['name = "arm"', *lines]))
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    command = [*FAUIO, "run", str(folder), "--zenoh", "arm/telemetry", "--listen", endpoint]
    daemon = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    session = open_session(connect=[endpoint])
    try:
        subscriber = AlarmSubscriber(session)
        until(lambda: subscriber.live)
        simulate = ["simulate", "arm", "--zenoh", "arm/telemetry", "--connect", endpoint, "--speed", "8"]
        # by then the observer has forgotten where it was started
        assert fauio.main([*simulate, "--fault", "f_s:step:10:14:2", "--duration", "18"]) == 0
        events = heard(subscriber, lambda found: bool(found) and found[-1].state == "cleared")
        states = [(event.channel, event.state) for event in events if event.state != "updated"]
        assert states == [("encoder", "raised"), ("encoder", "cleared")]
        assert events[0].estimate == pytest.approx(2.0, abs=0.3)
    finally:
        session.close()
        daemon.kill()
        daemon.communicate()
