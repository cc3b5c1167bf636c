"""The daemon's loop: batches from the inbox to their vehicles, and periodic work in between.

Everything that decides sits in the vehicles' pipelines, which read no clock; the loop moves messages, lets time pass
where nothing comes, and says after each vehicle that it is alive.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from monitor.service.fleet import Fleet
from monitor.service.inbox import Arrival, Inbox
from monitor.service.latency import ArrivalClock
from monitor.service.vehicle_service import VehicleService

_POLL_S = 0.05
"""Chosen: how late an idle loop sees signals, requests and time; waking twenty times a second costs nothing
measurable.
"""
_EVERY_NS = 50_000_000
"""Periodic work. Chosen: as often as an idle loop wakes."""
_WORK_SHARE = 4
"""Of a loop with little processor time periodic work takes a fourth, the vehicles have the rest."""
_LATEST_NS = 500_000_000
"""So late it is done whatever it takes: a status is due each second."""


class Daemon:
    """Runs the vehicles of one process on live links.

    ``services`` returns the vehicles' services, which may become more; ``troubles`` what is wrong with links and disks,
    for the status; ``every_turn`` is called about twenty times a second with the steady time, for reloads and retries,
    and returns whether to go on; ``alive`` after each vehicle, for with little time for its fleet a turn is as long as
    one that hangs. ``batch_s`` is how long links let telemetry wait to form batches.

    What is due goes by the steady time (nanoseconds of the monotonic clock), which nobody sets; Unix time only stamps.
    """

    def __init__(
        self,
        inbox: Inbox,
        fleet: Fleet,
        services: Callable[[], Sequence[VehicleService]],
        troubles: Callable[[], Sequence[str]],
        every_turn: Callable[[int], bool],
        alive: Callable[[], None],
        batch_s: float = 0.0,
    ) -> None:
        self._inbox = inbox
        self._fleet = fleet
        self._services = services
        self._troubles = troubles
        self._every_turn = every_turn
        self._alive = alive
        self._held_ns = round(1e9 * batch_s)
        self._clock = ArrivalClock()

    def run(self) -> None:
        """Monitor until a turn says that it is over, and process the batches of that turn."""
        due_ns, running = 0, True
        while running:
            arrivals = self._inbox.take(_POLL_S)
            steady_ns = time.monotonic_ns()
            # Elect first: after a process freeze another monitor may be active.
            if steady_ns >= due_ns:
                running = self._every_turn(steady_ns)
                self._alive()
                troubles = self._troubles()
                for service in self._services():
                    service.work(steady_ns, time.time_ns(), troubles)
                    self._alive()
                took_ns = time.monotonic_ns() - steady_ns
                due_ns = steady_ns + max(_EVERY_NS, took_ns + min((_WORK_SHARE - 1) * took_ns, _LATEST_NS))
            self._process(arrivals)
            # Time may pass only where nothing older waits, here or in the links: it would end a silence.
            if self._inbox.empty:
                now_ns = time.time_ns() - max(self._held_ns, round(1e9 * self._inbox.unread_s))
                for monitor in self._fleet:
                    monitor.pass_time(now_ns)

    def finish(self, patience_s: float) -> None:
        """Process what still waits in the inbox, for so long at most; use it once the links are closed."""
        until = time.monotonic() + patience_s
        while not self._inbox.empty and time.monotonic() < until:
            self._process(self._inbox.take(0.0))

    def _process(self, arrivals: Sequence[Arrival]) -> None:
        for vehicle, batch in self._fleet.routed(arrivals):
            vehicle.process(batch, self._clock.ages_ns)
            self._alive()
