"""Silence of the telemetry as an alarm of its own: stale is never mixed with a fault of the vehicle.

Decided on times of arrival alone. The alarm is raised ``stale_s`` after the last message that carried a channel,
and cleared by the next one; a replay finds the same two moments in the recording.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from monitor.event import UNNUMBERED, AlarmEvent, State, alarm_id

OBSERVER = "link"
CHANNEL = "telemetry"


class StaleAlarm:
    """State of the stale alarm of one vehicle.

    Parameters
    ----------
    vehicle : str
        The vehicle's name in events.
    stale_s : float
        Silence after which telemetry is stale, seconds.
    """

    def __init__(self, vehicle: str, stale_s: float) -> None:
        self._vehicle = vehicle
        self._limit_ns = round(stale_s * 1e9)
        self._carried_ns: int | None = None
        self._vehicle_ns = 0
        self._since_ns: int | None = None

    @property
    def active(self) -> bool:
        """Whether telemetry is stale."""
        return self._since_ns is not None

    def follow(self, received_ns: int, vehicle_ns: int) -> list[AlarmEvent]:
        """Process a message that carries a channel; return the events that a silence before it and its end cause.

        Parameters
        ----------
        received_ns : int
            Unix time of arrival.
        vehicle_ns : int
            Newest known time of the vehicle's clock.
        """
        events = self.silence(received_ns)
        if self._since_ns is not None:
            silent_s = (received_ns - (self._carried_ns or received_ns)) / 1e9
            events.append(self._event("cleared", received_ns, vehicle_ns, f"telemetry is back after {silent_s:.1f} s"))
            self._since_ns = None
        self._carried_ns = received_ns if self._carried_ns is None else max(received_ns, self._carried_ns)
        self._vehicle_ns = vehicle_ns
        return events

    def silence(self, now_ns: int) -> list[AlarmEvent]:
        """Let Unix time come to ``now_ns``; return the event of telemetry going stale, once."""
        if self._since_ns is not None or self._carried_ns is None or now_ns - self._carried_ns < self._limit_ns:
            return []
        self._since_ns = self._carried_ns + self._limit_ns
        return [
            self._event(
                "raised",
                self._since_ns,
                self._vehicle_ns + self._limit_ns,
                f"no telemetry for {self._limit_ns / 1e9:g} s: nothing is being watched",
            )
        ]

    def first_silent(self, received_ns: NDArray[np.int64], wanted: NDArray[np.bool_]) -> int:
        """Return the index of the first message that may cause an event here, the number of messages if there is none.

        Parameters
        ----------
        received_ns : NDArray[np.int64]
            Times of arrival of m messages (m,).
        wanted : NDArray[np.bool_]
            Whether they carry a channel (m,).
        """
        count = len(received_ns)
        if self._since_ns is not None or self._carried_ns is None or not count:
            return 0
        if int(received_ns.max()) - self._carried_ns < self._limit_ns:
            return count
        carried_ns = np.maximum.accumulate(np.where(wanted, received_ns, self._carried_ns))
        before_ns = np.concatenate(([self._carried_ns], np.maximum(carried_ns[:-1], self._carried_ns)))
        silent = received_ns - before_ns >= self._limit_ns
        return int(np.argmax(silent)) if silent.any() else count

    def pass_over(self, received_ns: int, vehicle_ns: int) -> None:
        """Follow messages without a silence: the newest with a channel, the vehicle's time at the last of them."""
        self._carried_ns = received_ns if self._carried_ns is None else max(received_ns, self._carried_ns)
        self._vehicle_ns = vehicle_ns

    def adopt(self, event: AlarmEvent) -> None:
        """Go on from an event that another run of the monitor, or another monitor, made."""
        self._since_ns = None if event.state == "cleared" else event.since_ns
        if self._carried_ns is None:
            self._carried_ns = event.since_ns - self._limit_ns

    def _event(self, state: State, time_ns: int, vehicle_ns: int, message: str) -> AlarmEvent:
        since_ns = self._since_ns if self._since_ns is not None else time_ns
        return AlarmEvent(
            id=alarm_id(self._vehicle, OBSERVER, CHANNEL, since_ns),
            vehicle=self._vehicle,
            observer=OBSERVER,
            channel=CHANNEL,
            kind="stale",
            state=state,
            severity="warning",
            estimate=None,
            relative=None,
            unit="s",
            threshold=self._limit_ns / 1e9,
            time_ns=time_ns,
            vehicle_time_ms=vehicle_ns // 1_000_000,
            since_ns=since_ns,
            peak=None,
            message=message,
            seq=UNNUMBERED,
        )
