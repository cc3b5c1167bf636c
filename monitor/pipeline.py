"""A vehicle's whole pipeline: batches of messages in, estimates and alarm events out.

The same object serves a live link and a recording. It reads no clock: whatever it does follows from the messages
and their times of arrival, so a recorded session replays to the same bits. Other influences are messages, too: time
that passes, what the link found out, an operator's command, other thresholds, alarms that were active before a restart.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from importlib.metadata import version
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adapters.batch import Batch, Columns, cut
from adapters.mavlink.heartbeat import vehicle_type
from adapters.message import SILENCE, Message
from adapters.source import CLOCK, JOURNAL, LINK, OPERATOR
from monitor.alarms import link_alarms
from monitor.alarms.alarm import TUNABLE
from monitor.alarms.desk import AlarmDesk
from monitor.alarms.desk_rule import DeskRule, desk_rule, rule_fields
from monitor.alarms.excuse import Excuses
from monitor.alarms.link_alarms import LinkAlarms, StaleAlarm
from monitor.chain import ObserverChain, alarm_events
from monitor.core.sampling import VehicleClock, sample_batch
from monitor.estimate import Estimates, Layout
from monitor.event import AlarmEvent, is_seq, valid_event
from monitor.profile import Profile
from monitor.sampling.phase import FlightPhase
from monitor.sampling.sampler import SamplerStatistics
from monitor.segments import Arrivals, arrivals_of, message_at, selected

AUTOPILOT = 1
"""MAV_COMP_ID_AUTOPILOT1."""
RULES = "rules"
STANDING = "standing"
"""Name of the message with the alarms that were active before; recordings hold it."""


# Values that overflow are discarded later; NumPy's warnings about them would fill the log.
_quiet_overflow = np.errstate(all="ignore")


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
            | {(link_alarms.OBSERVER, link_alarms.TELEMETRY)}
            | {(link_alarms.OBSERVER, name) for name in link}
        )

    @property
    def stale(self) -> bool:
        """Whether telemetry is stale."""
        return self._stale.active

    @property
    def system(self) -> int:
        """The monitored MAVLink system id; 0 before its first message."""
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
        """The active alarms and what operators did with them; messages change them."""
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

    def accepts(self, message: Message | Columns) -> bool:
        """Return whether a message (or columns) comes from the monitored vehicle: the first to send a channel is it."""
        if not message.source.has_ids:
            return True
        if not message.source.is_telemetry:
            return message.system == self._system
        if self._component and message.component != self._component:
            return False
        if self._system == 0 and message.name in self._wanted:
            self._system = message.system
        return message.system == self._system

    @_quiet_overflow
    def run(self, batch: Batch) -> list[Estimates | AlarmEvent]:
        """Process a batch of messages; return estimates and events.

        A message that does more than bring measurements begins a segment, in which the estimates come before the
        events. The results do not depend on how a stream is cut into batches.

        Parameters
        ----------
        batch : Batch
            One message or thousands, in the order of arrival.
        """
        outputs: list[Estimates | AlarmEvent] = []
        if self._system == 0:
            batch = self._run_unidentified(batch, outputs)
        self._run_accepted(self._accepted(batch), outputs)
        return outputs

    def _run_unidentified(self, batch: Batch, outputs: list[Estimates | AlarmEvent]) -> Batch:
        """Process the messages before the one that tells the system to monitor; return the others."""
        first = batch.count
        for columns in batch.columns:
            if self._identifies(columns):
                first = min(first, int(columns.position[0]))
        for index, message in batch.others.items():
            if self._identifies(message):
                first = min(first, index)
        before, rest = cut(batch, 0, first), cut(batch, first, batch.count)
        self._run_accepted(self._accepted(before), outputs)
        if rest.count:
            self.accepts(message_at(rest, 0))
        return rest

    def _identifies(self, sender: Message | Columns) -> bool:
        """Return whether the vehicle to monitor is the one that sent this."""
        ours = sender.source.has_ids and sender.source.is_telemetry and self._component in (0, sender.component)
        return ours and sender.name in self._wanted and sender.system != 0

    def _accepted(self, batch: Batch) -> Batch:
        """Return the messages that matter, and count those of other senders."""
        self.foreign += sum(
            len(columns.position)
            for columns in batch.columns
            if columns.source.has_ids
            and (columns.system != self._system or self._component not in (0, columns.component))
        )
        self.foreign += sum(not self.accepts(message) for message in batch.others.values())
        return selected(batch, self._interests, self._system, self._component)

    def _run_accepted(self, batch: Batch, outputs: list[Estimates | AlarmEvent]) -> None:
        arrivals = arrivals_of(batch, self._wanted, self._phase)
        own = sorted(index for index, message in batch.others.items() if not message.source.is_telemetry)
        index = 0
        while index < batch.count:
            message = message_at(batch, index)
            outputs.extend(self._desk.tick(message.received_ns))
            if not message.source.is_telemetry:
                outputs.extend(self._run_own(message))
                index += 1
                continue
            outputs.extend(self._through_desk(self._before(message)))
            stop = self._segment_end(arrivals, own, index)
            self._run_segment(batch, arrivals, index, stop, outputs)
            index = stop

    def _before(self, message: Message) -> list[AlarmEvent]:
        """Return the events that the first message of a segment causes before its measurements are looked at."""
        now_ns, vehicle_ns = message.received_ns, self._clock.newest_ns
        self._phase.feed(message)
        events = self._silence(now_ns)
        events += self._link.process(message, vehicle_ns)
        if message.name in self._wanted:
            events += self._stale.follow(now_ns, vehicle_ns)
        return events

    def _segment_end(self, arrivals: Arrivals, own: Sequence[int], start: int) -> int:
        """Return the index of the first message after ``start`` that does more than bring measurements."""
        after = start + 1
        rest = slice(after, None)
        received_ns = arrivals.received_ns[rest]
        heartbeats = arrivals.heartbeats[np.searchsorted(arrivals.heartbeats, after) :] - after
        quiet = min(
            self._stale.first_silent(received_ns, arrivals.wanted[rest]),
            self._link.first_due(received_ns, heartbeats),
            self._first_desk_due(int(arrivals.received_ns[start]), received_ns),
        )
        ends: list[int] = [after + quiet, *own[bisect_left(own, after) :][:1]]
        ends += arrivals.phases[np.searchsorted(arrivals.phases, after) :][:1].tolist()
        return min(ends)

    def _first_desk_due(self, start_ns: int, received_ns: NDArray[np.int64]) -> int:
        """Return the index of the first message at which shelving or a flood may end, else the number of messages."""
        # A flood that begins in the segment lasts for flood_s.
        until_ns = start_ns + round(self._desk.rule.flood_s * 1e9)
        if (due_ns := self._desk.due_ns) is not None:
            until_ns = min(until_ns, due_ns)
        if not len(received_ns) or int(received_ns.max()) < until_ns:
            return len(received_ns)
        return int(np.argmax(received_ns >= until_ns))

    def _run_segment(
        self, batch: Batch, arrivals: Arrivals, start: int, stop: int, outputs: list[Estimates | AlarmEvent]
    ) -> None:
        """Process messages that only bring measurements, after what the first of them changed."""
        before_ns = self._clock.newest_ns
        for chain in self._chains:
            chain.enter(self._phase)
        segment = batch if stop - start == batch.count else cut(batch, start, stop)
        taken = sample_batch(self._clock, [chain.sampler for chain in self._chains], segment)
        self._follow_arrivals(arrivals, start, stop, np.concatenate(((before_ns,), taken.newest_ns)))
        runs = [
            chain.run(samples, position, self._phase)
            for chain, samples, position in zip(self._chains, taken.samples, taken.position, strict=True)
        ]
        outputs.extend(run.estimates for run in runs if len(run.estimates))
        outputs.extend(self._through_desk(alarm_events(runs, self._excuses)))

    def _follow_arrivals(self, arrivals: Arrivals, start: int, stop: int, newest_ns: NDArray[np.int64]) -> None:
        """Let the alarms of silence and of heartbeats follow a segment in which they have nothing to say.

        ``newest_ns`` is the vehicle's newest time before each message of the segment, and after the last.
        """
        carriers = np.flatnonzero(arrivals.wanted[start:stop])
        if len(carriers):
            latest_ns = int(arrivals.received_ns[start:stop][carriers].max())
            self._stale.pass_over(latest_ns, int(newest_ns[carriers[-1]]))
        first, last = np.searchsorted(arrivals.heartbeats, (start, stop))
        beat_ns = int(arrivals.received_ns[arrivals.heartbeats[last - 1]]) if last > first else None
        self._link.pass_over(beat_ns, int(newest_ns[stop - start - 1]))

    def _run_own(self, message: Message) -> list[AlarmEvent]:
        """Process a message that is no telemetry."""
        now_ns, fields = message.received_ns, message.fields
        if message.source is CLOCK:
            return self._through_desk([*self._silence(now_ns), *self._link.quiet(now_ns)])
        if message.source is LINK:
            return self._through_desk(self._link.process(message, self._clock.newest_ns))
        if message.source is JOURNAL:
            return self._adopt(fields, now_ns) if message.name == STANDING else []
        if message.name == RULES:
            return self._retune(fields, now_ns)
        return self._desk.operate(message.name, fields, now_ns)

    def _silence(self, now_ns: int) -> list[AlarmEvent]:
        """Let time come to ``now_ns``, by a message or without one: live and replayed the same."""
        events = self._stale.silence(now_ns)
        if self._stale.active:
            self._link.silent()
        return events

    def _through_desk(self, events: Iterable[AlarmEvent]) -> list[AlarmEvent]:
        return [published for event in events for published in self._desk.process(event)]

    def _adopt(self, fields: Mapping[str, Any], now_ns: int) -> list[AlarmEvent]:
        events = [event for event in handed_over_alarms(fields) if event.vehicle == self.vehicle]
        for event in events:
            if event.latched:
                continue
            if event.observer == link_alarms.OBSERVER:
                (self._stale if event.channel == link_alarms.TELEMETRY else self._link).adopt(event)
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


def rules_message(rule: DeskRule, profile: Profile, now_ns: int) -> Message:
    """Return the message that applies the desk's rule and a profile's alarm sizes from now on."""
    alarms = {
        observer.name: {
            one.channel: {key: value for key, value in asdict(one).items() if key in TUNABLE} for one in observer.alarms
        }
        for observer in profile.observers
    }
    return Message(OPERATOR, RULES, now_ns, {**rule_fields(rule), "alarms": alarms})


def handover_message(
    alarms: Sequence[AlarmEvent], seq: int, now_ns: int, shelved: Mapping[str, int] = MappingProxyType({})
) -> Message:
    """Return the message that lets a pipeline go on where another one stopped.

    It holds the last event of each active alarm, the last number given to an event, and the channels
    (``observer/channel``) that operators had shelved with the Unix times at which shelving ends.
    """
    fields = {"seq": seq, "alarms": [event.to_json() for event in alarms], "shelved": dict(shelved)}
    return Message(JOURNAL, STANDING, now_ns, fields)


def shelved_channels(fields: Mapping[str, Any]) -> dict[str, int]:
    """Return the shelved channels in such a message; invalid entries are left out."""
    shelved = fields.get("shelved")
    found = shelved.items() if isinstance(shelved, Mapping) else ()
    return {name: until for name, until in found if isinstance(name, str) and "/" in name and type(until) is int}


def handed_over_alarms(fields: Mapping[str, Any]) -> list[AlarmEvent]:
    """Return the alarms in such a message; invalid entries are left out."""
    alarms = fields.get("alarms")
    events = map(valid_event, alarms if isinstance(alarms, Sequence) else ())
    return [event for event in events if event is not None]
