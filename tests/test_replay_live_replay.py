"""A recording replayed as if live: a real subscriber hears a monitor, a real socket gets the packets, on time."""

from __future__ import annotations

import json
import socket
import threading
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jsonschema
import pytest
import zenoh
from loopback import free_port, until

import fauio
from adapters.batch import messages
from adapters.logs.mcap_log import MessageLogWriter
from adapters.logs.recordings import read_recording
from adapters.logs.tlog import TlogReader
from adapters.zenoh.zenoh_session import open_session
from monitor.bus.schemas import SCHEMAS
from monitor.profile import read_profile
from replay.runs.live_replay import LiveReplay
from replay.runs.one_log import LogTask

QUAD = Path(__file__).parent.parent / "replay" / "data" / "quad"


class Listener:
    """A plain session that waits for a monitor to come up, and keeps all it says."""

    def __init__(self) -> None:
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        self.said: list[tuple[str, dict[str, Any]]] = []
        self._session = open_session(connect=[self.endpoint])
        self._subscriber: Any = self._session.declare_subscriber("fauio/**", self._take)

    def below(self, part: str) -> list[dict[str, Any]]:
        """Return the payloads on keys that begin with a text."""
        return [payload for key, payload in list(self.said) if key.startswith(f"fauio/test-1/{part}")]

    def close(self) -> None:
        self._session.close()

    def _take(self, sample: zenoh.Sample) -> None:
        if sample.encoding == zenoh.Encoding.APPLICATION_JSON:
            self.said.append((str(sample.key_expr), json.loads(sample.payload.to_bytes())))


@pytest.fixture
def listener() -> Iterator[Listener]:
    found = Listener()
    yield found
    found.close()


def test_a_subscriber_hears_what_a_monitor_would_have_said(
    listener: Listener, tmp_path: Path, data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, plain, live = data / "copter_motor3_090.tlog.xz", tmp_path / "plain.jsonl", tmp_path / "live.jsonl"
    command = ["replay", str(QUAD), str(log), "--vehicle", "test-1", "--alarms"]
    assert fauio.main([*command, str(plain)]) == 0
    plainly = capsys.readouterr().out
    assert fauio.main([*command, str(live), "--publish", "--listen", listener.endpoint]) == 0
    assert capsys.readouterr().out == plainly
    assert live.read_text() == plain.read_text()
    until(lambda: len(listener.below("status")) >= 13)
    said, written = listener.below("alarm/"), [json.loads(line) for line in plain.read_text().splitlines()]
    # what is published is numbered in a term of its own
    first = said[0]["seq"] - written[0]["seq"]
    assert said == [event | {"seq": event["seq"] + first} for event in written]
    statuses = listener.below("status")
    for name, payloads in (("status", statuses), ("estimate", listener.below("estimate/motors"))):
        assert payloads
        conforming = jsonschema.Draft202012Validator(SCHEMAS[name])
        for payload in payloads:
            conforming.validate(payload)
    assert {status["state"] for status in statuses[1:]} <= {"monitoring", "degraded"}
    seconds = [(after["time_ns"] - before["time_ns"]) / 1e9 for before, after in pairwise(statuses[:-1])]
    assert all(1.0 <= second < 1.1 for second in seconds)
    assert not any("keep up" in reason for status in statuses for reason in status["reasons"])


def test_packets_go_out_as_they_came_and_when_they_are_due(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = data / "copter_5s.tlog.xz"
    packets = list(TlogReader(log).packets())
    naps: list[float] = []
    clock = SimpleNamespace(sleep=naps.append, monotonic_ns=lambda: round(1e9 * sum(naps)))
    monkeypatch.setattr("adapters.simulation.pacing.time", clock)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(10.0)
        received: list[bytes] = []
        reader = threading.Thread(target=lambda: received.extend(receiver.recv(4096) for _ in packets))
        reader.start()
        url = f"udp:127.0.0.1:{receiver.getsockname()[1]}"
        profile, task = read_profile(QUAD), LogTask(log.name, log)
        with LiveReplay(4.0, udp=url) as live:
            names = [message.name for batch in live.batches(profile, task, None) for message in messages(batch)]
        reader.join()
    assert received == [packet for _, packet in packets]
    assert "ATTITUDE" in names
    assert sum(naps) == pytest.approx((packets[-1][0] - packets[0][0]) / 4e9)


def test_only_a_telemetry_log_has_packets_to_send(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "flight.mcap"
    with MessageLogWriter(log) as writer:
        for message in read_recording(data / "copter_5s.tlog.xz", {"ATTITUDE"}):
            writer.write(message)
    assert fauio.main(["replay", str(QUAD), str(log), "--udp", "udp:127.0.0.1:9"]) == 2
    assert capsys.readouterr().err == f"fauio: {log}: --udp sends packets as they came, which only .tlog files hold\n"


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (["--speed", "0"], "has to be positive"),
        (["--speed", "2", "--jobs", "2"], "without --jobs"),
        (["--listen", "tcp/127.0.0.1:1"], "go with --publish only"),
        (["--publish", "--listen", "tcp/0.0.0.0:7447"], "other machines reach it"),
        (["--publish", "--listen", "nonsense"], "not understood"),
        (["--udp", "tcp:127.0.0.1:9"], "use udp:HOST:PORT"),
        (["--udp", "udp:127.0.0.1"], "no HOST:PORT"),
    ],
)
def test_wrong_options_get_one_line(
    options: list[str], complaint: str, data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert fauio.main(["replay", str(QUAD), str(data / "copter_5s.tlog.xz"), *options]) == 2
    said = capsys.readouterr().err
    assert complaint in said
    assert said.count("\n") == 1
