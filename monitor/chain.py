"""One observer of a vehicle from messages to events: sampler -> gate -> estimator -> alarms.

A sample whose outputs were lost (``measured`` of :class:`adapters.sample.Sample`) is coasted: the model goes on alone,
what was believed stands, the uncertainty grows. After a gap that is too long for that the observer starts afresh, and
is evidence again when what a wrong start does to its estimates has died away (:mod:`monitor.estimation.settling`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from adapters.message import Message
from adapters.sample import Sample, Samples
from monitor.alarms.alarm import Alarm, retuned
from monitor.alarms.alarm_stretch import AlarmStretch
from monitor.alarms.excuse import Excuses
from monitor.chain_stretch import ChainStretch, Evidence
from monitor.command_units import CommandUnits
from monitor.effectiveness_stage import EffectivenessRun, EffectivenessStage
from monitor.estimate import Estimate, Estimates, Layout
from monitor.estimation.estimator import make_estimator
from monitor.estimation.estimator_run import EstimatorRun
from monitor.estimation.settling import settling_s
from monitor.estimation.uncertainty import Uncertainty
from monitor.event import AlarmEvent
from monitor.profile import ObserverProfile
from monitor.sampling.clock import VehicleClock
from monitor.sampling.gate import GatedSampler, GateRule
from monitor.sampling.phase import FlightPhase
from monitor.sampling.sampler import Sampler, SamplerStatistics

Output = Estimate | AlarmEvent


class ObserverChain:
    """State of one observer of one vehicle.

    Parameters
    ----------
    profile : ObserverProfile
        The observer's part of the profile.
    vehicle : str
        The vehicle's name in events.
    gate : GateRule
        When samples count as evidence.
    clock : VehicleClock
        The vehicle's clock, shared by its observers.
    excuses : Excuses | None
        What the vehicle's alarms explain, shared by its observers; None: nothing.
    """

    def __init__(
        self,
        profile: ObserverProfile,
        vehicle: str,
        gate: GateRule,
        clock: VehicleClock,
        excuses: Excuses | None = None,
    ) -> None:
        gains = profile.gains[0]
        names = tuple(channel.name for channel in profile.faults)
        self.layout = Layout(
            observer=profile.name,
            rate_hz=gains.rate_hz,
            inputs=gains.inputs,
            outputs=gains.outputs,
            states=gains.states,
            faults=names,
            fault_units=tuple(channel.unit for channel in profile.faults),
        )
        self._name = profile.name
        rule = replace(gate, settle_s=max(gate.settle_s, profile.settle_s or settling_s(profile.gains)))
        self._sampler = GatedSampler(profile.source, gains.rate_hz, clock, rule)
        thresholds = {rule.channel: rule.threshold for rule in profile.alarms}
        self._estimator = make_estimator(profile.gains, profile.isolation, names, thresholds)
        self._uncertainty = Uncertainty(profile.gains, profile.model, names)
        self._measured_ns = 0
        alarms = [Alarm(rule, vehicle) for rule in profile.alarms]
        self._alarms = [(names.index(alarm.rule.channel), alarm) for alarm in alarms if alarm.rule.kind != "residual"]
        self._every_alarm = alarms
        self._residual_alarms = [alarm for alarm in alarms if alarm.rule.kind == "residual"]
        self._command = CommandUnits(profile)
        self._excuses = excuses or Excuses(())
        self._effectiveness = EffectivenessStage(profile.effectiveness, profile.faults, gains.inputs, gains.rate_hz)

    @property
    def interests(self) -> frozenset[str]:
        """Names of the messages the observer's channels come from."""
        return self._sampler.interests

    @property
    def smoothed(self) -> NDArray[np.float64]:
        """Smoothed estimate of each fault under its own hypothesis at the last sample (a,), effect units."""
        return self._estimator.smoothed

    @property
    def unexplained(self) -> float:
        """Score of what no hypothesis explained at the last sample, zero where one does."""
        return self._estimator.unexplained

    @property
    def channels(self) -> frozenset[str]:
        """Channels that have an alarm."""
        return frozenset(alarm.rule.channel for alarm in self._every_alarm)

    @property
    def thresholds(self) -> dict[str, float]:
        """Alarm thresholds by channel."""
        return {alarm.rule.channel: alarm.rule.threshold for alarm in self._every_alarm}

    def adopt(self, event: AlarmEvent) -> None:
        """Go on from an alarm event that another run of the monitor, or another monitor, made."""
        for alarm in self._every_alarm:
            if alarm.rule.channel == event.channel:
                alarm.adopt(event)
                self._excuses.note(event)

    def retune(self, rules: Mapping[str, Mapping[str, float]]) -> None:
        """Let other sizes and times of alarms hold from the next sample on, by channel and key."""
        for alarm in self._every_alarm:
            alarm.rule = retuned(alarm.rule, rules.get(alarm.rule.channel, {}))

    def statistics(self) -> SamplerStatistics:
        """Return what the sampler counted."""
        return self._sampler.statistics()

    def feed(self, message: Message, phase: FlightPhase) -> list[Output]:
        """Take one message; return estimates and events in the order they arise."""
        outputs: list[Output] = []
        for sample, armed in self._sampler.feed(message, phase):
            outputs.extend(self.step(sample, armed))
        return outputs

    @property
    def sampler(self) -> Sampler:
        """What turns messages into samples, of raw signals where a transform follows."""
        return self._sampler.sampler

    def enter(self, phase: FlightPhase) -> None:
        """Begin a new stretch of samples where the phase has come to allow evidence."""
        self._sampler.enter(phase)

    def run(self, samples: Samples, position: NDArray[np.int64], phase: FlightPhase) -> ChainStretch:
        """Take what :attr:`sampler` made of a stretch of messages; return estimates and evidence of all of it.

        Bit for bit what :meth:`feed` makes of the messages one by one; the alarms are asked by
        :func:`monitor.chain_stretch.events_in_order`.

        Parameters
        ----------
        samples : Samples
            The n samples that the messages completed.
        position : NDArray[np.int64]
            Place of the message that completed each (n,).
        phase : FlightPhase
            The vehicle's phase, the same over the stretch and entered before it.
        """
        samples, rows = self._sampler.run(samples)
        armed = self._sampler.admitted(samples, phase)
        found = self._estimator.run(samples)
        measured = samples.measured | samples.restart
        sd = self._uncertainty.run(measured, samples.restart)
        effects = self._effectiveness.run(samples, found.fault, armed)
        shown = self._command.run(samples.u, samples.restart, found.fault, found.evidence, sd)
        for index, effect in effects.items():
            shown.isolated[:, index] = effect.size
        estimates = Estimates(
            observer=self._name,
            samples=samples,
            x=found.x,
            fault=shown.fault,
            isolated=shown.isolated,
            residual=found.residual,
            armed=armed,
            sd=shown.sd,
            coasted_s=self._coasted_s(samples.vehicle_time_ns, measured),
        )
        evidence = self._evidence(estimates, found, effects, shown.commands)
        return ChainStretch(estimates, position[rows], tuple(evidence))

    def _coasted_s(self, times_ns: NDArray[np.int64], measured: NDArray[np.bool_]) -> NDArray[np.float64]:
        last = np.maximum.accumulate(np.where(measured, np.arange(len(times_ns)), -1))
        since_ns = np.where(last >= 0, times_ns[last], self._measured_ns)
        if len(since_ns):
            self._measured_ns = int(since_ns[-1])
        return np.asarray((times_ns - since_ns) * 1e-9, np.float64)

    def _evidence(
        self,
        estimates: Estimates,
        found: EstimatorRun,
        effects: Mapping[int, EffectivenessRun],
        commands: Mapping[int, NDArray[np.float64]],
    ) -> Iterator[Evidence]:
        """Yield the evidence of each alarm over a stretch, in the order in which :meth:`step` asks them."""
        times, restart, armed = estimates.samples.vehicle_time_ns, estimates.samples.restart, estimates.armed
        for index, alarm in self._alarms:
            size, speaking = estimates.isolated[:, index], armed & found.speaks[:, index]
            command = relative = None
            if (effect := effects.get(index)) is not None:
                speaking, relative = speaking & ~np.isnan(effect.evidence), effect.share
            else:
                command = commands.get(index)
            now = speaking & ~self._excuses.excused_rows(alarm.rule.channel, times)
            yield Evidence(AlarmStretch(alarm, times, restart, size, now), size, speaking, command, relative)
        for alarm in self._residual_alarms:
            size = found.unexplained
            yield Evidence(AlarmStretch(alarm, times, restart, size, armed), size, armed, excusable=False)

    def step(self, sample: Sample, armed: bool) -> list[Output]:
        """Take one sample, ``armed`` saying whether it is evidence; return its estimate and the events it causes."""
        estimator, measured = self._estimator, sample.measured or sample.restart
        if sample.restart:
            estimator.restart(sample.u, sample.y)
            self._command.restart(sample.u)
            self._uncertainty.restart()
        if measured:
            estimator.step(sample.u, sample.y, sample.complete)
            self._measured_ns = sample.vehicle_time_ns
        else:
            estimator.coast(sample.u)
        self._uncertainty.follow(measured)
        verdicts = self._effectiveness.judge(sample, estimator.fault, armed)
        self._command.follow(sample.u)
        upper = estimator.fault + self._uncertainty.sd
        fault, isolated, upper = self._command.convert(np.stack([estimator.fault, estimator.evidence, upper]))
        for index, size in self._effectiveness.sizes.items():
            isolated[index] = size
        outputs: list[Output] = [
            Estimate(
                observer=self._name,
                sample=sample,
                x=estimator.x.copy(),
                fault=fault,
                isolated=isolated,
                residual=estimator.residual.copy(),
                armed=armed,
                sd=np.abs(upper - fault),
                coasted_s=(sample.vehicle_time_ns - self._measured_ns) * 1e-9,
            )
        ]
        unexplained = estimator.unexplained
        for index, alarm in self._alarms:
            # Evidence that no hypothesis explains speaks neither for a fault nor against it.
            excused = self._excuses.excused(alarm.rule.channel, sample.vehicle_time_ns)
            if not armed or not estimator.speaks[index] or excused:
                alarm.pause()
                continue
            size = float(isolated[index])
            if index not in self._effectiveness.sizes:
                event = alarm.update(sample, size, self._command.command(index))
            elif (verdict := verdicts.get(index)) is None or verdict.evidence is None:
                alarm.pause()
                continue
            else:
                event = alarm.update(sample, size, None, verdict.share)
            if event is not None:
                outputs.append(event)
                self._excuses.note(event)
        for alarm in self._residual_alarms:
            if not armed:
                alarm.pause()
                continue
            event = alarm.update(sample, unexplained, None)
            if event is not None:
                outputs.append(event)
        return outputs
