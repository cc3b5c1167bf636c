"""The state of the monitors of one or all vehicles, from their status topics: silence may mean a blind monitor."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from monitor.bus.keys import ANY, vehicle_of, vehicle_root
from monitor.bus.payload import decode_payload

if TYPE_CHECKING:
    import zenoh

MAX_VEHICLES = 1000
"""Most vehicles that are remembered, since names come from the network. Chosen: more than one network monitors."""
_MAX_REASONS = 10
"""Most reasons of a status. Chosen: more do not fit on a screen."""
_MAX_TEXT = 300
"""Most letters of a reason. Chosen: three lines of a terminal."""
_LARGEST_RATE = 1e9
"""Largest number of messages a second that is shown; it comes from a network, and no link brings more."""
_STATES = ("starting", "monitoring", "blind", "degraded", "stale")
_FIGURES = re.compile(r"[0-9.]+")


@dataclass(frozen=True, slots=True)
class VehicleStatus:
    """A vehicle's status in short."""

    vehicle: str
    state: str = "starting"  # ``starting``, ``monitoring``, ``blind``, ``degraded`` or ``stale``
    reasons: tuple[str, ...] = ()  # what keeps the vehicle from being watched completely
    messages_per_s: float | None = None  # telemetry that its monitor receives; None: not stated

    @property
    def kind(self) -> tuple[str, ...]:
        """State and reasons without their numbers, which change every second."""
        return self.state, *(_FIGURES.sub("", reason) for reason in self.reasons)

    @property
    def well(self) -> bool:
        """Whether there is nothing to report."""
        return self.state in ("starting", "monitoring") and not self.reasons

    def line(self) -> str:
        """Return the status as a line for people."""
        return f"{self.vehicle} is {self.state}" + (f": {'; '.join(self.reasons)}" if self.reasons else "")


def valid_status(vehicle: str, payload: Any) -> VehicleStatus | None:
    """Return a status payload in short, cut to what a terminal can show; None if it is no status."""
    if not isinstance(payload, Mapping) or payload.get("state") not in _STATES:
        return None
    reasons = payload.get("reasons", ())
    if not isinstance(reasons, Sequence) or isinstance(reasons, str):
        return None
    texts = tuple(reason[:_MAX_TEXT] for reason in reasons[:_MAX_REASONS] if isinstance(reason, str))
    rate = payload.get("messages_per_s")
    known = isinstance(rate, int | float) and 0 <= rate < _LARGEST_RATE
    return VehicleStatus(vehicle, str(payload["state"]), texts, float(rate or 0.0) if known else None)


class StatusWatch:
    """Keeps the latest status of a vehicle, or of all; the session is left open by :meth:`close`.

    ``on_status`` is called with each status and its payload, on Zenoh's thread. Raises UsageError if the vehicle's name
    or the prefix cannot be part of a key.
    """

    def __init__(
        self,
        session: zenoh.Session,
        vehicle: str = ANY,
        prefix: str = "fauio",
        on_status: Callable[[VehicleStatus, Mapping[str, Any]], None] | None = None,
    ) -> None:
        self._root = vehicle_root(prefix, vehicle)
        self._on_change = on_status
        self._lock = threading.Lock()
        self._latest: dict[str, VehicleStatus] = {}
        self._subscriber: Any = session.declare_subscriber(f"{self._root}/status", self._on_status)

    def latest(self) -> list[VehicleStatus]:
        """Return the latest status of each vehicle, by name."""
        with self._lock:
            return [self._latest[vehicle] for vehicle in sorted(self._latest)]

    def close(self) -> None:
        """Stop listening."""
        self._subscriber.undeclare()

    def _on_status(self, sample: zenoh.Sample) -> None:
        vehicle = vehicle_of(self._root, str(sample.key_expr))
        payload = decode_payload(sample.payload)
        status = valid_status(vehicle, payload)
        if status is None:
            return
        with self._lock:
            if vehicle not in self._latest and len(self._latest) >= MAX_VEHICLES:
                return
            self._latest[vehicle] = status
        if self._on_change is not None:
            self._on_change(status, payload)
