"""A vehicle's whole pipeline: messages in, estimates and alarm events out.

The same object serves a live link and a recording. It reads no clock: whatever it does follows from the messages
and their times of arrival, so a recorded session replays to the same bits. What is no telemetry but has a say is a
message too: time that passes, what the link found out, an operator's command, other thresholds, alarms that stood
before a restart.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from importlib.metadata import version
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adapters.batch import Batch, cut
from adapters.mavlink.vehicle_type import vehicle_type
from adapters.message import SILENCE, Message
from adapters.source import CLOCK, JOURNAL, LINK, OPERATOR
from monitor.alarms import link_alarms, stale
from monitor.alarms.alarm import TUNABLE
from monitor.alarms.desk import AlarmDesk
from monitor.alarms.desk_rule import DeskRule, desk_rule, rule_fields
from monitor.alarms.excuse import Excuses
from monitor.alarms.link_alarms import LinkAlarms
from monitor.alarms.stale import StaleAlarm
from monitor.chain import ObserverChain, Output
from monitor.chain_stretch import events_in_order
from monitor.core.sampling import sample_batch
from monitor.estimate import Estimate, Estimates, Layout, alone
from monitor.event import AlarmEvent, is_seq, valid_event
from monitor.profile import Profile
from monitor.sampling.clock import VehicleClock
from monitor.sampling.phase import FlightPhase
from monitor.sampling.sampler import SamplerStatistics
from monitor.uniform import changes_phase, heartbeats, in_order, selected

AUTOPILOT = 1
RULES = "rules"
STANDING = "standing"
_WORTH_IT = 64
"""Messages from which on a stretch is worth what it costs to begin one."""
_LOOK_AHEAD = 2048
_LARGEST_LOOK = 1 << 17
"""Messages looked at for a first stretch; up to so many once one has held."""

Stretch = Estimates | AlarmEvent

# Values that overflow are no evidence, and no news for whoever reads the log.
_ABSURD = np.errstate(all="ignore")


class Pipeline:
    """State of one monitored vehicle.

    Parameters
    ----------
    profile : Profile
        The vehicle's profile.
    vehicle : str | None
        Name in topics and events; None takes the profile's.
    system : int | None
        MAVLink system id to monitor, None takes the profile's; 0: the first that sends the profile's channels.
    component : int
        MAVLink component of that system to listen to; 0: any.
    """

    def __init__(
        self, profile: Profile, vehicle: str | None = None, system: int | None = None, component: int = AUTOPILOT
    ) -> None:
        self.vehicle = vehicle or profile.name
        self.profile = profile
        self._clock = VehicleClock()
        self._phase = FlightPhase()
        self._excuses = Excuses(profile.excuses)
        self._chains = [
            ObserverChain(observer, self.vehicle, profile.gate, self._clock, self._excuses)
            for observer in profile.observers
        ]
        self._wanted = frozenset[str]().union(*(chain.interests for chain in self._chains))
        self._stale = StaleAlarm(self.vehicle, profile.stale_s)
        self._link = LinkAlarms(self.vehicle)
        self._desk = AlarmDesk(self.vehicle, DeskRule())
        self._system = profile.system if system is None else system
        self._component = component
        self._interests = self.interests
        self._ahead = _LOOK_AHEAD
        self.foreign = 0

    @property
    def interests(self) -> frozenset[str]:
        """Names of the messages that matter; all others may be skipped without changing a result."""
        own = {SILENCE, "signing", RULES, STANDING, "ack", "shelve", "unshelve", "reset"}
        return self._wanted | FlightPhase.interests | own

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
            (chain.layout.observer, name): size for chain in self._chains for name, size in chain.thresholds.items()
        }

    @property
    def channels(self) -> frozenset[tuple[str, str]]:
        """Observer and channel of everything that can be an alarm, the desk's own left out."""
        link = (link_alarms.SIGNING, link_alarms.HEARTBEAT)
        return frozenset(
            {(chain.layout.observer, channel) for chain in self._chains for channel in chain.channels}
            | {(stale.OBSERVER, stale.CHANNEL)}
            | {(link_alarms.OBSERVER, name) for name in link}
        )

    @property
    def stale(self) -> bool:
        """Whether telemetry is stale."""
        return self._stale.active

    @property
    def system(self) -> int:
        """The monitored MAVLink system id; 0 while none was heard."""
        return self._system

    @property
    def mismatch(self) -> str | None:
        """What says that the vehicle is another than the profile's; None where nothing does."""
        found, fitted = vehicle_type(self._phase.vehicle_type), self.profile.vehicle_type
        if not found or not fitted or found == fitted:
            return None
        return f"another vehicle than the profile's: it says it is a {found}, the profile was fitted to a {fitted}"

    @property
    def desk(self) -> AlarmDesk:
        """The alarms that stand and what operators did with them; feed messages to change them."""
        return self._desk

    def statistics(self) -> Mapping[str, SamplerStatistics]:
        """Return the samplers' counts by observer."""
        return {chain.layout.observer: chain.statistics() for chain in self._chains}

    def metadata(self) -> dict[str, str]:
        """Return what a recording says about how it was made."""
        found = {"fauio": version("fauio"), "vehicle": self.vehicle, "profile": self.profile.digest}
        newest_ns = self._clock.newest_ns
        if newest_ns:
            found["unix_minus_vehicle_ns"] = str(self._clock.to_unix(newest_ns) - newest_ns)
        return found

    def accepts(self, message: Message) -> bool:
        """Return whether a message comes from the monitored vehicle; the first one to send a channel is it."""
        if not message.source.has_ids:
            return True
        if not message.source.is_telemetry:
            return message.system == self._system
        if self._component and message.component != self._component:
            return False
        if self._system == 0 and message.name in self._wanted:
            self._system = message.system
        return message.system == self._system

    @_ABSURD
    def feed(self, message: Message) -> list[Output]:
        """Take one message; return estimates and events in the order they arise."""
        if not self.accepts(message):
            self.foreign += 1
            return []
        if message.name not in self._interests:
            return []
        now_ns = message.received_ns
        outputs: list[Output] = [*self._desk.tick(now_ns)]
        if not message.source.is_telemetry:
            outputs.extend(self._feed_own(message))
            return outputs
        self._phase.feed(message)
        told = self._desk.take
        outputs.extend(self._tell(self._silence(now_ns)))
        outputs.extend(self._tell(self._link.feed(message, self._clock.newest_ns)))
        if message.name in self._wanted:
            for event in self._stale.heard(now_ns, self._clock.newest_ns):
                outputs.extend(told(event))
            for chain in self._chains:
                if message.name not in chain.interests:
                    continue
                for output in chain.feed(message, self._phase):
                    if isinstance(output, AlarmEvent):
                        outputs.extend(told(output))
                    else:
                        outputs.append(output)
        return outputs

    @_ABSURD
    def run(self, block: Batch) -> list[Stretch]:
        """Take a whole block; return what feeding its messages one by one would return, estimates as arrays.

        Stretches in which the messages do nothing but carry samples are taken at once, the others one by one. Within
        what is returned the estimates of a stretch stand before its events.
        """
        outputs: list[Stretch] = []
        if self._system == 0 and any(one.source.has_ids for one in block.columns):
            block = self._run_until_known(block, outputs)
        chosen = selected(block, self._interests, self._system, self._component)
        self.foreign += self._foreign_in(block)
        order = in_order(chosen)
        place, single = 0, 1
        while place < chosen.count:
            stop = min(place + self._ahead, chosen.count)
            taken = self._run_uniform(cut(chosen, place, stop), outputs)
            place += taken
            if place == stop:
                self._ahead = min(4 * self._ahead, _LARGEST_LOOK)
                continue
            # Where stretches end again and again, looking for them would cost more than they save.
            self._ahead = _LOOK_AHEAD
            single = 1 if taken > _WORTH_IT else min(2 * single, _WORTH_IT)
            for at in range(place, min(place + single, chosen.count)):
                outputs.extend(_as_stretches(self.feed(order.message(at))))
            place = min(place + single, chosen.count)
        return outputs

    def _run_until_known(self, block: Batch, outputs: list[Stretch]) -> Batch:
        """Feed messages one by one until the system that is monitored is known; return the rest of the block."""
        order = in_order(block)
        for place in range(block.count):
            outputs.extend(_as_stretches(self.feed(order.message(place))))
            if self._system:
                return cut(block, place + 1, block.count)
        return cut(block, 0, 0)

    def _foreign_in(self, block: Batch) -> int:
        """Return how many messages are another vehicle's; those that are fed one by one are counted there."""
        unfed = (one for one in block.others.values() if one.name not in self._interests)
        return sum(not self.accepts(one) for one in unfed) + sum(
            len(one.position)
            for one in block.columns
            if one.source.has_ids
            and (one.system != self._system or (self._component and one.component != self._component))
        )

    def _run_uniform(self, block: Batch, outputs: list[Stretch]) -> int:
        """Take the first messages of a block as far as they can be taken as a whole; return how many."""
        order = in_order(block)
        received_ns, heartbeat = order.received_ns, heartbeats(order)
        wanted = np.array([*(one.name in self._wanted for one in block.columns), False])[order.column]
        count = min(
            changes_phase(order, self._phase),
            self._stale.first_silent(received_ns, wanted),
            self._link.first_due(received_ns, heartbeat),
            self._desk_quiet(received_ns),
        )
        if count < _WORTH_IT:
            return 0
        before_ns = self._clock.newest_ns
        for chain in self._chains:
            chain.enter(self._phase)
        taken = sample_batch(self._clock, [chain.sampler for chain in self._chains], cut(block, 0, count))
        newest_ns = np.concatenate(((before_ns,), taken.newest_ns))
        if (heard := np.flatnonzero(wanted[:count])).size:
            self._stale.pass_over(int(received_ns[heard].max()), int(newest_ns[heard[-1]]))
        beats = np.flatnonzero(heartbeat[:count])
        self._link.pass_over(int(received_ns[beats[-1]]) if beats.size else None, int(newest_ns[count - 1]))
        stretches = [
            chain.run(samples, position, self._phase)
            for chain, samples, position in zip(self._chains, taken.samples, taken.position, strict=True)
        ]
        outputs.extend(one.estimates for one in stretches if len(one.estimates))
        outputs.extend(self._tell(events_in_order(stretches, self._excuses)))
        return count

    def _desk_quiet(self, received_ns: NDArray[np.int64]) -> int:
        """Return the first message at which the desk may have to speak by itself, also of what may come before it."""
        until_ns = int(received_ns[0]) + round(self._desk.rule.flood_s * 1e9) if len(received_ns) else 0
        if (due_ns := self._desk.due_ns) is not None:
            until_ns = min(until_ns, due_ns)
        late = received_ns >= until_ns
        return int(np.argmax(late)) if late.any() else len(received_ns)

    def _feed_own(self, message: Message) -> list[AlarmEvent]:
        """Take a message that is no telemetry."""
        now_ns, fields = message.received_ns, message.fields
        if message.source is CLOCK:
            return self._tell([*self._silence(now_ns), *self._link.quiet(now_ns)])
        if message.source is LINK:
            return self._tell(self._link.feed(message, self._clock.newest_ns))
        if message.source is JOURNAL:
            return self._adopt(fields, now_ns) if message.name == STANDING else []
        if message.name == RULES:
            return self._retune(fields, now_ns)
        return self._desk.operate(message.name, fields, now_ns)

    def _silence(self, now_ns: int) -> list[AlarmEvent]:
        """Note that time has come to ``now_ns``, by a message or without one: live and replayed the same."""
        events = self._stale.silence(now_ns)
        if self._stale.active:
            self._link.silent()
        return events

    def _tell(self, events: Iterable[AlarmEvent]) -> list[AlarmEvent]:
        return [told for event in events for told in self._desk.take(event)]

    def _adopt(self, fields: Mapping[str, Any], now_ns: int) -> list[AlarmEvent]:
        events = [event for event in standing_alarms(fields) if event.vehicle == self.vehicle]
        for event in events:
            if event.latched:
                continue
            if event.observer == stale.OBSERVER:
                (self._stale if event.channel == stale.CHANNEL else self._link).adopt(event)
            for chain in self._chains:
                if chain.layout.observer == event.observer:
                    chain.adopt(event)
        seq = fields.get("seq")
        self._desk.seq = max(self._desk.seq, seq if is_seq(seq) else 0)
        return self._desk.adopt(events, self.channels, now_ns, shelved_channels(fields))

    def _retune(self, fields: Mapping[str, Any], now_ns: int) -> list[AlarmEvent]:
        alarms = fields.get("alarms")
        for chain in self._chains:
            rules = alarms.get(chain.layout.observer) if isinstance(alarms, Mapping) else None
            if isinstance(rules, Mapping):
                chain.retune({name: rule for name, rule in rules.items() if isinstance(rule, Mapping)})
        return self._desk.set_rule(desk_rule(fields, self._desk.rule), now_ns)


def _as_stretches(outputs: Iterable[Output]) -> list[Stretch]:
    return [alone(output) if isinstance(output, Estimate) else output for output in outputs]


def rules_message(rule: DeskRule, profile: Profile, now_ns: int) -> Message:
    """Return the message that makes the desk's rule and a profile's alarm sizes hold from now on."""
    alarms = {
        observer.name: {
            one.channel: {key: value for key, value in asdict(one).items() if key in TUNABLE} for one in observer.alarms
        }
        for observer in profile.observers
    }
    return Message(OPERATOR, RULES, now_ns, {**rule_fields(rule), "alarms": alarms})


def standing_message(
    alarms: Sequence[AlarmEvent], seq: int, now_ns: int, shelved: Mapping[str, int] = MappingProxyType({})
) -> Message:
    """Return the message that tells a pipeline what held when another one stopped.

    Parameters
    ----------
    alarms : Sequence[AlarmEvent]
        The last event of each alarm that stood.
    seq : int
        The last number given to an event.
    now_ns : int
        Unix time.
    shelved : Mapping[str, int]
        Channels (``observer/channel``) that operators had shelved, and the Unix times at which they speak again.
    """
    told = {"seq": seq, "alarms": [event.to_json() for event in alarms], "shelved": dict(shelved)}
    return Message(JOURNAL, STANDING, now_ns, told)


def shelved_channels(fields: Mapping[str, Any]) -> dict[str, int]:
    """Return the shelved channels in such a message; what is none is left out."""
    shelved = fields.get("shelved")
    found = shelved.items() if isinstance(shelved, Mapping) else ()
    return {name: until for name, until in found if isinstance(name, str) and "/" in name and type(until) is int}


def standing_alarms(fields: Mapping[str, Any]) -> list[AlarmEvent]:
    """Return the alarms in such a message; what is none is left out."""
    alarms = fields.get("alarms")
    events = map(valid_event, alarms if isinstance(alarms, Sequence) else ())
    return [event for event in events if event is not None]
