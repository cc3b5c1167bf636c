"""A vehicle's whole pipeline: messages in, estimates and alarm events out.

The same object serves a live link and a recording. It reads no clock: whatever it does follows from the messages
and their times of arrival, so a recorded session replays to the same bits.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import version
from itertools import count

from adapters.clock import VehicleClock
from adapters.message import SILENCE, Message
from adapters.phase import FlightPhase
from adapters.sampler import SamplerStatistics
from monitor.chain import ObserverChain, Output
from monitor.estimate import Layout
from monitor.excuse import Excuses
from monitor.profile import Profile
from monitor.stale import StaleAlarm


class Pipeline:
    """State of one monitored vehicle.

    Parameters
    ----------
    profile : Profile
        The vehicle's profile.
    vehicle : str | None
        Name in topics and events; None takes the profile's.
    """

    def __init__(self, profile: Profile, vehicle: str | None = None) -> None:
        self.vehicle = vehicle or profile.name
        self.profile = profile
        counter = count(1)
        self._next_seq = lambda: next(counter)
        self._clock = VehicleClock()
        self._phase = FlightPhase()
        self._excuses = Excuses(profile.excuses)
        self._chains = [
            ObserverChain(observer, self.vehicle, profile.gate, self._clock, self._next_seq, self._excuses)
            for observer in profile.observers
        ]
        self._wanted = frozenset[str]().union(*(chain.interests for chain in self._chains))
        self._stale = StaleAlarm(self.vehicle, profile.stale_s, self._next_seq)
        self._system = profile.system
        self.foreign = 0

    @property
    def interests(self) -> frozenset[str]:
        """Names of the messages that matter; all others may be skipped without changing a result."""
        return self._wanted | FlightPhase.interests | {SILENCE}

    @property
    def needs(self) -> Mapping[str, frozenset[str]]:
        """Names of the messages that each observer's channels come from."""
        return {chain.layout.observer: chain.interests for chain in self._chains}

    @property
    def layouts(self) -> tuple[Layout, ...]:
        """Names and units of the observers' vectors."""
        return tuple(chain.layout for chain in self._chains)

    @property
    def thresholds(self) -> Mapping[tuple[str, str], float]:
        """Alarm thresholds by observer and channel: two observers may watch channels of the same name."""
        return {
            (observer.name, rule.channel): rule.threshold
            for observer in self.profile.observers
            for rule in observer.alarms
        }

    @property
    def stale(self) -> bool:
        """Whether telemetry is stale."""
        return self._stale.active

    def statistics(self) -> Mapping[str, SamplerStatistics]:
        """Return the samplers' counts by observer."""
        return {chain.layout.observer: chain.statistics() for chain in self._chains}

    def metadata(self) -> dict[str, str]:
        """Return what a recording says about how it was made."""
        found = {"fauio": version("fauio"), "vehicle": self.vehicle, "profile": self.profile.digest}
        if self._clock.newest_ns:
            found["unix_minus_vehicle_ns"] = str(self._clock.to_unix(0))
        return found

    def accepts(self, message: Message) -> bool:
        """Return whether a message comes from the monitored vehicle; the first one to send a channel is it."""
        if message.source != "mavlink":
            return True
        if self._system == 0 and message.name in self._wanted:
            self._system = message.system
        return message.system == self._system

    def feed(self, message: Message) -> list[Output]:
        """Take one message; return estimates and events in the order they arise."""
        if not self.accepts(message):
            self.foreign += 1
            return []
        if message.source == "clock":
            return [*self._stale.silence(message.received_ns)]
        outputs: list[Output] = []
        self._phase.feed(message)
        if message.name in self._wanted:
            outputs.extend(self._stale.heard(message.received_ns, self._clock.newest_ns))
            for chain in self._chains:
                if message.name in chain.interests:
                    outputs.extend(chain.feed(message, self._phase))
        return outputs
