"""Alarms on the operator's ground station: texts of an onboard computer over MAVLink, if the configuration allows it.

No command is sent: a heartbeat and the computer's status once a second, and a STATUSTEXT for each notice.
"""

import contextlib
import os
import socket
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from adapters.mavlink.byte_link import resolve
from adapters.mavlink.companion import CRITICAL, NOTICE, WARNING, Companion
from adapters.mavlink.signing import SigningKey
from monitor.notify.notices import Notice

_MOST_TEXTS = 3
"""Largest number of texts sent at once. Chosen: a ground station reads each aloud; of more notices it shows the
number."""


@dataclass(frozen=True, slots=True)
class Beat:
    """The content of a vehicle's heartbeat."""

    system: int  # MAVLink system id; 0: not known yet, nothing is sent
    critical: bool  # whether one of its alarms is critical


class GroundSender:
    """Sends to ``udpout:HOST:PORT`` without waiting; packets that the network does not accept are lost.

    Raises UsageError if the address cannot be resolved.
    """

    name = "ground-station"

    def __init__(self, url: str, component: int, key: SigningKey | None = None) -> None:
        family, self._to = resolve(f"[ground_station] {url}", url.partition(":")[2])
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._companion = Companion(key, component)
        self._lock = threading.Lock()
        self._systems: dict[str, int] = {}
        self._started_ns = time.monotonic_ns()
        self._before = (self._started_ns, time.process_time())

    def beat(self, vehicles: Mapping[str, Beat], now_ns: int, resident_bytes: int) -> None:
        """Send heartbeat and computer status for each vehicle, by name; called once a second."""
        steady_ns, cpu_s = time.monotonic_ns(), time.process_time()
        share = (cpu_s - self._before[1]) / max(1e-9, (steady_ns - self._before[0]) / 1e9) / (os.cpu_count() or 1)
        self._before = steady_ns, cpu_s
        uptime_ms, ram_mb = (steady_ns - self._started_ns) // 1_000_000, resident_bytes >> 20
        with self._lock:
            self._systems = {name: beat.system for name, beat in vehicles.items() if beat.system}
            for beat in vehicles.values():
                if beat.system:
                    self._send(self._companion.heartbeat(beat.system, now_ns, critical=beat.critical))
                    self._send(
                        self._companion.computer_status(
                            beat.system, now_ns, uptime_ms=uptime_ms, cpu_percent=round(100 * share), ram_mb=ram_mb
                        )
                    )

    def send(self, notices: Sequence[Notice]) -> None:
        """Send notices as texts of their vehicles; of many, each vehicle's first ones and the number of the others."""
        vehicles: dict[str, list[Notice]] = {}
        for notice in sorted(notices, key=lambda notice: _severity(notice) != CRITICAL):
            vehicles.setdefault(notice.event.vehicle, []).append(notice)
        with self._lock:
            for name, own in vehicles.items():
                if (system := self._systems.get(name)) is None:
                    continue
                for notice in own[:_MOST_TEXTS]:
                    self._text(system, _severity(notice), _text(notice))
                if (more := len(own) - _MOST_TEXTS) > 0:
                    self._text(system, WARNING, f"fauio: {more} more messages")

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def _text(self, system: int, severity: int, text: str) -> None:
        for packet in self._companion.text(system, severity, text, time.time_ns()):
            self._send(packet)

    def _send(self, packet: bytes) -> None:
        # nobody listens, or the network is down: the next packet may get through
        with contextlib.suppress(OSError):
            self._socket.sendto(packet, self._to)


def _severity(notice: Notice) -> int:
    return {"critical": CRITICAL, "blind": CRITICAL, "cleared": NOTICE}.get(notice.occasion, WARNING)


def _text(notice: Notice) -> str:
    """Return a notice in few letters: ``fauio: motor1 -5 % of thrust``."""
    event = notice.event
    if notice.occasion == "cleared":
        return f"fauio: {event.channel} cleared"
    return f"fauio: {event.channel} {event.display}" if event.display else f"fauio: {event.message}"
