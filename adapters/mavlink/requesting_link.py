"""A MAVLink link that also asks the vehicles it hears for message rates; used only where sending is allowed."""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping

from adapters.mavlink.heartbeat import is_autopilot_heartbeat
from adapters.mavlink.mavlink_link import MavlinkLink
from adapters.mavlink.message_rates import RateRequests, RateStatistics
from adapters.message import Message


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

    def receive(self, timeout_s: float) -> list[Message]:
        """Return the messages that are there, waiting at most ``timeout_s`` for the first; send what is due."""
        messages = self._link.receive(timeout_s)
        for message in messages:
            if self._open and message.system not in self._asked and self._is_component(message):
                self._ask(message.system)
            self._requests.heard(message)
        self._link.send(self._requests.requests(time.time_ns()))
        return messages

    def statistics(self) -> RateStatistics:
        """Return what was asked for and what came."""
        return self._requests.statistics()

    def _ask(self, system: int) -> None:
        self._asked.add(system)
        self._requests.ask(system, self._rates, self._component)

    def _is_component(self, message: Message) -> bool:
        return message.component == self._component and is_autopilot_heartbeat(message)
