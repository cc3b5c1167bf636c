"""One observer of a vehicle from samples to events: gate, estimator, alarms.

Over a sample without measurements (``measured`` of :class:`adapters.sample.Samples`) the observer coasts: the model
runs alone, the named hypothesis stays, the uncertainty grows, and the debounce of alarms waits. After a gap that is too
long for that, the observer restarts. Its samples are evidence again when the effect of a wrong start on its estimates
has decayed (:mod:`monitor.estimation.affine`). If one channel is ``lost`` alone, the faults that no other output shows
have no evidence.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adapters.batch import Batch
from adapters.message import LATEST_NS
from adapters.sample import Given, Samples
from gains.plants.plant import Plant
from monitor.alarms.alarm import Alarm, retuned
from monitor.alarms.excuse import Doubt, Excuses
from monitor.core.alarms import CLEARED, EXPLAINED, RAISED, ChainRows, Weighing, nats_asked, walk
from monitor.core.effectiveness import EffectivenessEstimator
from monitor.core.observers import CommandScale, shares_in_command
from monitor.core.sampling import VehicleClock
from monitor.estimate import Estimates, Layout
from monitor.estimation.affine import AffineObserver
from monitor.estimation.bank import EstimatorRun
from monitor.estimation.changes import ChangeRun, ChangeStage
from monitor.estimation.effectiveness import EffectivenessRule, EffectivenessRun
from monitor.estimation.envelope import EnvelopeStage
from monitor.estimation.estimator import make_estimator
from monitor.estimation.excitation import ExcitationStage
from monitor.estimation.isolation_rule import BankRule, edge_faults, keep_share
from monitor.estimation.uncertainty import Uncertainty, unmodelled_lag_s
from monitor.event import AlarmEvent
from monitor.profile import FaultChannel, ObserverProfile
from monitor.sampling.gate import GatedSampler, GateRule
from monitor.sampling.phase import FlightPhase

_SMALLEST_FULL = 0.01
"""Smallest effect of a full deflection that is divided by: below a tenth of the reference speed no sample is
evidence."""


class CommandRun(NamedTuple):
    """n samples in command units: fault, isolated, sd, and the smoothed commands that faults scale, if any (n, a)."""

    fault: NDArray[np.float64]
    isolated: NDArray[np.float64]
    sd: NDArray[np.float64]
    commands: NDArray[np.float64]  # not a number for a fault that scales none
    full: NDArray[np.float64]  # the effects of these commands, of which sizes are shares; 1 for a size that is no share


class CommandUnits:
    """Converts fault estimates of actuators from effect units to command units, at the smoothed command.

    The command is smoothed like the estimates: otherwise their ratio would mean nothing.
    """

    def __init__(self, profile: ObserverProfile) -> None:
        gains = profile.gains[0]
        inputs = sorted({channel.input for channel in profile.faults if channel.input is not None})
        channel = [-1 if fault.input is None else inputs.index(fault.input) for fault in profile.faults]
        self._scale = CommandScale(
            gains.input_curves,
            np.array(inputs, np.intp),
            np.array(channel, np.intp),
            keep_share(profile.isolation.smoothing_s, gains.rate_hz),
        )
        self._curves = np.ascontiguousarray(gains.input_curves, np.float64)
        # behind the inputs that faults scale: a place for the index -1, which stands for none
        scaled = [-1 if fault.input is None else fault.input for fault in profile.faults]
        self._inputs = np.array([*scaled, -1], np.intp)

    def run(
        self,
        u: NDArray[np.float64],
        restart: NDArray[np.bool_],
        fault: NDArray[np.float64],
        evidence: NDArray[np.float64],
        sd: NDArray[np.float64],
    ) -> CommandRun:
        """Return n samples in command units if a fault scales an input.

        The smoothed command restarts at its own restarts.

        Commands ``u`` are (n, s); fault estimates, evidence and standard deviations (n, a) are in effect units.
        """
        return CommandRun(*self._scale.run(u, restart, fault, evidence, sd))

    def of_change(self, change: ChangeRun, commands: NDArray[np.float64]) -> ChangeRun:
        """Return named changes with size, growth and sd in command units if their fault scales an input.

        ``commands`` are those that :meth:`run` returned.
        """
        inputs, command = self._inputs[change.named], commands[np.arange(len(change.named)), change.named]
        if not (inputs >= 0).any():
            return change
        size, later, upper = (
            shares_in_command(self._curves, inputs, command, share)
            for share in (change.size, change.size + change.growth, change.size + change.sd)
        )
        return change._replace(size=size, growth=later - size, sd=np.abs(upper - size))


class EffectivenessStage:
    """Estimators for those of an observer's faults that are judged by their actuators' deflection."""

    def __init__(
        self,
        rules: Mapping[str, EffectivenessRule],
        faults: Sequence[FaultChannel],
        inputs: Sequence[str],
        outputs: Sequence[str],
        rate_hz: float,
        reached: Mapping[str, float] = MappingProxyType({}),
    ) -> None:
        known = [[name for name in names if name in reached] for names in (inputs, outputs)]
        self._columns = [inputs.index(name) for name in known[0]], [outputs.index(name) for name in known[1]]
        self._reached = [[reached[name] for name in names] for names in known]
        self._channels = [
            (
                index,
                channel.input,
                None if (full := rules[channel.name].full) is None else inputs.index(full),
                EffectivenessEstimator(rules[channel.name], rate_hz),
            )
            for index, channel in enumerate(faults)
            if channel.name in rules and channel.input is not None
        ]

    def run(
        self, samples: Samples, fault: NDArray[np.float64], armed: NDArray[np.bool_]
    ) -> dict[int, EffectivenessRun]:
        """Process n samples; return the effectiveness of each of these faults' actuators, by index of the fault.

        Samples hold the commands and the effects of full deflections; ``fault`` (n, a) is in effect units, not
        smoothed.
        """
        beyond = self._beyond(samples) if self._channels else np.empty(0)
        return {
            index: EffectivenessRun(
                *estimator.run(
                    samples.vehicle_time_ns,
                    samples.restart,
                    armed,
                    fault[:, index],
                    samples.u[:, command],
                    np.ones(len(samples)) if full is None else samples.u[:, full],
                    beyond,
                )
            )
            for index, command, full, estimator in self._channels
        }

    def of_change(self, change: ChangeRun, samples: Samples, effects: Mapping[int, EffectivenessRun]) -> ChangeRun:
        """Return named changes with size and sd in full deflections; larger model errors raise the sd."""
        full, larger = np.ones((2, len(samples)))
        for index, _, source, _ in self._channels:
            named = change.named == index
            larger[named] = effects[index].larger[named]
            if source is not None:
                full[named] = np.maximum(samples.u[named, source], _SMALLEST_FULL)
        return change._replace(size=change.size / full, sd=change.sd / full, nats=change.nats / larger**2)

    def _beyond(self, samples: Samples) -> NDArray[np.float64]:
        """Return how many times larger than in the fitted flights the errors of the model may be (n,), at least once.

        They grow in proportion to inputs (actuators saturate, wings stall), and with the square of outputs (products of
        rates turn a body, too).
        """
        inputs, outputs = (
            np.nan_to_num(np.abs(values[:, columns]) / sizes).max(axis=1, initial=1.0)
            for values, columns, sizes in zip((samples.u, samples.y), self._columns, self._reached, strict=True)
        )
        return np.asarray(np.fmax(inputs, outputs * outputs), dtype=np.float64)


class ChainRun(NamedTuple):
    """Estimates of one observer over n samples, and the evidence of its A alarms in them."""

    estimates: Estimates
    position: NDArray[np.int64]  # index in the batch of the message that completed each sample (n,)
    rows: ChainRows  # evidence, as the alarms process it
    alarms: Sequence[Alarm]  # the alarms, in the order of the evidence's columns
    faults: Sequence[int]  # the fault of each alarm; the last alarm, of what no fault explains, has none
    # the command that each fault's size is a share of (n, a), not a number if that makes no sense; by fault the share,
    # if it is known in another way
    commands: NDArray[np.float64]
    effects: Mapping[int, EffectivenessRun]
    found: EstimatorRun  # the estimator's own result, in effect units
    scale: NDArray[np.float64]  # how many times its threshold each fault has to reach (n, a), 1 or more
    noise: NDArray[np.float64]  # the fitted standard deviation of each fault's estimate, in effect units (n, a)
    size_sd: NDArray[np.float64]  # the standard deviation of each fault's size as an event gives it (n, a)
    sudden_sd: NDArray[np.float64] | None  # the standard deviation of a sudden change's size (n,)
    unflown: NDArray[np.bool_] | None = None  # rows whose y counts as lost because it is unlike the fitted flights (n,)

    def event(self, row: int, alarm: int, code: int) -> AlarmEvent:
        """Return the event that a row caused in an alarm."""
        command = relative = sd = None
        rival = -1 if code == CLEARED else self.alarms[alarm].state.rival
        if alarm < len(self.faults):
            fault = self.faults[alarm]
            # The estimate that clears an alarm has no fault to tell of.
            sd = None if code == CLEARED else self.size_sd[:, fault]
            if (effect := self.effects.get(fault)) is not None:
                relative = effect.share
            else:
                command = self.commands[row, fault]
        if code == RAISED and self.alarms[alarm].state.sudden:
            sd = self.sudden_sd
        return self.alarms[alarm].event(
            code,
            self.estimates.samples,
            row,
            None if command is None or np.isnan(command) else float(command),
            None if relative is None or np.isnan(relative[row]) else float(relative[row]),
            None if sd is None else float(sd[row]),
            self.alarms[self.faults.index(rival)].rule.channel if rival in self.faults else None,
            let_go=alarm < len(self.faults) and bool(self.found.let_go[row, self.faults[alarm]]),
        )


class ObserverChain:
    """One observer of one vehicle.

    Clock and excuses (which alarms explain which) are shared by the vehicle's observers. ``sampler`` turns messages
    into samples, of raw signals if a transform follows; ``gate`` tells which samples are evidence; ``sooner`` are the
    observers that see all of this observer's faults sooner.
    """

    def __init__(
        self,
        profile: ObserverProfile,
        vehicle: str,
        gate: GateRule,
        clock: VehicleClock,
        excuses: Excuses | None = None,
        sooner: Sequence[str] = (),
    ) -> None:
        gains = profile.gains[0]
        self.layout = _layout(profile)
        names = self.layout.faults
        observer = AffineObserver(profile.gains)
        rule = replace(gate, settle_s=max(gate.settle_s, profile.settle_s or observer.settling_s()))
        self.source, self.settle_s = profile.source, rule.settle_s
        self._sampler = GatedSampler(profile.source, gains.rate_hz, clock, rule, profile.supply)
        self.sampler, self.gate = self._sampler.sampler, self._sampler.gate
        thresholds = {rule.channel: rule.threshold for rule in profile.alarms}
        self._estimator = make_estimator(observer, profile.isolation, names, thresholds)
        lag_s = unmodelled_lag_s(profile.isolation)
        measured = profile.spread, profile.moves, profile.periods_s
        self._uncertainty = Uncertainty(observer, profile.model, names, *measured, lag_s)
        self._measured_ns = 0  # when the outputs were last measured
        self._command = CommandUnits(profile)
        self._effectiveness = EffectivenessStage(
            profile.effectiveness, profile.faults, gains.inputs, gains.outputs, gains.rate_hz, profile.reached
        )
        self._changes = None
        if profile.changes is not None and profile.model is not None:
            inputs = {channel.name: channel.input for channel in profile.faults}
            self._changes = ChangeStage(profile.model, gains.rate_hz, inputs, profile.changes)
        self._envelope = None
        if profile.envelope is not None and profile.source.transform is not None:
            signals = [channel.name for channel in profile.source.signals]
            self._envelope = EnvelopeStage(profile.envelope, signals, profile.source.transform.rate_hz)
        self._excitation = None
        if profile.excitation is not None:
            self._excitation = ExcitationStage(profile.excitation, gains.outputs, len(gains.inputs), gains.rate_hz)
        self._scales = np.array([channel.input is not None for channel in profile.faults])
        self._actuators = {channel.name for channel in profile.faults if channel.input is not None}
        self._excuses = excuses or Excuses(())
        self._distrusted = False
        self._still: Mapping[str, int] = MappingProxyType({})
        # faults first, then the alarm of what no fault explains: the order in which a row is processed
        rules = sorted(profile.alarms, key=lambda rule: rule.kind == "residual")
        self._alarms = tuple(Alarm(rule, vehicle) for rule in rules)
        self._states = tuple(alarm.state for alarm in self._alarms)
        self._faults = [names.index(rule.channel) for rule in rules if rule.kind != "residual"]
        # a slice where they are all, which copies nothing
        self._columns = slice(None) if self._faults == [*range(len(names))] else self._faults
        # the share of its threshold that each fault reaches in health; faults whose errors grow with the manoeuvres
        shares = {rule.channel: rule.healthy / rule.threshold for rule in profile.alarms if rule.threshold > 0.0}
        healthy = np.array([shares.get(name, 0.0) for name in names])
        excited = [index for index, channel in enumerate(profile.faults) if channel.kind == "actuator"]
        self._healthy = healthy
        self._weighing = Weighing(
            self._faults, len(self._alarms), shown_in(profile.model, self.layout), healthy, excited
        )
        self._thresholds = self._fault_thresholds()
        # the alarm of each fault, and behind them a place for the index -1: no alarm
        self._alarm_of = np.full(len(names) + 1, -1, np.intp)
        self._alarm_of[self._faults] = np.arange(len(self._faults))
        jumping, made = edge_faults(profile.isolation), made_by_sensors(profile)
        for alarm in self._alarms[: len(self._faults)]:
            name, jumps = alarm.rule.channel, alarm.rule.channel in jumping
            self._excuses.add(
                name,
                alarm.state,
                profile.name,
                jumps=jumps,
                affect=alarm.affect,
                withdraw=alarm.withdraw,
                made=made.get(name, {}),
            )
        for alarm in self._alarms if sooner else ():
            self._excuses.add_beside(alarm.rule.channel, alarm.state, sooner, alarm.rule.slow_s)

    @property
    def channels(self) -> frozenset[str]:
        """Channels that have an alarm."""
        return frozenset(alarm.rule.channel for alarm in self._alarms)

    @property
    def thresholds(self) -> dict[str, float]:
        """Alarm thresholds by channel."""
        return {alarm.rule.channel: alarm.rule.threshold for alarm in self._alarms}

    def adopt(self, event: AlarmEvent) -> None:
        """Continue from an alarm event that an earlier run, or another monitor, has published."""
        for alarm in self._alarms:
            if alarm.rule.channel == event.channel:
                alarm.adopt(event)
                self._excuses.follow(event)

    def retune(self, rules: Mapping[str, Mapping[str, float]]) -> None:
        """Apply other sizes and times of alarms from the next sample on, by channel and key."""
        for alarm in self._alarms:
            alarm.set_rule(retuned(alarm.rule, rules.get(alarm.rule.channel, {})))
        self._thresholds = self._fault_thresholds()

    def _fault_thresholds(self) -> NDArray[np.float64]:
        """Return the thresholds of the faults that have an alarm, in the order of the alarms."""
        return np.array([alarm.rule.threshold for alarm in self._alarms[: len(self._faults)]])

    @property
    def still(self) -> Mapping[str, int]:
        """Names of the messages whose values repeat, and the vehicle times of their last change, ns."""
        raw = {one.message: self._still[one.name] for one in self.source.signals if one.name in self._still}
        return {**raw, **self.sampler.still}

    @property
    def has_active_alarms(self) -> bool:
        """Whether an alarm is active."""
        return any(state.active for state in self._states)

    def close(self, time_ns: int, vehicle_ns: int, why: str) -> list[AlarmEvent]:
        """End all active alarms regardless of their evidence; return the events."""
        return self._close([alarm for alarm in self._alarms if alarm.state.active], time_ns, vehicle_ns, why)

    def restart(self, channel: str, time_ns: int, vehicle_ns: int, why: str) -> None:
        """Restart without a channel's active alarm: the estimates forget its cause."""
        active = [alarm for alarm in self._alarms if alarm.state.active and alarm.rule.channel == channel]
        if self._close(active, time_ns, vehicle_ns, why):
            self._begin_anew()

    def distrust(self, doubt: Doubt | None, time_ns: int, vehicle_ns: int) -> list[AlarmEvent]:
        """Excuse alarms because what the observer reads is not the vehicle's, from now on and of late; None: no longer.

        Return the events.

        An actuator's alarm is raised whoever sends, unless the measurements of its effect are known to be untrue: a
        forged command must not hide that an actuator fails. What the observer learned from untrue values is not true of
        the vehicle: when they end, the observer restarts, and actuators that were accused again and again meanwhile do
        not count as ones whose fault comes and goes.
        """
        events: list[AlarmEvent] = []
        changed, ends = False, self._distrusted and doubt is None
        self._distrusted = doubt is not None
        for alarm in self._alarms:
            channel = alarm.rule.channel
            if ends and channel in self._actuators:
                alarm.state.forget_recurrences()
            excused = doubt is not None and (doubt.whole or channel not in self._actuators)
            if said := alarm.doubt(doubt is not None and not excused, time_ns, vehicle_ns):
                events.append(said)
            if not self._excuses.distrust(channel, alarm.state, doubt.affect if doubt and excused else None):
                continue
            changed = True
            if doubt and excused:
                ended = alarm.withdraw(time_ns, vehicle_ns, doubt.why, doubt.since_ns)
                events += self._excuses.consequence(ended, alarm.state)
                if ended is None and self._excuses.ended_lately(channel, vehicle_ns):
                    listed = doubt.affect(channel, time_ns, vehicle_ns)
                    events += [] if listed is None else [listed]
        if changed and doubt is None:
            self._begin_anew()
        return events

    def _begin_anew(self) -> None:
        self.sampler.restart()
        self._estimator.forget()

    def _close(self, alarms: Sequence[Alarm], time_ns: int, vehicle_ns: int, why: str) -> list[AlarmEvent]:
        events = [alarm.close(time_ns, vehicle_ns, why) for alarm in alarms]
        for event in events:
            self._excuses.follow(event)
        return events

    def enter(self, allowed: bool) -> None:
        """Restart at the next sample if the phase has come to allow evidence."""
        if self._sampler.enter(allowed):
            self._estimator.forget()

    def run(self, samples: Samples, position: NDArray[np.int64], phase: FlightPhase, batch: Batch) -> ChainRun | None:
        """Process n samples of :attr:`sampler`: estimates, and evidence for :func:`alarm_events` to make events of.

        None where they complete no sample of the observer.

        ``position`` is the place in the batch of the message that completed each (n,); the vehicle's phase is the same
        for all of them and was entered before.
        """
        raw = self._sampler.gathered(self._sampler.supplied(samples, batch, position))
        if not len(raw):
            return None
        given = self._sampler.run(raw)
        self._still = given.still
        if self._envelope is not None:
            outside = self._envelope.run(raw, np.arange(len(raw))[given.rows])
            beyond = outside if given.beyond is None else outside * given.beyond
            given = given._replace(beyond=beyond, known_beyond=outside)
        if not len(given.samples):
            return None
        if not isinstance(given.rows, slice):
            # raw samples of earlier batches that completed nothing
            position = position[given.rows - (len(raw) - len(samples))]
        return self.estimate(given, self._sampler.admitted(given.samples, phase), position)

    @property
    def outside(self) -> str | None:
        """What of the flight lies outside of the fitted flights, for people; None if nothing does."""
        stages = (self._envelope, self._excitation)
        return next((stage.outside for stage in stages if stage is not None), None)

    @property
    def furthest(self) -> tuple[float, str] | None:
        """For how long, seconds, and how far the flight so far lay outside of the fitted flights.

        None if it did not.
        """
        stages = (self._envelope, self._excitation)
        return next((stage.furthest for stage in stages if stage is not None), None)

    def estimate(self, given: Given, armed: NDArray[np.bool_], position: NDArray[np.int64] | None = None) -> ChainRun:
        """Process n samples (u, y) of the observer itself; use :meth:`run` for those of :attr:`sampler`.

        ``armed`` tells whether each sample is evidence (n,); ``position`` is as in :meth:`run`, None for their index.
        """
        samples = given.samples
        if position is None:
            position = np.arange(len(samples))
        found = self._estimator.run(given, armed)
        noise = self._uncertainty.run(samples.measured, samples.restart)
        for name, deviation in given.spread.items():
            if name in self.layout.faults:
                index = self.layout.faults.index(name)
                noise[:, index] = np.hypot(noise[:, index], deviation)
        shown = self._command.run(samples.u, samples.restart, found.fault, found.evidence, noise)
        effects = self._effectiveness.run(samples, found.fault, armed)
        sizes = found.evidence.copy() if effects else found.evidence
        for index, effect in effects.items():
            sizes[:, index] = shown.isolated[:, index] = effect.size
            shown.full[:, index] = 1.0
        healthy = armed & (np.abs(shown.isolated[:, self._columns]) < self._thresholds).all(axis=1)
        larger = self._uncertainty.of_flight(noise, found.fault, found.level, healthy)
        sd, shown_sd = noise * larger, shown.sd * larger
        for index, effect in effects.items():
            with np.errstate(divide="ignore", invalid="ignore"):
                told = np.where(effect.size == 0.0, sd[:, index], np.abs(effect.size) / effect.score)
            sd[:, index] = shown_sd[:, index] = told
        size_sd = self._uncertainty.of_sizes(sd, sizes, shown_sd, shown.full)
        for name, size in given.sizes.items():
            if name in self.layout.faults:
                index = self.layout.faults.index(name)
                known = (size != 0.0) & (shown.isolated[:, index] != 0.0)
                shown.isolated[known, index] = size[known]
                if name in given.spread:
                    size_sd[known, index] = given.spread[name][known]
        estimates = Estimates(
            observer=self.layout.observer,
            samples=samples,
            x=found.x,
            fault=shown.fault,
            isolated=shown.isolated,
            residual=found.residual,
            armed=armed,
            sd=np.where(shown.isolated == 0.0, shown_sd, size_sd) if np.count_nonzero(shown.isolated) else shown_sd,
            coasted_s=self._coasted_s(samples),
        )
        return self._with_evidence(estimates, position, found, effects, shown.commands, given, noise, sd, size_sd)

    def _coasted_s(self, samples: Samples) -> NDArray[np.float64]:
        """Return the seconds since the outputs were last measured, at each of n samples (n,); a restart is measured."""
        times_ns = samples.vehicle_time_ns
        if len(samples) and np.count_nonzero(samples.measured) == len(samples):
            self._measured_ns = times_ns[-1]
            return np.zeros(len(samples))
        last = np.maximum.accumulate(np.where(samples.measured | samples.restart, np.arange(len(samples)), -1))
        since_ns = times_ns - np.where(last < 0, self._measured_ns, times_ns[last])
        if len(samples):
            self._measured_ns = times_ns[-1] - since_ns[-1]
        return np.asarray(1e-9 * since_ns, np.float64)

    def _larger(self, given: Given) -> NDArray[np.float64] | None:
        """Return how many times larger each fault's size is for being unlike the fitted flights (n, a)."""
        if given.beyond is None:
            return None
        larger = np.repeat(given.beyond[:, None], len(self.layout.faults), axis=1)
        for name in given.spread:
            if name in self.layout.faults:
                larger[:, self.layout.faults.index(name)] = 1.0 if given.known_beyond is None else given.known_beyond
        return larger

    def _with_evidence(
        self,
        estimates: Estimates,
        position: NDArray[np.int64],
        found: EstimatorRun,
        effects: Mapping[int, EffectivenessRun],
        commands: NDArray[np.float64],
        given: Given,
        noise: NDArray[np.float64],
        sd: NDArray[np.float64],
        size_sd: NDArray[np.float64],
    ) -> ChainRun:
        samples, beyond = given.samples, given.beyond
        excitation = None if self._excitation is None else self._excitation.run(samples, found.level)
        evidence, speaking, alarm_scale, scale = self._weighing.run(
            estimates.isolated,
            found.unexplained,
            estimates.armed,
            found.counted,
            samples.lost,
            found.level,
            self._larger(given),
            excitation,
        )
        for fault, effect in effects.items():
            if (alarm := self._alarm_of[fault]) >= 0:
                speaking[:, alarm] &= ~np.isnan(effect.evidence)
        changes = None
        if self._changes is not None:
            # A name may make a test of additions forget onsets: there it must not depend on how the stream is cut.
            lasts = self.has_active_alarms and not self._changes.adds
            lasting = self._lasting(samples, found.rival) if lasts else []
            asked = nats_asked(self._states[: len(self._faults)], evidence, speaking, alarm_scale, beyond, lasting)
            changes = self._changes.run(samples, estimates.armed, estimates.isolated, asked, given.ahead)
            for fault, output in self._changes.noisy.items():
                if (alarm := self._alarm_of[fault]) >= 0:
                    louder = np.sqrt(changes.noise[:, output]) * self._healthy[fault]
                    alarm_scale[:, alarm] = scale[:, fault] = np.maximum(scale[:, fault], louder)
            if max(changes.named.tolist(), default=-1) < 0:
                changes = None
            elif effects:
                changes = self._effectiveness.of_change(changes, samples, effects)
            else:
                changes = self._command.of_change(changes, commands)
                # A position that wanders in health has some of that in any jump; an input's fault is a share instead.
                wander = np.where(self._scales[changes.named], 0.0, sd[np.arange(len(samples)), changes.named])
                changes = changes._replace(sd=np.hypot(changes.sd, wander))
        if changes is not None:
            # Messages are judged whole: the last of the samples of one gives the size of all.
            ends = np.append((np.diff(position) != 0) | (np.diff(changes.named) != 0), True)
            last = np.flatnonzero(ends)[np.cumsum(ends) - ends]
            changes = changes._replace(size=changes.size[last], growth=changes.growth[last], sd=changes.sd[last])
        if changes is not None and beyond is not None:
            # larger errors of the model make the log-likelihood of a fault smaller by their square
            changes = changes._replace(nats=changes.nats / beyond**2)
        rows = ChainRows(
            self._states,
            position,
            samples.vehicle_time_ns,
            samples.restart,
            evidence,
            speaking,
            alarm_scale,
            **({} if changes is None else self._named(changes)),
            sd=size_sd[:, self._columns],
            noise=noise[:, self._columns],
            command=commands[:, self._columns],
            rival=found.rival[:, self._columns],
            frozen=self._frozen(given.frozen, estimates.armed),
        )
        return ChainRun(
            estimates,
            position,
            rows,
            self._alarms,
            self._faults,
            commands,
            effects,
            found,
            scale,
            noise,
            size_sd,
            None if changes is None else changes.sd,
            given.unflown,
        )

    def _frozen(self, frozen: Mapping[str, NDArray[np.bool_]], armed: NDArray[np.bool_]) -> NDArray[np.bool_] | None:
        """Return where the sensor of each fault's alarm is frozen and that is evidence (n, m); None if none is."""
        if not any(rows.any() for rows in frozen.values()):
            return None
        never = np.zeros(len(armed), np.bool_)
        names = (alarm.rule.channel for alarm in self._alarms[: len(self._faults)])
        return np.column_stack([frozen.get(name, never) & armed for name in names])

    def _lasting(self, samples: Samples, rival: NDArray[np.intp]) -> list[bool]:
        """Return which faults' alarms are active and, over these samples, can be ended by their evidence alone.

        No alarm that is raised meanwhile explains them.
        """
        first_ns = int(samples.time_ns.min(initial=LATEST_NS))
        return [
            alarm.state.active
            and (
                alarm.is_old(first_ns)
                or (
                    max(alarm.state.rival, rival[:, fault].max(initial=-1)) < 0
                    and not self._excuses.may_precede(alarm.rule.channel)
                )
            )
            for alarm, fault in zip(self._alarms, self._faults, strict=False)
        ]

    def _named(self, run: ChangeRun) -> dict[str, Any]:
        """Return the alarm whose sudden change each row names, with its nats, size, growth, onset and sd."""
        return {
            "changed": self._alarm_of[run.named],
            "nats": run.nats,
            "size": run.size,
            "growth": run.growth,
            "onset_ns": run.onset_ns,
            "change_sd": run.sd,
            "instead": run.instead,
        }


def _layout(profile: ObserverProfile) -> Layout:
    gains, names = profile.gains[0], tuple(channel.name for channel in profile.faults)
    return Layout(
        observer=profile.name,
        rate_hz=gains.rate_hz,
        inputs=gains.inputs,
        outputs=gains.outputs,
        states=gains.states,
        faults=names,
        fault_units=tuple(channel.unit for channel in profile.faults),
        usual_commands=tuple(map(profile.usual_commands.get, names)),
        smoothing_s=profile.isolation.smoothing_s,
    )


def made_by_sensors(profile: ObserverProfile) -> dict[str, dict[str, float]]:
    """Return, by fault that scales an input, how large it seems to be for a unit of each sensor's constant bias.

    The model takes a bias b of a state's sensor for disturbances (I - A) b of the next state. Each hypothesis of the
    bank explains them by its faults as far as it can; the largest size counts. Only states that such a sensor measures
    are compared, as others are noisier.
    """
    plant, rule = profile.model, profile.isolation
    if plant is None or not isinstance(rule, BankRule) or plant.C.shape != plant.A.shape:
        return {}
    biases = {fault.name: fault.column for fault in plant.faults if fault.kind == "sensor"}
    inputs = {fault.name: plant.inputs.index(fault.input) for fault in plant.faults if fault.input}
    columns = np.array([*biases.values()]).reshape(len(biases), len(plant.A)).T
    measured = columns.any(axis=1)
    disturbed = ((np.eye(len(plant.A)) - plant.A) @ columns)[measured]
    made: dict[str, dict[str, float]] = {}
    for faults in (faults for faults in rule.hypotheses if inputs.keys() >= set(faults)):
        effects = plant.B[measured][:, [inputs[name] for name in faults]]
        for name, sizes in zip(faults, np.abs(np.linalg.pinv(effects) @ disturbed), strict=True):
            known = made.setdefault(name, dict.fromkeys(biases, 0.0))
            made[name] = {sensor: max(known[sensor], float(size)) for sensor, size in zip(known, sizes, strict=True)}
    return made


def shown_in(plant: Plant | None, layout: Layout) -> NDArray[np.bool_]:
    """Return the outputs in which each fault shows, at once or later (a, p); all outputs if the plant is not known."""
    shown = np.ones((len(layout.faults), len(layout.outputs)), np.bool_)
    if plant is None:
        return shown
    n = len(plant.states)
    moves = plant.A != 0.0
    for g, column in zip(plant.nonlinearities, plant.G.T, strict=True):
        moves |= np.outer(column != 0.0, (g.rows != 0.0).any(axis=0))
    moves = np.linalg.matrix_power((moves | np.eye(n, dtype=np.bool_)).astype(np.float64), n) > 0.0
    for fault in plant.faults:
        if fault.name not in layout.faults:
            continue
        column = plant.B[:, plant.inputs.index(fault.input)] if fault.input else fault.column
        reached = column if fault.kind == "sensor" else (plant.C != 0.0) @ (moves @ (column != 0.0))
        shown[layout.faults.index(fault.name)] = reached != 0.0
    return shown


def alarm_events(runs: Sequence[ChainRun], excuses: Excuses) -> list[AlarmEvent]:
    """Return the events of all of a vehicle's observers over the same messages, in the order in which they arise.

    An event changes which alarms are excused in all rows after it, also those of other observers.
    """
    events = []

    def on_event(observer: int, row: int, alarm: int, code: int) -> None:
        run = runs[observer]
        if code == EXPLAINED:
            samples = run.estimates.samples
            late_ns = max(0, int(samples.known_ns[row] - samples.vehicle_time_ns[row]))
            times_ns = int(samples.time_ns[row]) + late_ns, int(samples.vehicle_time_ns[row]) + late_ns
            listed = excuses.explained(run.alarms[alarm].rule.channel, *times_ns, run.alarms[alarm].state)
            events.extend([] if listed is None else [listed])
            return
        event = run.event(row, alarm, code)
        events.append(event)
        excuses.follow(event)
        events.extend(excuses.consequences(event))
        if code == RAISED and alarm < len(run.faults):
            for other in run.alarms:
                if other.state.active and other.state.rival == run.faults[alarm]:
                    # The alarm said that it may be this one instead.
                    ended = other.withdraw(
                        event.time_ns, event.vehicle_time_ms * 1_000_000, f"explained by {event.channel}"
                    )
                    events.extend(excuses.consequence(ended))

    walk([run.rows for run in runs], on_event)
    return events
