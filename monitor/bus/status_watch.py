"""How the monitors of one or all vehicles are doing, from their status topics: who hears no alarm may be blind."""

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
"""Names come from the network: the memory for them has to end. Chosen: more than one network watches."""
_MAX_REASONS = 10
"""Chosen: more do not fit on a screen."""
_MAX_TEXT = 300
"""Letters of a reason. Chosen: three lines of a terminal."""
_LARGEST_RATE = 1e9
"""Messages a second. Beyond any link; the number comes from a network."""
_STATES = ("starting", "monitoring", "blind", "degraded", "stale")
_FIGURES = re.compile(r"[0-9.]+")


@dataclass(frozen=True, slots=True)
class VehicleStatus:
    """A vehicle's status in short."""

    vehicle: str
    state: str = "starting"  # ``starting``, ``monitoring``, ``blind``, ``degraded`` or ``stale``
    reasons: tuple[str, ...] = ()  # what keeps it from being watched as it should
    messages_per_s: float | None = None  # telemetry that its monitor gets; None where that is not said

    @property
    def kind(self) -> tuple[str, ...]:
        """State and reasons without their figures, which change every second."""
        return self.state, *(_FIGURES.sub("", reason) for reason in self.reasons)

    @property
    def well(self) -> bool:
        """Whether there is nothing to say about it."""
        return self.state in ("starting", "monitoring") and not self.reasons

    def line(self) -> str:
        """Return it as a line for people."""
        return f"{self.vehicle} is {self.state}" + (f": {'; '.join(self.reasons)}" if self.reasons else "")


def valid_status(vehicle: str, payload: Any) -> VehicleStatus | None:
    """Return what a status payload says, cut to what a terminal can show; None where it is none."""
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

    ``on_status`` is called with each, and with its payload, on Zenoh's thread.
    Raises UsageError where the vehicle's name or the prefix cannot be part of a key.
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
