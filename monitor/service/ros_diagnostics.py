"""Publish the health of the vehicles for ROS 2: ``/diagnostics`` for rmw_zenoh, without ROS.

A ``diagnostic_msgs/DiagnosticArray`` in CDR once a second, on the key and with the attachment of rmw_zenoh (zenoh 1.x:
ROS 2 Jazzy and later), and the liveliness tokens by which ``ros2 topic list`` finds it. For each vehicle it has one
status of the monitoring and one of each observer, with the size of each fault channel.
"""

from __future__ import annotations

import struct
import uuid
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from monitor.display import fault_text
from monitor.service.health import ChannelHealth, Health, VehicleHealth

if TYPE_CHECKING:
    import zenoh

OK, WARN, ERROR, STALE = range(4)
"""Levels of DiagnosticStatus."""
TYPE: Final = "diagnostic_msgs::msg::dds_::DiagnosticArray_"
TYPE_HASH: Final = "RIHS01_5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e"
"""SHA-256 of the type's description, as REP-2011 (and test_monitor_ros_diagnostics.py) computes it."""
_LEVELS = {"starting": STALE, "monitoring": OK, "blind": ERROR, "degraded": WARN, "stale": STALE}
_NODE = "fauio"


class Diagnostic(NamedTuple):
    """A DiagnosticStatus."""

    level: int
    name: str
    message: str
    hardware_id: str
    values: Sequence[tuple[str, str]]


class RosDiagnostics:
    """Publishes the health of the daemon's vehicles; the session is left open by :meth:`close`."""

    def __init__(self, session: zenoh.Session, domain: int) -> None:
        import zenoh

        key = f"{domain}/diagnostics/{TYPE}/{TYPE_HASH}"
        self._publisher = session.declare_publisher(key, congestion_control=zenoh.CongestionControl.DROP)
        self._gid = uuid.uuid4().bytes
        self._count = 0
        # node and publisher, their qualities of service left at the defaults of ROS, the last 7 messages kept
        root = f"@ros2_lv/{domain}/{session.zid()}/0"
        publisher = f"{root}/1/MP/%/%/{_NODE}/%diagnostics/{TYPE}/{TYPE_HASH}/::,7:,:,:,,"
        self._tokens = [session.liveliness().declare_token(key) for key in (f"{root}/0/NN/%/%/{_NODE}", publisher)]

    def publish(self, health: Health, now_ns: int) -> None:
        """Publish a snapshot at a Unix time; never waits."""
        from zenoh import ext

        self._count += 1
        head: tuple[Any, ...] = ("sequence_number", ext.Int64(self._count), "source_timestamp", ext.Int64(now_ns))
        attachment = ext.z_serialize((*head, "source_gid", self._gid))
        self._publisher.put(diagnostics_payload(diagnostics(health), now_ns), attachment=attachment)

    def close(self) -> None:
        """Withdraw all declarations."""
        declared: list[Any] = [*self._tokens, self._publisher]
        for declaration in declared:
            declaration.undeclare()


def diagnostics(health: Health) -> Iterator[Diagnostic]:
    """Yield the statuses of all vehicles."""
    for vehicle in health.vehicles:
        yield _of_vehicle(vehicle)
        observers: dict[str, list[ChannelHealth]] = {}
        for channel in vehicle.channels:
            observers.setdefault(channel.observer, []).append(channel)
        for name, channels in observers.items():
            yield _of_observer(vehicle.name, name, channels)


def _of_vehicle(vehicle: VehicleHealth) -> Diagnostic:
    level = max(_LEVELS[vehicle.state], ERROR if vehicle.impostor else OK)
    why = vehicle.blind or vehicle.impostor
    evidence = [
        (observer.name, f"evidence in {100 * observer.share:.0f} % of the last minute")
        for observer in vehicle.observers
    ]
    message = f"{vehicle.state}: {why}" if why else vehicle.state
    return Diagnostic(level, f"fauio: {vehicle.name}", message, vehicle.name, evidence)


def _of_observer(vehicle: str, observer: str, channels: Sequence[ChannelHealth]) -> Diagnostic:
    raised = [channel for channel in channels if channel.severity is not None]
    level = max((ERROR if alarm.severity == "critical" else WARN for alarm in raised), default=OK)
    said = ", ".join(f"{alarm.name} {_size(alarm)}".rstrip() for alarm in raised)
    sizes = [(channel.name, size) for channel in channels if (size := _size(channel))]
    return Diagnostic(level, f"fauio: {vehicle} {observer}", said or "no alarm", vehicle, sizes)


def _size(channel: ChannelHealth) -> str:
    size, command = channel.estimate, channel.usual_command
    share = None if size is None or command is None else size / command
    return fault_text(channel.name, size, share, channel.unit)


def diagnostics_payload(statuses: Iterator[Diagnostic], now_ns: int) -> bytes:
    """Return a DiagnosticArray in plain CDR, little-endian (XTypes 1.3, 7.4), stamped with a Unix time."""
    cdr = _Cdr()
    cdr.number("i", now_ns // 1_000_000_000)
    cdr.number("I", now_ns % 1_000_000_000)
    cdr.text("")
    every = list(statuses)
    cdr.number("I", len(every))
    for status in every:
        cdr.number("B", status.level)
        cdr.text(status.name)
        cdr.text(status.message)
        cdr.text(status.hardware_id)
        cdr.number("I", len(status.values))
        for pair in status.values:
            for text in pair:
                cdr.text(text)
    return b"\x00\x01\x00\x00" + bytes(cdr.data)


class _Cdr:
    """Appends values, each aligned to its size."""

    def __init__(self) -> None:
        self.data = bytearray()

    def number(self, code: str, value: int) -> None:
        size = struct.calcsize("<" + code)
        self.data += bytes(-len(self.data) % size) + struct.pack("<" + code, value)

    def text(self, text: str) -> None:
        content = text.encode(errors="backslashreplace").replace(b"\0", b"") + b"\0"
        self.number("I", len(content))
        self.data += content
