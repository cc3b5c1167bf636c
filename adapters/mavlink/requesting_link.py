"""A MAVLink link that also asks the vehicles it hears for message rates; used only where sending is allowed."""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping

from adapters.batch import Batch, Columns
from adapters.mavlink.heartbeat import autopilot_heartbeats
from adapters.mavlink.mavlink_link import MavlinkLink
from adapters.mavlink.message_rates import RateRequests, RateStatistics


class RequestingLink:
    """A link and the requests that go out over it.

    Parameters
    ----------
    link : MavlinkLink
        The link, opened with ``may_send``.
    requests : RateRequests
        The requests.
    rates : Mapping[str, float]
        Rate in hertz by MAVLink message name.
    systems : Collection[int]
        Systems that are asked; none: every system whose autopilot is heard.
    component : int
        Component that is asked.
    """

    def __init__(
        self,
        link: MavlinkLink,
        requests: RateRequests,
        rates: Mapping[str, float],
        systems: Collection[int],
        component: int,
    ) -> None:
        self._link = link
        self._requests = requests
        self._rates = rates
        self._component = component
        self._open = not systems
        self._asked: set[int] = set()
        for system in systems:
            self._ask(system)

    def receive(self, timeout_s: float) -> Batch:
        """Return what has arrived, waiting at most ``timeout_s`` for the first packet; send what is due."""
        batch = self._link.receive(timeout_s)
        for columns in batch.columns:
            if self._open and columns.system not in self._asked and self._has_autopilot(columns):
                self._ask(columns.system)
            self._requests.count(columns)
        self._link.send(self._requests.requests(time.time_ns()))
        return batch

    def statistics(self) -> RateStatistics:
        """Return what was asked for and what came."""
        return self._requests.statistics()

    def _ask(self, system: int) -> None:
        self._asked.add(system)
        self._requests.ask(system, self._rates, self._component)

    def _has_autopilot(self, columns: Columns) -> bool:
        return columns.component == self._component and bool(autopilot_heartbeats(columns).any())
