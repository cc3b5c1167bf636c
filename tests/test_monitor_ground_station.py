"""Alarms on a ground station: pymavlink, as one, reads what is sent; and none of it is telemetry."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from loopback import event
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega

from adapters.errors import ConfigError
from adapters.mavlink.companion import CHUNK, Companion
from adapters.mavlink.signing import SigningKey
from monitor.configuration.config import read_config
from monitor.notify.ground_station import Beat, GroundSender
from monitor.notify.notices import Notice

NOW_NS = 1_795_404_602_641_000_000


@pytest.fixture
def receiver() -> Iterator[Any]:
    found = mavutil.mavlink_connection("udpin:127.0.0.1:0", dialect="ardupilotmega")
    yield found
    found.close()


@pytest.fixture
def station(receiver: Any) -> Iterator[GroundSender]:
    found = GroundSender(f"udpout:127.0.0.1:{receiver.port.getsockname()[1]}", 191)
    yield found
    found.close()


def received(receiver: Any, count: int) -> list[Any]:
    found: list[Any] = []
    while len(found) < count:
        message = receiver.recv_msg()
        if message is None:
            time.sleep(0.01)
        else:
            found.append(message)
    return found


def test_each_watched_vehicle_has_a_companion_that_says_how_it_is(receiver: Any, station: GroundSender) -> None:
    beats = {"copter-1": Beat(1, critical=False), "copter-2": Beat(2, critical=True), "new": Beat(0, critical=False)}
    station.beat(beats, NOW_NS, 100 << 20)
    found = received(receiver, 4)
    assert [(one.get_type(), one.get_srcSystem(), one.get_srcComponent()) for one in found] == [
        ("HEARTBEAT", 1, 191),
        ("ONBOARD_COMPUTER_STATUS", 1, 191),
        ("HEARTBEAT", 2, 191),
        ("ONBOARD_COMPUTER_STATUS", 2, 191),
    ]
    assert (found[0].type, found[0].autopilot) == (18, 8)
    assert [one.system_status for one in found[::2]] == [4, 5]
    assert (found[1].ram_usage, found[1].time_usec) == (100, NOW_NS // 1000)


def test_an_alarm_is_a_text_of_its_vehicle_with_its_severity(receiver: Any, station: GroundSender) -> None:
    named = {"relative": -0.05, "unit": "fraction of full command"}
    raised = Notice("raised", event(1, **named))
    station.send([raised])
    station.beat({"copter-1": Beat(7, critical=False)}, NOW_NS, 0)
    station.send([raised, Notice("critical", event(2, severity="critical", estimate=None))])
    station.send([Notice("cleared", event(3, state="cleared"))])
    # before the vehicle's system id was known nothing could be said of it
    texts = received(receiver, 5)[2:]
    assert [(one.get_srcSystem(), one.severity, one.text) for one in texts] == [
        (7, 2, "fauio: motor1 delivers less"),
        (7, 4, "fauio: motor1 -5 % of thrust"),
        (7, 5, "fauio: motor1 cleared"),
    ]


def test_a_flood_is_a_few_texts(receiver: Any, station: GroundSender) -> None:
    station.beat({"copter-1": Beat(1, critical=False)}, NOW_NS, 0)
    station.send([Notice("raised", event(k, f"c{k}", estimate=None)) for k in range(40)])
    assert [one.text for one in received(receiver, 6)[5:]] == ["fauio: 37 more messages"]


@pytest.mark.parametrize("length", [0, 1, CHUNK, CHUNK + 1, 2 * CHUNK, 199, 500])
def test_a_long_text_comes_in_chunks_that_a_ground_station_joins(length: int) -> None:
    text = ("abcdefghi " * 60)[:length]
    packets = Companion().text(1, 4, text, NOW_NS)
    parser = ardupilotmega.MAVLink(None)
    chunks = [message for packet in packets for message in parser.parse_buffer(packet)]
    assert "".join(one.text for one in chunks) == text[:200].rstrip("\0")
    assert [one.chunk_seq for one in chunks] == list(range(len(chunks)))
    assert len({one.id for one in chunks}) == 1
    assert (chunks[0].id != 0) == (len(chunks) > 1)


def test_packets_are_signed_where_there_is_a_key() -> None:
    parser = ardupilotmega.MAVLink(None)
    parser.signing.secret_key = bytes(range(32))
    packet = Companion(SigningKey(bytes(range(32)))).heartbeat(1, NOW_NS, critical=False)
    assert [one.get_type() for one in parser.parse_buffer(packet)] == ["HEARTBEAT"]
    assert packet[2] & 1


def test_a_vehicle_may_not_take_these_packets_for_its_telemetry(tmp_path: Path) -> None:
    path = tmp_path / "run.toml"
    (tmp_path / "quad").mkdir()
    path.write_text(
        'mavlink = "udpin:127.0.0.1:0"\nprofile = "quad/"\n[[vehicle]]\nname = "a"\ncomponent = 0\n'
        '[ground_station]\nurl = "udpout:127.0.0.1:14551"\n'
    )
    with pytest.raises(ConfigError, match=r"'vehicle\[0\].component' is 0, so that the packets of \[ground_station\]"):
        read_config(path)
