"""When samples count as evidence: armed, in the air, and settled; never on the ground, at take-off or landing.

Rules, in order: a vehicle known to be disarmed is not watched; where the vehicle reports its landed state, only
"in the air" counts; where it does not, a mean command of at least ``airborne_command`` stands for it. Each time the
rules come to hold, ``settle_s`` of vehicle time passes before evidence counts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adapters.phase import FlightPhase
from adapters.sample import Sample


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
        if self._rule.require_armed and phase.armed is False:
            return False
        if not self._rule.require_airborne:
            return True
        if phase.landed is not None:
            return phase.landed == "air"
        return not commands or float(np.mean(sample.u)) >= self._rule.airborne_command
