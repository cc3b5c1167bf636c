"""Requests for message rates to vehicles: what to send, if sending is allowed, and the result of each request.

Logic without clock and socket: the times are given, the packets are returned. Waiting is measured by the steady time
(nanoseconds of the monotonic clock), which nobody sets; Unix time only stamps signatures.

The monitor presents itself as an onboard computer with a system id of its own and not as the ground station, whose loss
the vehicle has to notice: PX4 takes any heartbeat of a ground station for that, ArduPilot any of system 255.
"""

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from adapters.batch import Columns, one_message
from adapters.errors import TelemetryError
from adapters.mavlink.companion import Companion
from adapters.mavlink.heartbeat import AUTOPILOT, holds_autopilot_heartbeat
from adapters.mavlink.mavlink_message import mavlink_types
from adapters.mavlink.signing import SigningKey
from adapters.message import SECOND_NS
from adapters.source import MAVLINK

OWN_IDS = (245, 191)
"""System and component id of the sender of requests: an onboard computer that is not a vehicle."""

_ENOUGH = 0.7
"""Share of the requested rate below which a message is requested. Chosen: a link that loses a tenth and a scheduler
that rounds periods are normal, half the rate is not."""
# A rate is measured over at least so many messages, and at least so long.
_MEASURED_MESSAGES = 5
_MEASURED_S = 2.0
_ACK_NS = 1_500_000_000
_FIRST_RETRY_NS = 2 * SECOND_NS
_LAST_RETRY_NS = 64 * SECOND_NS
_SILENT_NS = 3 * SECOND_NS
_LARGEST_HZ = 1000.0


@dataclass(slots=True)
class _Request:
    """State of one request to a vehicle's autopilot, and the present measurement of its rate.

    If the vehicle has refused (``refused``), it is not asked again.
    """

    system: int
    component: int
    name: str
    asked_hz: float
    refused: bool = False
    low: bool = False
    arrivals: int = 0
    since_ns: int = 0
    retry_ns: int = _FIRST_RETRY_NS
    not_before_ns: int = 0

    def measure(self, now_ns: int) -> None:
        """Measure the rate if enough time and messages have passed."""
        elapsed_s = (now_ns - self.since_ns) / 1e9
        if elapsed_s < max(_MEASURED_S, _MEASURED_MESSAGES / self.asked_hz):
            return
        self.low = self.arrivals / elapsed_s < _ENOUGH * self.asked_hz
        if not self.low:
            self.retry_ns, self.not_before_ns = _FIRST_RETRY_NS, 0
        self.restart(now_ns)

    def restart(self, now_ns: int) -> None:
        """Begin a new measurement."""
        self.arrivals, self.since_ns = 0, now_ns

    def sent(self, now_ns: int) -> None:
        """Note that the request was sent; the wait before the next one doubles."""
        self.low = False
        self.not_before_ns = now_ns + self.retry_ns
        self.retry_ns = min(2 * self.retry_ns, _LAST_RETRY_NS)
        self.restart(now_ns)


@dataclass(slots=True)
class _Vehicle:
    """One vehicle. An acknowledgement does not name its message, so only one request is open at a time."""

    component: int
    requests: dict[str, _Request]
    last_ns: int | None = None
    arrived: bool = False
    waiting: _Request | None = None
    waiting_until_ns: int = 0


class RateRequests:
    """Asks the vehicles of one link for message rates, and sends a heartbeat every second.

    A vehicle is asked for a message while it is received and the message comes at less than 70 % of the rate, again and
    again at growing intervals of at most about a minute, unless it has refused. Packets are signed if there is a key,
    and sent under the given system and component id.
    """

    def __init__(self, key: SigningKey | None = None, ids: tuple[int, int] = OWN_IDS) -> None:
        self._ids = ids
        self._companion = Companion(key, ids[1])
        self._dialect = self._companion.dialect
        self._vehicles: dict[int, _Vehicle] = {}
        self._everybody: tuple[Mapping[str, float], int] | None = None
        self._heartbeat_ns: int | None = None

    def ask(self, system: int, rates: Mapping[str, float], component: int = AUTOPILOT) -> None:
        """Ask one vehicle's autopilot for these rates, hertz by message name, from now on, instead of earlier ones.

        Raises
        ------
        TelemetryError
            There is no such message, id or rate.
        """
        if not (0 < system < 256 and 0 < component < 256):
            raise TelemetryError(f"system {system}, component {component}: MAVLink ids are 1 to 255")
        numbers = _message_numbers()
        for name, rate_hz in rates.items():
            if name not in numbers:
                raise TelemetryError(f"message rate of {name}: no such MAVLink message; names are like ATTITUDE")
            if not (math.isfinite(rate_hz) and 0.0 < rate_hz <= _LARGEST_HZ):
                raise TelemetryError(f"message rate of {name}: {rate_hz} is not above 0 and at most {_LARGEST_HZ:g} Hz")
        requests = {name: _Request(system, component, name, rate_hz) for name, rate_hz in rates.items()}
        self._vehicles[system] = _Vehicle(component, requests)

    def ask_everybody(self, rates: Mapping[str, float], component: int = AUTOPILOT) -> None:
        """Ask every vehicle whose autopilot is received, as :meth:`ask` does."""
        self._everybody = rates, component

    def count(self, columns: Columns, steady_ns: int) -> None:
        """Count messages that have arrived by a steady time; only those of the vehicles asked are counted."""
        if self._everybody is not None and columns.system not in self._vehicles:
            rates, component = self._everybody
            if columns.component == component and holds_autopilot_heartbeat(columns):
                self.ask(columns.system, rates, component)
        vehicle = self._vehicles.get(columns.system)
        if vehicle is None or columns.source is not MAVLINK or columns.component != vehicle.component:
            return
        if vehicle.last_ns is None or steady_ns - vehicle.last_ns > _SILENT_NS:
            for request in vehicle.requests.values():
                request.restart(steady_ns)
        vehicle.last_ns, vehicle.arrived = steady_ns, True
        if (counted := vehicle.requests.get(columns.name)) is not None:
            counted.arrivals += len(columns.position)
        if columns.name == "COMMAND_ACK":
            for row in range(len(columns.position)):
                self._acknowledge(vehicle, one_message(columns, row).fields)

    def _acknowledge(self, vehicle: _Vehicle, fields: Mapping[str, Any]) -> None:
        addressed = (fields.get("target_system"), fields.get("target_component"))
        # Version 1 has no field for the address.
        to_us = all(address in (0, own) for address, own in zip(addressed, self._ids, strict=True))
        answers = to_us and fields.get("command") == self._dialect.MAV_CMD_SET_MESSAGE_INTERVAL
        if vehicle.waiting is not None and answers:
            refusals = (self._dialect.MAV_RESULT_DENIED, self._dialect.MAV_RESULT_UNSUPPORTED)
            vehicle.waiting.refused = fields.get("result") in refusals
            vehicle.waiting = None

    def requests(self, steady_ns: int, now_ns: int) -> list[bytes]:
        """Return the packets to send at this steady and this Unix time; call it several times a second."""
        packets = []
        if self._heartbeat_ns is None or steady_ns - self._heartbeat_ns >= SECOND_NS:
            self._heartbeat_ns = steady_ns
            packets.append(self._companion.heartbeat(self._ids[0], now_ns, critical=False))
        for vehicle in self._vehicles.values():
            request = _next_request(vehicle, steady_ns)
            if request is not None:
                packets.append(self._set_interval(request, now_ns))
        return packets

    def _set_interval(self, request: _Request, now_ns: int) -> bytes:
        message = self._dialect.MAVLink_command_long_message(
            request.system,
            request.component,
            self._dialect.MAV_CMD_SET_MESSAGE_INTERVAL,
            0,
            _message_numbers()[request.name],
            round(1e6 / request.asked_hz),
            *[0] * 5,
        )
        return self._companion.pack(self._ids[0], message, now_ns)


def _next_request(vehicle: _Vehicle, now_ns: int) -> _Request | None:
    """Measure a vehicle's rates; return the request that is due."""
    # Only if the vehicle was just received: silence is not a low rate.
    if not vehicle.arrived:
        return None
    vehicle.arrived = False
    for request in vehicle.requests.values():
        request.measure(now_ns)
    if vehicle.waiting is not None and now_ns < vehicle.waiting_until_ns:
        return None
    vehicle.waiting = None
    due = [
        request
        for request in vehicle.requests.values()
        if request.low and not request.refused and now_ns >= request.not_before_ns
    ]
    if not due:
        return None
    request = min(due, key=lambda request: request.not_before_ns)
    request.sent(now_ns)
    vehicle.waiting, vehicle.waiting_until_ns = request, now_ns + _ACK_NS
    return request


@functools.cache
def _message_numbers() -> dict[str, int]:
    return {kind.name: number for number, kind in mavlink_types().items()}
