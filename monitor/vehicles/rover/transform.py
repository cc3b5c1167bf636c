"""Scales the steering of a rover to its effect at the present speed.

A steered wheel turns the vehicle in proportion to its rolling speed. With s = forward speed / reference, signed,

    effect = (steering + kappa steering^3) s

so that the plant has constant coefficients. Wheels that are driven on two sides turn it at every speed: without s.
"""

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from adapters.errors import TelemetryError
from monitor.core.lagged import cosines, sines
from monitor.sampling.scaled import Array, Mix, Scaled, ScaledInputs


class DriveInputs(ScaledInputs):
    """Samples of a rover: steering scaled by the speed along its own axis.

    The speed is the horizontal velocity projected on the heading: it is signed, so that the effect of steering reverses
    in reverse driving, and it is on the vehicle's clock, unlike VFR_HUD. Parameters are those of
    :class:`monitor.sampling.scaled.ScaledInputs`, ``steering_cubic`` (kappa) and ``differential``: 1 if
    it is steered by the difference of two sides.
    """

    kind: ClassVar[str] = "drive"
    actuators: ClassVar[tuple[str, ...]] = ("steering", "throttle")
    signals: tuple[str, ...] = (
        *actuators,
        "velocity_north",
        "velocity_east",
        "yaw",
        "yaw_rate",
        "forward_acceleration",
    )
    inputs: ClassVar[tuple[str, ...]] = (*actuators, "speed")
    outputs: ClassVar[tuple[str, ...]] = ("yaw_rate", "forward_acceleration")
    extra_parameters: ClassVar[frozenset[str]] = frozenset({"steering_cubic", "differential"})
    mixes: ClassVar[tuple[Mix, ...]] = (Mix("sides", "steering", "throttle", "wheels_left", "wheels_right"),)
    may_stand: ClassVar[bool] = True

    def __init__(self, parameters: Mapping[str, float], signal_rate_hz: float, rate_hz: float) -> None:
        super().__init__(parameters, signal_rate_hz, rate_hz)
        self._cubic = parameters.get("steering_cubic", 0.0)
        self._differential = parameters.get("differential", 0.0) > 0.0
        if not abs(self._cubic) <= 10.0:
            raise TelemetryError(f"transform '{self.kind}': 'steering_cubic' is {self._cubic:g}; at most 10")

    def scale(self, signals: Array) -> Scaled:
        """Return inputs, then outputs, before timing and grouping; ``signals`` (number of signals, n)."""
        steering, throttle, north, east, yaw, yaw_rate, forward = signals
        speed = north * cosines(yaw) + east * sines(yaw)
        s = speed / self.reference
        effect = steering + self._cubic * steering * steering * steering
        if not self._differential:
            effect = effect * s
        return Scaled([effect, throttle, s, yaw_rate, forward], np.abs(speed) >= self.minimum)
