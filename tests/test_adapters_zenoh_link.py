"""Telemetry over real Zenoh sessions on loopback, hostile payloads included."""

from __future__ import annotations

import json
import math
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh
from loopback import free_port, publisher, until
from mcap_ros2._dynamic import serialize_dynamic

from adapters.batch import messages as each
from adapters.channels import parse_channel
from adapters.encoding.message_definition import find_definition
from adapters.errors import TelemetryError
from adapters.message import Message
from adapters.source import ZENOH
from adapters.zenoh.zenoh_link import MAX_PAYLOAD_BYTES, ZenohLink
from adapters.zenoh.zenoh_payload import PayloadDecoder
from adapters.zenoh.zenoh_session import open_session

ROOT = Path(__file__).parent.parent
PATIENCE_S = 60.0


def router(endpoint: str) -> zenoh.Session:
    """Return a session that routes between those connected to it."""
    config = zenoh.Config()
    settings = {"mode": "router", "listen/endpoints": [endpoint], "scouting/multicast/enabled": False}
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


@pytest.fixture
def endpoint() -> str:
    return f"tcp/127.0.0.1:{free_port()}"


@pytest.fixture
def listener(endpoint: str) -> Iterator[zenoh.Session]:
    with open_session(listen=[endpoint]) as session:
        yield session


@pytest.fixture
def sender(listener: zenoh.Session, endpoint: str) -> Iterator[zenoh.Session]:
    with open_session(connect=[endpoint]) as session:
        yield session


def collect(link: ZenohLink, count: int) -> list[Message]:
    messages: list[Message] = []
    deadline = time.monotonic() + PATIENCE_S
    while len(messages) < count:
        assert time.monotonic() < deadline, f"{len(messages)} of {count}; {link.statistics()}"
        messages += [*each(link.receive(0.2))]
    return messages


def test_json_objects_become_messages_named_by_their_key(listener: zenoh.Session, sender: zenoh.Session) -> None:
    with ZenohLink(listener, "arm/**") as link:
        out = publisher(sender, "arm/telemetry")
        before = time.time_ns()
        out.put(json.dumps({"time_ns": 5, "u": [1.0], "pose": {"x": 2}}))
        (message,) = collect(link, 1)
        assert (message.source, message.name) == (ZENOH, "arm/telemetry")
        assert message.fields == {"time_ns": 5, "u": [1.0], "pose": {"x": 2}}
        assert before <= message.received_ns <= time.time_ns()


def test_what_is_no_json_object_is_counted_and_passed_over(listener: zenoh.Session, sender: zenoh.Session) -> None:
    with ZenohLink(listener, "t") as link:
        out = publisher(sender, "t")
        for payload in (b"", b"\xff\xfe", b"[1]", b"3", b"{", b"[" * 100_000, b'{"a":' * 50_000, b'"text"'):
            out.put(payload)
        out.put(b'{"a": NaN, "b": 1e999}')
        (message,) = collect(link, 1)
        assert math.isnan(message.fields["a"])
        assert math.isinf(message.fields["b"])
        assert (link.statistics().malformed, link.statistics().messages) == (8, 1)


def test_why_payloads_are_passed_over_is_logged_once_for_each_key(
    listener: zenoh.Session, sender: zenoh.Session, caplog: pytest.LogCaptureFixture
) -> None:
    with ZenohLink(listener, "t/*", PayloadDecoder({"t/imu": IMU})) as link:
        out = {name: publisher(sender, f"t/{name}") for name in ("text", "list", "imu", "odometry", "plain", "last")}
        for _ in range(3):
            out["text"].put(b"\xff")
            out["list"].put(b"[1]")
            out["plain"].put(imu(1.0))
            out["imu"].put(b"{}")
            out["odometry"].put(imu(1.0), encoding="application/cdr;px4_msgs/msg/VehicleOdometry")
        out["last"].put(b"{}")
        collect(link, 1)
        assert (link.statistics().malformed, link.statistics().undefined) == (12, 3)
    said = sorted(record.getMessage().replace(", and more like it", "") for record in caplog.records)
    assert said[0].startswith("payload of t/imu skipped: ")
    assert said[1:] == [
        "payload of t/list skipped: not a JSON object",
        "payload of t/odometry skipped: CDR, and no definition of px4_msgs/VehicleOdometry",
        "payload of t/plain skipped: not JSON; if it is CDR, name its type in [zenoh_types]",
        "payload of t/text skipped: not JSON",
    ]


def test_keys_without_end_are_not_logged_without_end(listener: zenoh.Session, caplog: pytest.LogCaptureFixture) -> None:
    with ZenohLink(listener, "t/*") as link:
        for k in range(1_200):
            listener.put(f"t/{k}", b"")
        until(lambda: len(link._queue) == 1_200)
        assert [*each(link.receive(0.0))] == []
        assert link.statistics().malformed == 1_200
    assert len(caplog.records) == 1_000


def test_oversized_payloads_are_counted_and_the_session_lives_on(
    listener: zenoh.Session, sender: zenoh.Session
) -> None:
    with ZenohLink(listener, "t") as link:
        out = publisher(sender, "t")
        out.put(b"x" * (MAX_PAYLOAD_BYTES + 1))
        out.put(b"x" * (10 << 20))
        out.put(b'{"a": 1}')
        assert collect(link, 1)[0].fields == {"a": 1}
        assert link.statistics().oversized == 2


IMU = "sensor_msgs/msg/Imu"
IMU_TEXT = find_definition(IMU, [])
RMW_KEY = (
    "0/robot/imu/sensor_msgs::msg::dds_::Imu_/RIHS01_7d9a00ff131080897a5ec7e26e315954b8eae3353c3f995c55faf71574000b5b"
)


def imu(x: float) -> bytes:
    stamp = {"stamp": {"sec": 1_795_251_917, "nanosec": 5}, "frame_id": "imu"}
    return bytes(serialize_dynamic(IMU, IMU_TEXT)[IMU]({"header": stamp, "angular_velocity": {"x": x}}))


def test_cdr_becomes_messages_whose_channels_and_clocks_can_be_read(
    listener: zenoh.Session, sender: zenoh.Session
) -> None:
    with ZenohLink(listener, "**", PayloadDecoder({"imu/left": IMU})) as link:
        publisher(sender, "imu/left").put(imu(1.0))
        publisher(sender, "imu/right").put(imu(2.0), encoding=f"application/cdr;{IMU}")
        publisher(sender, RMW_KEY).put(imu(3.0), attachment=b"sequence number, gid")
        messages = {message.name: message for message in collect(link, 3)}
        channel = parse_channel("x", {"message": "m", "field": "angular_velocity.x"}, "test")
        assert {name: channel.value(message.fields) for name, message in messages.items()} == {
            "imu/left": 1.0,
            "imu/right": 2.0,
            "robot/imu": 3.0,
        }
        assert {channel.stamp_ns(message.fields) for message in messages.values()} == {1_795_251_917_000_000_005}


def test_cdr_that_lies_or_is_of_an_unknown_type_is_counted_and_passed_over(
    listener: zenoh.Session, sender: zenoh.Session
) -> None:
    with ZenohLink(listener, "t", PayloadDecoder({"t": IMU})) as link, ZenohLink(listener, "u") as other:
        out, unknown = publisher(sender, "t"), publisher(sender, "u")
        good = imu(1.0)
        hostile = good[:12] + b"\xff\xff\xff\xff" + good[16:]
        for payload in (
            good[:-1],
            hostile,
            b"\0\2" + good[2:],
            b"{}",
            b"",
            b"\0\1\0\0" + b"\xff" * 900_000,
        ):
            out.put(payload)
        out.put(good)
        collect(link, 1)
        assert (link.statistics().malformed, link.statistics().undefined) == (6, 0)
        unknown.put(good, encoding="application/cdr")
        unknown.put(good, encoding="application/cdr;px4_msgs/msg/VehicleOdometry")
        unknown.put(b"{}")
        collect(other, 1)
        assert (other.statistics().malformed, other.statistics().undefined) == (0, 2)


@pytest.mark.parametrize("mode", ["router", "client"])
def test_telemetry_resumes_when_its_router_comes_back(endpoint: str, tmp_path: Path, mode: str) -> None:
    (tmp_path / "zenoh.json5").write_text(json.dumps({"mode": mode, "connect": {"endpoints": [endpoint]}}))
    running = router(endpoint)
    with open_session(config_file=tmp_path / "zenoh.json5") as session, ZenohLink(session, "t") as link:
        for back in range(3):
            with running, open_session(connect=[endpoint]) as vehicle:
                out = publisher(vehicle, "t")
                out.put(b"{}")
                collect(link, 1)
                assert (link.statistics().connected, link.statistics().reconnections) == (1, back)
            until(lambda: not link.statistics().connected)
            running = router(endpoint)
        running.close()
        assert link.statistics().messages == 3


SHARD = """
import sys
from adapters.batch import messages
from adapters.zenoh.zenoh_link import ZenohLink
from adapters.zenoh.zenoh_session import open_session
with open_session(config_file=sys.argv[1]) as session, ZenohLink(session, sys.argv[2]) as link:
    names = set()
    while "end" not in {name.rpartition("/")[2] for name in names}:
        names |= {message.name for message in messages(link.receive(0.2))}
    print(" ".join(sorted(names)))
"""


def test_two_processes_on_a_router_share_the_vehicles_by_key_expression(endpoint: str, tmp_path: Path) -> None:
    example = (ROOT / "examples/zenoh/fleet-daemon.json5").read_text()
    (tmp_path / "zenoh.json5").write_text(example.replace("tcp/localhost:7447", endpoint))

    def shard(keyexpr: str) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, "-c", SHARD, str(tmp_path / "zenoh.json5"), keyexpr],
            stdout=subprocess.PIPE,
            text=True,
            cwd=ROOT,
        )

    with (
        router(endpoint),
        open_session(connect=[endpoint]) as fleet,
        shard("telemetry/north/**") as north,
        shard("telemetry/south/**") as south,
    ):
        for name in ("north/a", "south/c", "north/b", "south/d", "north/end", "south/end"):
            publisher(fleet, f"telemetry/{name}").put(b"{}")
        seen = [process.communicate()[0].split() for process in (north, south)]
    assert seen == [
        ["telemetry/north/a", "telemetry/north/b", "telemetry/north/end"],
        ["telemetry/south/c", "telemetry/south/d", "telemetry/south/end"],
    ]


def test_a_reader_that_stalls_loses_the_oldest_and_knows_how_many(listener: zenoh.Session) -> None:
    with ZenohLink(listener, "t") as link:
        # its own publisher: a connection would lose samples where the machine lets its lease run out
        out = publisher(listener, "t")
        for k in range(6_000):
            out.put(b'{"k": %d}' % k)
        until(lambda: link.statistics().dropped + len(link._queue) == 6_000)
        assert link.statistics().dropped == 6_000 - 4_096
        messages = collect(link, 4_096)
        assert [message.fields["k"] for message in messages] == list(range(6_000 - 4_096, 6_000))


def test_a_flood_of_large_payloads_is_bounded_in_bytes(listener: zenoh.Session) -> None:
    with ZenohLink(listener, "t") as link:
        out = publisher(listener, "t")
        payload = b'{"a": "' + b"x" * 900_000 + b'"}'
        for _ in range(40):
            out.put(payload)
        until(lambda: link.statistics().dropped + len(link._queue) == 40)
        assert link._queued_bytes <= 1 << 24
        assert link.statistics().dropped > 20


def test_a_quiet_link_returns_nothing_when_the_time_is_over(listener: zenoh.Session) -> None:
    with ZenohLink(listener, "t") as link:
        assert [*each(link.receive(0.0))] == []
        assert [*each(link.receive(0.02))] == []


def test_a_wrong_key_expression_is_reported(listener: zenoh.Session) -> None:
    with pytest.raises(TelemetryError, match="'a//b' is not a Zenoh key expression"):
        ZenohLink(listener, "a//b")
