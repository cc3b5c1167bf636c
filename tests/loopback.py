"""What tests of the outputs share: a monitor's session on loopback, its clients, an alarm event."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from typing import Any

import zenoh
from daemons import free_ports

from adapters.zenoh.zenoh_session import open_session
from monitor.bus.subscriber import AlarmSubscriber
from monitor.event import AlarmEvent

START_NS = 1_795_251_917_265_689_600


def event(seq: int, channel: str = "motor1", **changes: Any) -> AlarmEvent:
    values: dict[str, Any] = {
        "id": f"01J-{channel}",
        "vehicle": "copter-1",
        "observer": "motors",
        "channel": channel,
        "kind": "actuator",
        "state": "raised",
        "severity": "warning",
        "estimate": -0.02,
        "relative": None,
        "unit": "m",
        "threshold": 0.015,
        "time_ns": START_NS + seq,
        "vehicle_time_ms": seq,
        "since_ns": START_NS,
        "peak": -0.03,
        "message": "motor1 delivers less",
        "seq": seq,
    }
    return AlarmEvent(**(values | changes))


def until(condition: Callable[[], Any], every_s: float = 0.005) -> Any:
    """Wait for what other threads and processes will do, and return it; the test's own time-out ends it if they do not.

    Looking at it shall cost little: ask less often where that reads a log.
    """
    while not (found := condition()):
        time.sleep(every_s)
    return found


def heard(subscriber: AlarmSubscriber, enough: Callable[[list[AlarmEvent]], bool]) -> list[AlarmEvent]:
    """Return the events that a subscriber gets, up to the first one with which they are enough."""
    events: list[AlarmEvent] = []
    while not enough(events):
        event = subscriber.receive(0.2)
        if event is not None:
            events.append(event)
    return events


def put(session: zenoh.Session, key: str, payload: bytes | str) -> None:
    """Put what the test counts on: by default a busy machine may drop it."""
    session.put(key, payload, congestion_control=zenoh.CongestionControl.BLOCK)


def publisher(session: zenoh.Session, key: str) -> Any:
    """Declare a publisher that waits for its subscriber instead of dropping."""
    made = session.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK)
    until(lambda: bool(made.matching_status.matching))
    return made


def free_port(kind: socket.SocketKind = socket.SOCK_STREAM) -> int:
    """Return a port of loopback that nobody listens on."""
    return free_ports(1, kind)[0]


class Endpoint:
    """A monitor's session with its publisher, and what clients need to connect."""

    def __init__(self, address: str | None = None) -> None:
        self.address = address or f"tcp/127.0.0.1:{free_port()}"
        self.session = open_session(listen=[self.address])
        self.clients: list[zenoh.Session] = []

    def client(self) -> zenoh.Session:
        """Return a session that is connected to the monitor's."""
        self.clients.append(open_session(connect=[self.address]))
        session = self.clients[-1]
        until(lambda: bool(list(session.info.peers_zid())))
        return session

    def close(self) -> None:
        for session in (*self.clients, self.session):
            session.close()


def matched(endpoint: Endpoint, key: str) -> bool:
    """Return whether somebody's subscription has reached the monitor's session."""
    with endpoint.session.declare_publisher(key) as probe:
        return bool(probe.matching_status.matching)


def shown_from_now_on(endpoint: Endpoint) -> None:
    """Wait until a display has subscribed to statuses and estimates: what was published before, it never gets."""
    until(lambda: all(matched(endpoint, f"fauio/copter-1/{key}") for key in ("status", "estimate/motors")))
