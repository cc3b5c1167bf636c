"""A link that asks for message rates: whom, for what, and that a link opened to listen sends nothing."""

import socket
import time
from collections.abc import Iterator

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from adapters.mavlink.mavlink_link import MavlinkLink
from adapters.mavlink.message_rates import RateRequests

PATIENCE_S = 20.0


class Vehicle:
    """An autopilot that sends heartbeats, and attitudes at a low rate, and remembers what it is asked."""

    def __init__(self, system: int, port: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.setblocking(False)
        self._to = ("127.0.0.1", port)
        self._packer = dialect.MAVLink(None, srcSystem=system, srcComponent=1)
        self._parser = dialect.MAVLink(None)
        self.heard: list[dialect.MAVLink_message] = []

    def heartbeat(self, kind: int = dialect.MAV_TYPE_QUADROTOR, autopilot: int = 3) -> None:
        self._send(self._packer.heartbeat_encode(kind, autopilot, 0, 0, 4))
        self._send(self._packer.attitude_encode(1, 0, 0, 0, 0, 0, 0))

    def _send(self, message: dialect.MAVLink_message) -> None:
        self._socket.sendto(message.pack(self._packer), self._to)
        self._packer.seq = (self._packer.seq + 1) % 256

    def read(self) -> None:
        while True:
            try:
                data, _ = self._socket.recvfrom(4096)
            except BlockingIOError:
                return
            self.heard.extend(self._parser.parse_buffer(data) or ())

    def asked(self) -> set[tuple[int, int, float]]:
        return {
            (message.target_system, int(message.param1), message.param2)
            for message in self.heard
            if message.get_type() == "COMMAND_LONG" and message.command == dialect.MAV_CMD_SET_MESSAGE_INTERVAL
        }

    def close(self) -> None:
        self._socket.close()


@pytest.fixture
def vehicle(port: int) -> Iterator[Vehicle]:
    found = Vehicle(3, port)
    yield found
    found.close()


def run(link: MavlinkLink, vehicle: Vehicle, seconds: float, enough: int = 1) -> None:
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline and len(vehicle.asked()) < enough:
        vehicle.heartbeat()
        link.receive(0.05)
        vehicle.read()
        time.sleep(0.1)


def asking(port: int, *systems: int) -> MavlinkLink:
    requests = RateRequests()
    for system in systems:
        requests.ask(system, {"ATTITUDE": 100.0})
    if not systems:
        requests.ask_everybody({"ATTITUDE": 100.0})
    return MavlinkLink(f"udpin:127.0.0.1:{port}", may_send=True, requests=requests)


def test_a_vehicle_whose_autopilot_is_heard_is_asked_for_the_rate(port: int, vehicle: Vehicle) -> None:
    with asking(port) as link:
        run(link, vehicle, PATIENCE_S)
    assert vehicle.asked() == {(3, dialect.MAVLINK_MSG_ID_ATTITUDE, 10_000.0)}
    assert {message.get_type() for message in vehicle.heard} == {"COMMAND_LONG", "HEARTBEAT"}


def test_only_the_systems_named_are_asked(port: int, vehicle: Vehicle) -> None:
    with asking(port, 9) as link:
        run(link, vehicle, 3.0)
    assert vehicle.asked() == set()


def test_a_ground_station_is_not_asked(port: int, vehicle: Vehicle) -> None:
    with asking(port) as link:
        for _ in range(60):
            vehicle.heartbeat(dialect.MAV_TYPE_GCS, dialect.MAV_AUTOPILOT_INVALID)
            link.receive(0.05)
            vehicle.read()
    assert vehicle.asked() == set()


def test_a_link_that_was_opened_to_listen_sends_nothing(port: int, vehicle: Vehicle) -> None:
    with MavlinkLink(f"udpin:127.0.0.1:{port}") as link:
        run(link, vehicle, 2.0)
    assert vehicle.heard == []
