"""Samples and when they count as evidence: armed, in the air, and settled; never on the ground, at take-off or landing.

Rules, in order: a vehicle known to be disarmed is not watched; where the vehicle reports its landed state, only
"in the air" counts; where it does not, a mean command of at least ``airborne_command`` stands for it. Each time the
rules come to hold, ``settle_s`` of vehicle time passes before evidence counts. When what the vehicle says of itself
comes to allow evidence, a new stretch of samples begins: what was estimated on the ground, before the first fix of the
GPS or while the vehicle was carried about, is forgotten.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from adapters.clock import VehicleClock
from adapters.message import Message
from adapters.phase import FlightPhase
from adapters.sample import Sample
from adapters.sampler import SamplerStatistics
from adapters.transform import Source, make_sampler


@dataclass(frozen=True, slots=True)
class GateRule:
    """What has to hold for samples to count.

    Parameters
    ----------
    require_armed, require_airborne : bool
        Which of the rules apply.
    settle_s : float
        Wait after they come to hold, seconds.
    airborne_command : float
        Mean command above which a vehicle that does not report its landed state is taken to be in the air.
    """

    require_armed: bool = True
    require_airborne: bool = True
    settle_s: float = 1.0
    airborne_command: float = 0.0


class FlightGate:
    """Keeps the time since the rules hold."""

    def __init__(self, rule: GateRule) -> None:
        self._rule = rule
        self._since_ns: int | None = None

    def admits(self, phase: FlightPhase, sample: Sample, commands: bool = True) -> bool:
        """Return whether the sample counts as evidence.

        Without ``commands`` its inputs are none, and say nothing about being in the air.
        """
        if sample.restart:
            self._since_ns = None
        if not self._holds(phase, sample, commands):
            self._since_ns = None
            return False
        if self._since_ns is None:
            self._since_ns = sample.vehicle_time_ns
        return sample.vehicle_time_ns - self._since_ns >= self._rule.settle_s * 1e9

    def _holds(self, phase: FlightPhase, sample: Sample, commands: bool) -> bool:
        if not _allowed(self._rule, phase):
            return False
        if not self._rule.require_airborne or phase.landed is not None or not commands:
            return True
        return float(np.mean(sample.u)) >= self._rule.airborne_command


class GatedSample(NamedTuple):
    """A sample and whether it is evidence."""

    sample: Sample
    armed: bool


class GatedSampler:
    """An observer's samples from the vehicle's messages, each with whether it is evidence.

    Parameters
    ----------
    source : Source
        Where u and y come from.
    rate_hz : float
        Samples per second.
    clock : VehicleClock
        The vehicle's clock.
    rule : GateRule
        When samples count.
    """

    def __init__(self, source: Source, rate_hz: float, clock: VehicleClock, rule: GateRule) -> None:
        self._sampler = make_sampler(source, rate_hz, clock)
        self._gate = FlightGate(rule)
        self._rule = rule
        self._commands = source.transform is None
        self._allowed = False

    @property
    def interests(self) -> frozenset[str]:
        """Names of the messages the channels come from."""
        return self._sampler.interests

    def statistics(self) -> SamplerStatistics:
        """Return what the sampler counted."""
        return self._sampler.statistics()

    def feed(self, message: Message, phase: FlightPhase) -> list[GatedSample]:
        """Take one message; return the samples it completes, in order of time."""
        allowed = _allowed(self._rule, phase)
        if allowed and not self._allowed:
            self._sampler.restart()
        self._allowed = allowed
        return [
            GatedSample(sample, self._gate.admits(phase, sample, self._commands) and sample.complete)
            for sample in self._sampler.feed(message)
        ]


def _allowed(rule: GateRule, phase: FlightPhase) -> bool:
    """Return whether what the vehicle says of itself allows evidence; what it does not say does."""
    if rule.require_armed and phase.armed is False:
        return False
    return not rule.require_airborne or phase.landed in (None, "air")
