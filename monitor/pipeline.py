"""The whole pipeline of a vehicle: batches of messages in, estimates and alarm events out.

The same object serves a live link and a recording. It reads no clock: its results depend only on the messages and their
times of arrival, so a recorded session replays to the same bits. Every other influence is a message, too: the passing
of time, findings of the link, an operator's command, other thresholds, alarms that were active before a restart.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from dataclasses import asdict
from importlib.metadata import version
from types import MappingProxyType
from typing import Any

import numpy as np

from adapters.batch import Batch, Columns, cut
from adapters.mavlink.heartbeat import AUTOPILOT
from adapters.mavlink.mavlink_columns import SEQUENCE
from adapters.message import LATEST_NS, SECOND_NS, SILENCE, Message
from adapters.source import CLOCK, JOURNAL, LINK, MAVLINK, OPERATOR
from monitor import blind
from monitor.alarms import link_alarms
from monitor.alarms.alarm import LATELY_NS, TUNABLE
from monitor.alarms.command_watch import COMMANDS, CommandWatch, StreamFilter, command_sent, commanded_systems
from monitor.alarms.desk import AlarmDesk, DeskRule, desk_rule, rule_fields
from monitor.alarms.excuse import Doubt, Excuses, general_of
from monitor.alarms.link_alarms import HEARTBEAT_NS, SET_BACK_NS, LinkAlarms, StaleAlarm
from monitor.blind import BlindAlarm, Watching
from monitor.chain import ChainRun, ObserverChain, alarm_events
from monitor.conditions.condition import FlightCondition
from monitor.conditions.conditions import Conditions, make_conditions
from monitor.core.arrivals import Arrivals
from monitor.core.sampling import VehicleClock, sample_batch
from monitor.estimate import Estimates, Layout
from monitor.event import AlarmEvent, is_seq, valid_event
from monitor.profile import Profile, seen_sooner
from monitor.sampling.gate import allows
from monitor.sampling.identity import Identity
from monitor.sampling.phase import CONTESTED, FlightPhase
from monitor.sampling.sampler import SamplerStatistics
from monitor.sampling.supply import BATTERY_MESSAGE

RULES = "rules"
RESET = "reset"
STANDING = "standing"
"""Name of the message with the alarms that were active before a restart; recordings hold it."""
_LARGEST_SYSTEM = 255
"""MAVLink's ids have one byte."""
_OFFSET_LETTERS = 20
"""Largest signed whole number of 64 bits."""
_LANDED_NS = 3 * SECOND_NS
"""How long a vehicle has to be disarmed before its alarms are closed: three heartbeats, so that a forged one is
contradicted before (:mod:`monitor.sampling.phase`)."""
_TWICE_NUMBERED = (
    "its packets have two series of sequence numbers (or several links of the vehicle are merged into one: give each a "
    "port of its own)"
)
_FORGED = {
    "turns": "came more often than before, with the values of two senders alternating",
    "before": "repeats earlier values, one after the other: a recording is sent again",
    "still": "has outputs that stand still while its others move",
    "pace": "comes as often as before, but its stamps go on {pace:.2f} times as fast",
    "fixes": "has stamps that go on {pace:.3f} times as fast as time, by its fixes, a whole number of them a second",
    "response": "has commands that the rates do not follow any more: one of the two is not its own",
}
"""The sentences for the kinds of evidence in ``VehicleClock.found``."""
_NUMBERED_NS = 10_000_000_000
"""How long a contradiction is reported after the last finding. Chosen: as long as clocks are contested
(``core/sampling.pyx``)."""

_TOGETHER_NS = SECOND_NS // 2
"""How much earlier than the IMU's first repeated or frozen row alarms may be that follow from it. Chosen: a GPS is
stamped 0.2 s earlier than its fix is known, and an IMU comes at 4 Hz at least."""
_MOVED_NS = 4 * SECOND_NS
"""How long a vehicle that reports not to fly any more has to move on. A car brakes from 35 m/s in that time; PX4's
planes report a landing when they are slow, ArduPilot's when they have stopped."""
_LEVEL_NS = 5 * SECOND_NS
"""Time over which a landing vehicle's command is that of hovering. Of a copter that bounced on the ground with running
motors it was 0.82 of that over 5 s (0.9 and more count), 0.87 over 2 s."""


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
    force : bool
        Whether to watch also a vehicle that says it is another than the profile's.

    Attributes
    ----------
    system : int
        The MAVLink system id to monitor; 0: the first that sends a channel, which it becomes.
    interests : frozenset[str]
        Names of the messages that matter.
    desk : AlarmDesk
        The active alarms and what operators did with them; messages change them.
    foreign : int
        Messages of other senders.
    contradictions : Sequence[str]
        What arrived lately that two senders must have sent, a sentence each.
    """

    def __init__(
        self,
        profile: Profile,
        vehicle: str | None = None,
        system: int | None = None,
        component: int = AUTOPILOT,
        *,
        force: bool = False,
    ) -> None:
        self.vehicle = vehicle or profile.name
        self.profile = profile
        self._clock = VehicleClock()
        self._phase = FlightPhase(None if force else profile.identity)
        self._link = LinkAlarms(self.vehicle)
        self._excuses = Excuses(profile.excuses)
        sooner = seen_sooner(
            {observer.name: [fault.name for fault in observer.faults] for observer in profile.observers}
        )
        self._chains = [
            ObserverChain(observer, self.vehicle, profile.gate, self._clock, self._excuses, sooner[observer.name])
            for observer in profile.observers
        ]
        self._gates = [chain.gate for chain in self._chains]
        self._conditions = make_conditions(profile, self._clock)
        self._samplers = [chain.sampler for chain in self._chains]
        self._stages: list[ObserverChain | Conditions] = [*self._chains]
        if self._conditions is not None:
            # alarms of the pipeline itself; they come after those of the observers
            self._samplers.append(self._conditions.sampler)
            self._stages.append(self._conditions)
        self._wanted, self.interests = _carriers(profile), interests_of(profile)
        self._stale = StaleAlarm(self.vehicle, profile.stale_s)
        self._commands, self._streams = CommandWatch(), StreamFilter()
        self._blind = BlindAlarm(self.vehicle, self._chains)
        self.desk = AlarmDesk(self.vehicle, DeskRule(), general_of(profile.excuses))
        self.system = profile.system if system is None else system
        self._component = component
        self._down_ns: int | None = None  # time since which the vehicle reports that its flight is over
        self._grounded_ns = 0  # when it began to report that it does not fly
        self._driven_ns: int | None = None  # when to compare the commands, or the speed, with that report
        self._level_ns: int | None = None  # when to compare them with the report that it lands
        # names of the messages whose values show two senders, and the sentence that says so
        self._forged: Mapping[str, str] = {}
        # those, messages of a recording that is sent again, and messages that stand still, since when
        self._untrue: tuple[Mapping[str, str], Set[str], Mapping[str, int]] = {}, set(), {}
        self._numbered_ns = 0  # until when sequence numbers show two senders
        self._flown_ns = 0  # when it last reported to fly
        # when the segment that may go on began, and from when on a message does more; the latest time: none goes on
        self._begun_ns, self._due_ns = LATEST_NS, 0
        self.foreign = 0
        self.contradictions: Sequence[str] = ()

    @property
    def needs(self) -> Mapping[str, frozenset[str]]:
        """Names of the messages that each observer's channels come from."""
        return {chain.layout.observer: chain.sampler.interests for chain in self._chains}

    @property
    def layouts(self) -> tuple[Layout, ...]:
        """Names and units of the observers' vectors."""
        return tuple(chain.layout for chain in self._chains)

    @property
    def thresholds(self) -> Mapping[tuple[str, str], float]:
        """Alarm thresholds by observer and channel: two observers may have channels of the same name."""
        return {
            (chain.layout.observer, name): size for chain in self._chains for name, size in chain.thresholds.items()
        }

    @property
    def channels(self) -> frozenset[tuple[str, str]]:
        """Observer and channel of every possible alarm, without the desk's own."""
        link = (link_alarms.SIGNING, link_alarms.HEARTBEAT, link_alarms.IMPOSTOR, link_alarms.COMMAND)
        return frozenset(
            {(chain.layout.observer, channel) for chain in self._chains for channel in chain.channels}
            | {(link_alarms.OBSERVER, link_alarms.TELEMETRY), (blind.OBSERVER, blind.CHANNEL)}
            | {(link_alarms.OBSERVER, name) for name in link}
        )

    @property
    def stale(self) -> bool:
        """Whether telemetry is stale."""
        return self._stale.active

    @property
    def blind(self) -> str | None:
        """Which parts of a flying vehicle are not watched, and why; None: all are watched."""
        if (active := self._blind.active) is not None:
            return active.message
        # Of a vehicle that was silent since the start it is not known whether it flies.
        if self._stale.active and self._blind.received and self._flies():
            return "telemetry ended in flight: nothing is watched"
        return f"not watched: {self.refused}" if self.refused and self._phase.armed else None

    def watching(self, now_ns: int) -> dict[str, Watching]:
        """Return how each observer watches at a Unix time."""
        return self._blind.watching(now_ns, self._clock.newest_ns, *self._flight())

    @property
    def conditions(self) -> Sequence[FlightCondition]:
        """Findings that are no faults, in their order."""
        return () if self._conditions is None else tuple(self._conditions.found)

    @property
    def outside(self) -> list[str]:
        """What of the flight lies outside of the fitted flights, a sentence for each observer that reports it."""
        return [f"{chain.layout.observer}: {text}" for chain in self._chains if (text := chain.outside) is not None]

    @property
    def furthest(self) -> Mapping[str, tuple[float, str]]:
        """For how long, seconds, and how far the flight so far lay outside of the fitted flights, by observer."""
        return {chain.layout.observer: far for chain in self._chains if (far := chain.furthest) is not None}

    @property
    def mismatch(self) -> str | None:
        """What shows that the vehicle is not the profile's; None if nothing does."""
        return self._phase.reports.identity.contradiction(self.profile.identity)

    @property
    def identified(self) -> bool:
        """Whether the vehicle has identified itself in any way."""
        return self._phase.reports.identity != Identity()

    @property
    def refused(self) -> str | None:
        """Why the vehicle is not watched: the :attr:`mismatch`, unless the user has forced it."""
        return self._phase.contradiction

    def statistics(self) -> Mapping[str, SamplerStatistics]:
        """Return the samplers' counts by observer."""
        return {chain.layout.observer: chain.sampler.statistics() for chain in self._chains}

    def metadata(self) -> dict[str, str]:
        """Return how a recording was made; the clock's mapping is blank until it is known."""
        newest_ns = self._clock.newest_ns
        offset = str(self._clock.to_unix(newest_ns) - newest_ns) if newest_ns else ""
        made = {"fauio": version("fauio"), "vehicle": self.vehicle, "profile": self.profile.digest}
        return made | {"unix_minus_vehicle_ns": offset.rjust(_OFFSET_LETTERS)}

    def accepts(self, message: Message | Columns) -> bool:
        """Return whether a message (or columns) comes from the monitored vehicle, or commands it.

        The first system that sends a channel becomes the vehicle.
        """
        source, is_its = message.source, message.system == self.system != 0
        if not source.has_ids or (is_its and self._component in (0, message.component)):
            return True
        if not {0, self.system}.isdisjoint(commanded_systems(message)):
            return True
        if not source.is_telemetry:
            return message.system == self.system
        if self._component and message.component != self._component:
            return False
        if self.system == 0 and message.name in self._wanted:
            self.system = message.system
        return message.system == self.system

    @_quiet_overflow
    def run(self, batch: Batch) -> list[Estimates | AlarmEvent]:
        """Process a batch of messages; return estimates and events.

        A message that is more than a measurement begins a segment, in which the estimates come before the events; it
        goes on in later batches. The results do not depend on how a stream is cut into batches.

        Parameters
        ----------
        batch : Batch
            One message or thousands, in the order of arrival.
        """
        outputs: list[Estimates | AlarmEvent] = []
        if self.system == 0:
            batch = self._run_unidentified(batch, outputs)
        self._run_accepted(batch, outputs)
        return outputs

    def _run_unidentified(self, batch: Batch, outputs: list[Estimates | AlarmEvent]) -> Batch:
        """Process the messages before the one that sets the system to monitor; return the others."""
        senders: list[tuple[int, Message | Columns]] = list(batch.others.items())
        senders += [(int(columns.position[0]), columns) for columns in batch.columns]
        identifying = [(index, system) for index, sender in senders if (system := self._system_of(sender))]
        first, system = min(identifying, default=(batch.count, 0))
        self._run_accepted(cut(batch, 0, first), outputs)
        self.system = system
        return cut(batch, first, batch.count)

    def _system_of(self, sender: Message | Columns) -> int:
        """Return the system that a message tells to monitor: its sender, or the one a daemon was told; 0 for none."""
        if sender.source is OPERATOR and sender.name == RULES and isinstance(sender, Message):
            system = sender.fields.get("system")
            return system if type(system) is int and 0 < system <= _LARGEST_SYSTEM else 0
        return sender.system if self.identifies(sender) else 0

    def identifies(self, sender: Message | Columns) -> bool:
        """Return whether the vehicle to monitor may have sent this: it is one of the profile's messages."""
        ours = sender.source.has_ids and sender.source.is_telemetry and self._component in (0, sender.component)
        return ours and sender.name in self._wanted and sender.system != 0

    def _run_accepted(self, batch: Batch, outputs: list[Estimates | AlarmEvent]) -> None:
        """Process the messages of a batch that matter, and count those of other senders."""
        arrivals = Arrivals(
            batch, self.interests, self._wanted, self.system, self._component, self._phase, self._streams
        )
        self.foreign += arrivals.foreign
        # The segment of the batch before goes on, unless the clock was set back since it began.
        goes_on = arrivals.batch.count and self._begun_ns <= arrivals.received_ns(0)
        index = self._run_segment(arrivals, 0, outputs, begins=False) if goes_on else 0
        while index < arrivals.batch.count:
            message = arrivals.message(index)
            outputs.extend(self.desk.tick(message.received_ns))
            if not message.source.is_telemetry or _commands(message):
                outputs.extend(self._run_own(message))
                self._begun_ns = LATEST_NS
                index += 1
                continue
            outputs.extend(self._through_desk(self._before(message)))
            self._begin_segment(message.received_ns)
            index = self._run_segment(arrivals, index, outputs, begins=True)

    def _before(self, message: Message) -> list[AlarmEvent]:
        """Return the events that the first message of a segment causes before its measurements are processed."""
        now_ns, vehicle_ns = message.received_ns, self._clock.newest_ns
        was_grounded = self._phase.grounded
        if self._phase.armed and self._flies():
            self._flown_ns = now_ns
            if self._phase.landed is None:
                self._phase.fly()
        self._phase.feed(message)
        self._compare_commands(was_grounded, now_ns)
        self._follow_landing(now_ns)
        events = [*self._close_at_landing(now_ns), *self._silence(now_ns)]
        events += self._link.process(message, vehicle_ns)
        events += self._contradict(now_ns)
        if message.name in self._wanted:
            events += self._stale.follow(now_ns, vehicle_ns)
        return events

    def _command(self, message: Message) -> list[AlarmEvent]:
        """Follow who commands the vehicle; a single forged report of a landing does not make its sender a known one."""
        now_ns = message.received_ns
        sent = command_sent(message.name, message.fields, now_ns / 1e9, message.system, message.component, self.system)
        flies = self._flies() or 0 <= now_ns - self._flown_ns < _LANDED_NS
        found = [] if sent is None else self._commands.follow(sent, flies)
        return [event for command in found for event in self._link.commanded(command, now_ns)]

    def _begin_segment(self, start_ns: int) -> None:
        """Prepare for a segment by what its first message has changed."""
        self._begun_ns, self._due_ns = start_ns, self._next_due_ns(start_ns)
        allowed = allows(self.profile.gate, self._phase)
        for stage in self._stages:
            stage.enter(allowed)
        self._clock.flies = allowed and bool(self._phase.armed)

    def _run_segment(
        self, arrivals: Arrivals, start: int, outputs: list[Estimates | AlarmEvent], *, begins: bool
    ) -> int:
        """Process the measurements of a segment, which begins here or in an earlier batch; return its end."""
        reach = functools.partial(
            arrivals.segment,
            start,
            begins,
            self._due_ns,
            self._stale.carried_ns,
            self._stale.limit_ns,
            self._link.heartbeat_ns,
            HEARTBEAT_NS,
            self._link.awaits_heartbeat,
            SET_BACK_NS,
        )
        segment = reach(arrivals.batch.count)
        if segment.stop == start:
            return start
        before_ns, contests_ns = self._clock.newest_ns, self._contests_ns
        batch = cut(arrivals.batch, start, segment.stop)
        taken = sample_batch(self._clock, self._samplers, batch, stops=True)
        if taken.used < batch.count:
            # The clock is contested from here on; the next message has to report it.
            segment = reach(start + taken.used)
            batch = cut(arrivals.batch, start, segment.stop)
        if self._contests_ns != contests_ns:
            self._begun_ns = LATEST_NS
        for report in arrivals.reports(start + begins, segment.stop):
            # None of these messages changes the phase alone, but they may together with another one.
            self._phase.feed(report)
        # The newest time before a message is that after the message before it.
        if segment.carrier >= 0:
            at = segment.carrier - start
            self._stale.pass_over(segment.carried_ns, int(taken.newest_ns[at - 1]) if at else before_ns)
        last = segment.stop - start - 1
        self._link.pass_over(segment.heartbeat_ns, int(taken.newest_ns[last - 1]) if last else before_ns)
        if self._conditions is not None:
            self._conditions.run(taken.samples[-1], self._phase)
        each = [
            chain.run(samples, position, self._phase, batch)
            for chain, samples, position in zip(self._chains, taken.samples, taken.position, strict=False)
        ]
        runs = [run for run in each if run is not None]
        self._follow_evidence(batch, each, lambda position: arrivals.received_ns(start + position))
        outputs.extend(run.estimates for run in runs)
        outputs.extend(self._through_desk(alarm_events(runs, self._excuses)))
        return segment.stop

    @property
    def _contests_ns(self) -> tuple[int, ...]:
        """Unix times until which measurements show two senders."""
        return self._clock.contested_ns, *self._clock.found.values()

    def _next_due_ns(self, start_ns: int) -> int:
        """Return the Unix time from which on a message of a segment would do more than bring measurements."""
        # A flood that begins in the segment lasts for flood_s.
        flood_ns = start_ns + round(self.desk.rule.flood_s * 1e9)
        later_ns = [ns for ns in (*self._contests_ns, self._numbered_ns) if start_ns < ns]
        later_ns += [ns for ns in (self.desk.due_ns, self._driven_ns, self._level_ns) if ns is not None]
        blind_ns = self._blind.due_ns(self._flies(), start_ns)
        return min(flood_ns, blind_ns, self._landed_ns, self._link.due_ns, *later_ns)

    def _follow_evidence(self, batch: Batch, runs: Sequence[ChainRun | None], received: Callable[[int], int]) -> None:
        """Follow the evidence that the messages of a segment gave."""
        self._blind.receive(batch)
        idle_ns = 0
        for chain, flow, run in zip(self._chains, self._blind.flows, runs, strict=True):
            if run is not None:
                flow.follow(run, received)
                if chain.gate.down:
                    flow.stand()
                if chain.gate.idle >= 0:
                    idle_ns = max(idle_ns, received(int(run.position[chain.gate.idle])))
        if not self._flies():
            idle_ns = max(idle_ns, received(batch.count - 1))
        if idle_ns:
            self._blind.wait_from(idle_ns)

    def _compare_commands(self, was_grounded: bool, now_ns: int) -> None:
        """Follow whether the vehicle goes on as in flight although it reports that it does not fly any more.

        Its motors are checked a second after the report, when those of a landed vehicle have stopped, and every second
        from then on; without commands its speed.
        """
        phase, gates = self._phase, self._gates
        # On another vehicle the same outputs may move surfaces.
        if not phase.grounded or self.mismatch is not None:
            phase.driven, self._driven_ns = False, None
            return
        if self._driven_ns is None:
            if was_grounded or allows(self.profile.gate, phase):
                return
            self._grounded_ns = now_ns
        else:
            if 0 < self._driven_ns - now_ns <= SECOND_NS:
                return
            by_command = [gate.driven for gate in gates if gate.commands]
            driven = by_command or [phase.moves(self._grounded_ns, now_ns)]
            if False in driven and True not in driven:
                phase.driven, self._driven_ns = False, None
                return
            phase.driven |= True in driven and (bool(by_command) or now_ns - self._grounded_ns >= _MOVED_NS)
        if self._driven_ns is None or phase.driven:
            for gate in gates:
                gate.watch_commands()
        self._driven_ns = now_ns + SECOND_NS

    def _follow_landing(self, now_ns: int) -> None:
        """Follow whether a landing vehicle that does not sink hovers by its mean command.

        Without commands and height: whether it moves on. A plane that flares and rolls out does not sink, either.
        """
        if not self._phase.level:
            self._level_ns = None
        elif self._level_ns is None or not 0 < self._level_ns - now_ns <= _LEVEL_NS:
            if self._level_ns is not None:
                by_command = [gate.hovers for gate in self._gates if gate.commands]
                moves = not self._phase.has_height and self._phase.moves(now_ns - _LEVEL_NS, now_ns)
                self._phase.hovers = any(by_command or [moves])
            for gate in self._gates:
                gate.watch_commands()
            self._level_ns = now_ns + _LEVEL_NS

    def _contradict(self, now_ns: int) -> list[AlarmEvent]:
        """Follow the latest messages that show two senders; return the events that a change causes."""
        before, found = self._untrue, sorted(key for key, until_ns in self._clock.found.items() if now_ns < until_ns)
        self._forged = {name: _FORGED[what].format(pace=self._clock.pace) for name, what in found}
        certain = self._contradictions(now_ns)
        self.contradictions = [*certain, *[_TWICE_NUMBERED] * (now_ns < self._numbered_ns)]
        events = self._link.contradict(self.contradictions, now_ns, "critical" if certain else "warning")
        again = {name for name, what in found if what == "before"}
        self._untrue = self._forged, again, self._blind.frozen
        altered = {name for name, what in found if what == "response"}
        for flow in self._blind.flows:
            flow.altered = any(channel.message in altered for channel in flow.chain.source.inputs)
        for chain in self._chains if self._untrue != before else ():
            events += chain.distrust(self._doubt(chain, again, now_ns), now_ns, self._clock.newest_ns)
        return events

    def _doubt(self, chain: ObserverChain, again: Set[str], now_ns: int) -> Doubt | None:
        """Return why what an observer reads is not the vehicle's; ``again`` are messages of a recording sent again."""
        measured = {channel.message for channel in (*chain.source.outputs, *chain.source.signals)}
        link, frozen = self._link.affect, self._blind.frozen
        if not again.isdisjoint(measured):
            since_ns = min(self._clock.repeated_ns - _TOGETHER_NS, now_ns - LATELY_NS)
            return Doubt(link, "explained by a second sender", since_ns, whole=True)
        if not chain.sampler.interests.isdisjoint(self._forged):
            return Doubt(link, "explained by a second sender", now_ns - LATELY_NS, whole=False)
        if measured.isdisjoint(frozen):
            return None
        since_ns = self._clock.to_unix(min(frozen[name] for name in measured & frozen.keys())) - _TOGETHER_NS
        return Doubt(self._blind.affect, "explained by frozen telemetry", since_ns, whole=True)

    def _contradictions(self, now_ns: int) -> list[str]:
        """Return the contradictions that one sender cannot cause, a sentence each."""
        found = [CONTESTED[name] for name in self._phase.contested]
        if self._phase.driven:
            by_command = any(gate.commands for gate in self._gates)
            how = "its motors run as in flight" if by_command else "it moves on"
            found.append(f"it reports that it does not fly while {how}")
        if now_ns < self._clock.contested_ns:
            apart_s = abs(self._clock.rival_ns) / 1e9
            found.append(f"its messages were stamped by two clocks, {apart_s:.1f} s apart")
        return [*found, *(f"its {name} {what}" for name, what in self._forged.items())]

    def _flight(self) -> tuple[bool, bool]:
        """Return whether evidence is expected, and whether the messages contradict each other."""
        return self._flies(), bool(self.contradictions)

    def _flies(self) -> bool:
        """Return whether evidence is expected: in flight by the vehicle's reports, or by its commands."""
        if not allows(self.profile.gate, self._phase):
            return False
        if self._phase.landed is not None:
            return True
        airborne = [gate.airborne for gate in self._gates if gate.airborne is not None]
        return any(airborne) if airborne else self._phase.armed is not False

    def _run_own(self, message: Message) -> list[AlarmEvent]:
        """Process a message that is no telemetry."""
        now_ns, fields = message.received_ns, message.fields
        if message.source is MAVLINK:
            return self._through_desk([*self._link.quiet(now_ns), *self._command(message)])
        if message.source is CLOCK:
            events = [*self._close_at_landing(now_ns), *self._silence(now_ns, recorded=False)]
            events += self._link.quiet(now_ns)
            return self._through_desk(events)
        if message.source is LINK:
            events = self._link.process(message, self._clock.newest_ns)
            if message.name == SEQUENCE and self._component in (0, message.component):
                self._numbered_ns = now_ns + _NUMBERED_NS
                events += self._contradict(now_ns)
            return self._through_desk(events)
        if message.source is JOURNAL:
            return self._adopt(fields, now_ns) if message.name == STANDING else []
        if message.name == RULES:
            return self._retune(fields, now_ns)
        if message.name == RESET and (key := self.desk.key(fields)) is not None:
            for observer, channel in (key, *self.desk.findings(key)):
                for chain in self._chains:
                    if chain.layout.observer == observer:
                        chain.restart(channel, now_ns, self._clock.newest_ns, "reset")
        return self.desk.operate(message.name, fields, now_ns)

    @property
    def _landed_ns(self) -> int:
        """Unix time from which on any message closes the alarms of a flight that is over."""
        is_due = self._down_ns is not None and any(chain.has_active_alarms for chain in self._chains)
        return self._down_ns + _LANDED_NS if is_due and self._down_ns is not None else LATEST_NS

    def _close_at_landing(self, now_ns: int) -> list[AlarmEvent]:
        """Close the alarms of a flight that is over: nothing shows any more whether their causes are gone."""
        phase = self._phase
        is_down = phase.armed is False or (phase.armed is None and phase.landed == "ground")
        if not is_down or allows(self.profile.gate, phase):
            self._down_ns = None
        elif self._down_ns is None or self._down_ns - now_ns >= SET_BACK_NS:
            self._down_ns = now_ns
        if now_ns < self._landed_ns:
            return []
        why = "cleared at landing: whether the fault is gone is not known"
        return [event for chain in self._chains for event in chain.close(now_ns, self._clock.newest_ns, why)]

    def _silence(self, now_ns: int, *, recorded: bool = True) -> list[AlarmEvent]:
        """Advance the time to ``now_ns``, with or without a message: the same live and in a replay."""
        # A vehicle's own log pauses between two flights.
        paused = self._phase.logged and not self._flies() and self._stale.due(now_ns)
        if paused:
            self._stale.pass_over(now_ns, self._clock.newest_ns)
        events = self._stale.silence(now_ns)
        if paused or self._stale.active:
            self._link.silent()
            self._blind.pause(now_ns)
        return events + self._blind.process(now_ns, self._clock.newest_ns, *self._flight(), recorded=recorded)

    def _through_desk(self, events: Iterable[AlarmEvent]) -> list[AlarmEvent]:
        return [published for event in events for published in self.desk.process(event)]

    def _adopt(self, fields: Mapping[str, Any], now_ns: int) -> list[AlarmEvent]:
        events = [event for event in handed_over_alarms(fields) if event.vehicle == self.vehicle]
        for event in events:
            if event.latched:
                continue
            if (event.observer, event.channel) == (blind.OBSERVER, blind.CHANNEL):
                self._blind.adopt(event)
            if event.observer == link_alarms.OBSERVER:
                (self._stale if event.channel == link_alarms.TELEMETRY else self._link).adopt(event)
            for chain in self._chains:
                if chain.layout.observer == event.observer:
                    chain.adopt(event)
        seq = fields.get("seq")
        self.desk.seq = max(self.desk.seq, seq if is_seq(seq) else 0)
        return self.desk.adopt(events, self.channels, now_ns, shelved_channels(fields))

    def _retune(self, fields: Mapping[str, Any], now_ns: int) -> list[AlarmEvent]:
        alarms = fields.get("alarms")
        for chain in self._chains:
            rules = alarms.get(chain.layout.observer) if isinstance(alarms, Mapping) else None
            if isinstance(rules, Mapping):
                chain.retune({name: rule for name, rule in rules.items() if isinstance(rule, Mapping)})
        return self.desk.set_rule(desk_rule(fields, self.desk.rule), now_ns)


def _commands(message: Message) -> bool:
    return message.source is MAVLINK and message.name in COMMANDS


def interests_of(profile: Profile) -> frozenset[str]:
    """Return the names of the messages that a profile's pipeline reads; skipping all others changes no result."""
    own = {SILENCE, "signing", SEQUENCE, RULES, STANDING, "ack", "shelve", "unshelve", RESET}
    return _carriers(profile) | FlightPhase.interests | COMMANDS | own


def _carriers(profile: Profile) -> frozenset[str]:
    """Return the names of the messages that carry what observers measure."""
    carriers = {channel.message for observer in profile.observers for channel in observer.source.channels}
    has_supply = any(observer.supply is not None for observer in profile.observers)
    return frozenset(carriers | {BATTERY_MESSAGE} if has_supply else carriers)


def rules_message(rule: DeskRule, profile: Profile, now_ns: int, system: int = 0) -> Message:
    """Return the message that applies the desk's rule and a profile's alarm sizes from now on.

    ``system`` is the one that was to be monitored from the start: a replay monitors it from the start, too.
    """
    alarms = {
        observer.name: {
            alarm.channel: {key: value for key, value in asdict(alarm).items() if key in TUNABLE}
            for alarm in observer.alarms
        }
        for observer in profile.observers
    }
    return Message(OPERATOR, RULES, now_ns, {**rule_fields(rule), "alarms": alarms, "system": system})


def handover_message(
    alarms: Sequence[AlarmEvent], seq: int, now_ns: int, shelved: Mapping[str, int] = MappingProxyType({})
) -> Message:
    """Return the message with which a pipeline continues where another one stopped.

    It holds the last event of each active alarm, the number of the last event, and the channels (``observer/channel``)
    that operators had shelved, with the Unix times at which shelving ends.
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
