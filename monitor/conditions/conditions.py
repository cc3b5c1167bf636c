"""Find the conditions of one vehicle's flight in its telemetry: they are no faults and raise no alarms.

The motors' commands and the raw signals of the inertial observer are sampled together some times a second; means over
half seconds (:mod:`monitor.conditions.half_seconds`) are processed one after the other. As in the whole pipeline, the
result does not depend on how the telemetry is cut into batches.
"""

import re
from collections import deque
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from adapters.sample import Samples
from monitor.conditions.condition import FlightCondition
from monitor.conditions.half_seconds import SIGNALS, HalfSeconds
from monitor.conditions.load import Load
from monitor.conditions.pressure import METRES_PER_HPA, Pressure
from monitor.conditions.wind import Wind
from monitor.core.sampling import VehicleClock
from monitor.profile import ObserverProfile, Profile
from monitor.sampling.gate import GatedSampler
from monitor.sampling.phase import FlightPhase
from monitor.sampling.transform import SampleSource

_FASTEST_HZ, _SLOWEST_HZ = 10.0, 8.0
"""Samples per second. Chosen: five in half a second; slower telemetry does not show that a change is sudden."""
_KEPT = 50
"""Number of conditions that are kept. Chosen: a flight has some."""
_HOVER = 0.5
"""Command at which the exponent of a learned thrust curve is evaluated: most multirotors hover near it."""
_HECTOPASCAL, _METRES = 2.0, -METRES_PER_HPA
"""Parameter of the strapdown transform whose barometer measures a pressure; height of one hectopascal more, m
(negative)."""
_MOTOR = re.compile(r"motor\d+")


class Conditions:
    """Follows the conditions of a vehicle whose profile has motors and inertial signals, by samples of ``sampler``."""

    def __init__(
        self, profile: Profile, motors: ObserverProfile, inertial: ObserverProfile, clock: VehicleClock
    ) -> None:
        commands = [signal for signal in motors.source.signals or motors.source.inputs if _MOTOR.fullmatch(signal.name)]
        signals = {signal.name: signal for signal in inertial.source.signals}
        source = SampleSource(inputs=(*commands, *(signals[name] for name in SIGNALS)))
        self._gated = GatedSampler(source, _FASTEST_HZ, clock, profile.gate)
        self.sampler = self._gated.sampler
        rule = inertial.source.transform
        pressed = rule is not None and rule.parameters.get("barometer") == _HECTOPASCAL
        self._half_seconds = HalfSeconds(
            _arms(motors, [command.name for command in commands]), _METRES if pressed else 1.0
        )
        self._load, self._wind, self._pressure = Load(_exponents(motors), profile.mass_kg), Wind(), Pressure()
        self._motors, self._number = len(commands), -1
        self.found: deque[FlightCondition] = deque(maxlen=_KEPT)

    def enter(self, allowed: bool) -> None:
        """Restart at the next sample if the phase of flight begins to allow evidence."""
        self._gated.enter(allowed)

    def run(self, samples: Samples, phase: FlightPhase) -> None:
        """Process n samples of :attr:`sampler`.

        The vehicle's phase is the same for all of them and was entered before.
        """
        if not len(samples):
            return
        # the gate decides from the mean command whether the vehicle flies
        commanded = replace(samples, u=samples.u[:, : self._motors])
        flown = self._gated.gate.admitted(phase, commanded)
        if not flown.any():
            return
        for mean in self._half_seconds.run(samples.vehicle_time_ns[flown], samples.time_ns[flown], samples.u[flown]):
            if mean.number != self._number + 1:
                self._load.clear()
            self._number = mean.number
            for stage in (self._load, self._wind, self._pressure):
                if (condition := stage.follow(mean)) is not None:
                    self.found.append(condition)


def make_conditions(profile: Profile, clock: VehicleClock) -> Conditions | None:
    """Return the conditions of a profile's vehicle; None if it lacks the signals, or samples them too seldom."""
    motors = next((observer for observer in profile.observers if observer.name == "motors"), None)
    inertial = next(
        (
            observer
            for observer in profile.observers
            if set(SIGNALS) <= {channel.name for channel in observer.source.signals}
        ),
        None,
    )
    if motors is None or inertial is None or inertial.source.transform is None:
        return None
    return Conditions(profile, motors, inertial, clock) if inertial.source.transform.rate_hz >= _SLOWEST_HZ else None


def _arms(motors: ObserverProfile, names: list[str]) -> NDArray[np.float64]:
    """Return the position of each motor, by its effect on pitch and roll (motors, 2), in shares of the largest."""
    model = motors.model
    if model is None or not {"roll_rate", "pitch_rate"} <= set(model.states) or not set(names) <= set(model.inputs):
        return np.full((len(names), 2), np.nan)
    inputs = [model.inputs.index(name) for name in names]
    pitch, roll = (model.B[model.states.index(f"{axis}_rate"), inputs] for axis in ("pitch", "roll"))
    # a motor in front lifts the nose, one on the right lowers the left side
    arms = np.column_stack([pitch / np.abs(pitch).max(), -roll / np.abs(roll).max()])
    return np.asarray(arms, np.float64)


def _exponents(motors: ObserverProfile) -> tuple[float, float]:
    """Return the limits of the exponent of thrust over command: a learned curve gives it within a tenth."""
    curve = motors.gains[0].input_curves
    if curve.shape[1] < 2 or not curve[:, 1:].any():
        return 1.0, 2.0
    powers = np.arange(1, curve.shape[1] + 1)
    terms = curve.mean(axis=0) * _HOVER**powers
    middle = float(terms @ powers / terms.sum())
    return 0.9 * middle, 1.1 * middle
