"""The latest published estimates of one or all vehicles: the size of an alarm now, between its events."""

from __future__ import annotations

import math
import threading
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

from monitor.bus.keys import ANY, vehicle_of, vehicle_root
from monitor.bus.payload import decode_payload
from monitor.estimation.input_curve import LEAST_COMMAND

if TYPE_CHECKING:
    import zenoh

MAX_OBSERVERS = 4000
"""Most observers that are remembered, since keys come from the network. Chosen: four observers of a thousand
vehicles."""


class LiveSizes(NamedTuple):
    """The size that is attributed to each fault channel of an observer now."""

    vehicle: str
    observer: str
    sizes: Mapping[str, float]
    shares: Mapping[str, float]  # the sizes of motors' faults as shares of their commands


def live_shares(sizes: Mapping[str, float], commands: object) -> dict[str, float]:
    """Return sizes of motors' faults as shares of their commands; NaN near a command of zero."""
    return {
        name: sizes[name] / command if command >= LEAST_COMMAND else math.nan
        for name, command in (commands.items() if isinstance(commands, dict) else ())
        if name in sizes and type(command) is float
    }


class EstimateWatch:
    """Keeps the latest estimate of each observer, and decodes it when asked; the session is left open.

    Raises UsageError if the vehicle's name or the prefix cannot be part of a key.
    """

    def __init__(self, session: zenoh.Session, vehicle: str = ANY, prefix: str = "fauio") -> None:
        self._root = vehicle_root(prefix, vehicle)
        self._lock = threading.Lock()
        self._latest: dict[str, zenoh.ZBytes] = {}
        self._subscriber: Any = session.declare_subscriber(f"{self._root}/estimate/*", self._on_estimate)

    def take(self) -> list[LiveSizes]:
        """Return the estimates that came since the last call."""
        with self._lock:
            latest, self._latest = self._latest, {}
        found = []
        for key, payload in latest.items():
            estimate = decode_payload(payload)
            isolated = estimate.get("isolated") if isinstance(estimate, dict) else None
            if isinstance(isolated, dict):
                sizes = {name: float(size) for name, size in isolated.items() if type(size) in (int, float)}
                shares = live_shares(sizes, estimate.get("commands"))
                found.append(LiveSizes(vehicle_of(self._root, key), key.rpartition("/")[2], sizes, shares))
        return found

    def close(self) -> None:
        """Stop listening."""
        self._subscriber.undeclare()

    def _on_estimate(self, sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)
        with self._lock:
            if key in self._latest or len(self._latest) < MAX_OBSERVERS:
                self._latest[key] = sample.payload
