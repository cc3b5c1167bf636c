"""The daemon's loop: batches from the inbox to their vehicles, and periodic work when none waits.

Every decision is made in the vehicles' pipelines, which read no clock. The loop moves messages, advances the time when
no messages come, and reports after each vehicle that it is alive.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from monitor.service.fleet import Fleet
from monitor.service.inbox import Arrival, Inbox
from monitor.service.latency import ArrivalClock
from monitor.service.vehicle_service import VehicleService

_POLL_S = 0.05
"""Time after which an idle loop looks at signals, requests and the time. Chosen: waking twenty times a second costs
nothing measurable."""
_EVERY_NS = 100_000_000
"""Period of the periodic work. Chosen: an operator does not notice a tenth of a second, and every 50 ms it took 0.4 %
of a core."""
_PATIENCE_NS = 50_000_000
"""How long periodic work that is due waits for a moment without messages. Chosen: batches come every 20 ms and are
processed in less, so it takes longer only under load, or after the process was stopped."""
_WORK_SHARE = 4
"""If processor time is short, periodic work takes a fourth of the loop's time and the vehicles the rest."""
_LATEST_NS = 500_000_000
"""Longest delay of the periodic work, whatever it costs: a status is due each second."""


class Daemon:
    """Runs the vehicles of one process on live links.

    ``services`` returns the vehicles' services, whose number may grow; ``troubles`` the problems of links and disks,
    for the status. ``every_turn`` is called about ten times a second with the steady time, for reloads and retries; it
    returns whether to go on. ``alive`` is called after each vehicle: with little processor time, a turn of the whole
    fleet takes as long as a turn that hangs. ``batch_s`` is how long links wait for telemetry to form batches.

    What is due is decided by the steady time (nanoseconds of the monotonic clock), which nobody can set; Unix time is
    for stamps only.
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
        self._due_ns = 0

    def run(self) -> None:
        """Monitor until ``every_turn`` says that it is over, and process the batches of that turn."""
        running = True
        while running:
            arrivals = self._inbox.take(_POLL_S)
            # Elect first after a process freeze: another monitor may be active.
            if time.monotonic_ns() >= self._due_ns + _PATIENCE_NS:
                running = self._work()
            self._process(arrivals)
            # Advance the time only if no older message waits, here or in a link: that message would end a silence.
            if self._inbox.empty:
                now_ns = time.time_ns() - max(self._held_ns, round(1e9 * self._inbox.unread_s))
                for monitor in self._fleet:
                    monitor.pass_time(now_ns)
                # Alarms do not wait for a status.
                if running and time.monotonic_ns() >= self._due_ns:
                    running = self._work()

    def _work(self) -> bool:
        """Do the periodic work; return whether to go on."""
        steady_ns = time.monotonic_ns()
        running = self._every_turn(steady_ns)
        self._alive()
        troubles = self._troubles()
        for service in self._services():
            service.work(steady_ns, time.time_ns(), troubles)
            self._alive()
        took_ns = time.monotonic_ns() - steady_ns
        self._due_ns = steady_ns + max(_EVERY_NS, took_ns + min((_WORK_SHARE - 1) * took_ns, _LATEST_NS))
        return running

    def finish(self, patience_s: float) -> None:
        """Process the messages that still wait in the inbox, for at most this long.

        Call it after the links are closed.
        """
        until = time.monotonic() + patience_s
        while not self._inbox.empty and time.monotonic() < until:
            self._process(self._inbox.take(0.0))

    def _process(self, arrivals: Sequence[Arrival]) -> None:
        for vehicle, batch in self._fleet.routed(arrivals):
            vehicle.process(batch, self._clock.ages_ns)
            self._alive()
