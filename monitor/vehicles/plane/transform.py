"""Scales the deflections of a plane's surfaces to their effects at the present airspeed.

The moment of a control surface is proportional to dynamic pressure, a damping moment to speed. With s = airspeed /
reference,

    effect = deflection s^2,   damping of a body rate ~ rate s

so that the plant has constant coefficients.
"""

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from adapters.channels import STANDARD_GRAVITY
from monitor.core.lagged import cosines, sines
from monitor.sampling.scaled import Array, Mix, Scaled, ScaledInputs

_SMALLEST_SCALE = 0.2
"""Least s to divide by: the path's curvature and the drag grow without bound towards zero. Chosen: no plane flies at a
fifth of its reference speed, so no evidence is altered."""
_UNFELT, _WITHIN_S, _DOUBT_S = 0.2, 0.3, 2.0
"""A jump of the airspeed that the accelerometer does not measure: its least size, as a share of the reference speed,
the time within which it happens, and the time for which the airspeed is then in doubt, until its own observer has
compared it with the GPS, seconds. Chosen: gusts of a storm reach a tenth in that time, and a pull-up of 3 g leaves
half of that unexplained."""


class SurfaceInputs(ScaledInputs):
    """Samples of a plane: surfaces scaled by dynamic pressure, and what else turns the airframe.

    While the airspeed has just jumped the effects are not known: such samples are no evidence.

    Inputs are, after the four actuators, ``pressure`` s^2 (trims), the damping (s - 1) rate beyond that at the
    reference speed, the rates s that couple roll and yaw, lateral and vertical specific force (they stand for
    sideslip and angle of attack, and with these for the gusts), the share of gravity that curves the path, and
    ``lift_drag`` = vertical force squared over s^2.
    """

    kind: ClassVar[str] = "surfaces"
    actuators: ClassVar[tuple[str, ...]] = ("aileron", "elevator", "rudder", "throttle")
    signals: tuple[str, ...] = (
        *actuators,
        "airspeed",
        "roll",
        "pitch",
        "roll_rate",
        "pitch_rate",
        "yaw_rate",
        "forward_acceleration",
        "lateral_acceleration",
        "vertical_acceleration",
    )
    inputs: ClassVar[tuple[str, ...]] = (
        *actuators,
        "pressure",
        "roll_damping",
        "pitch_damping",
        "yaw_damping",
        "roll_coupling",
        "yaw_coupling",
        "side_force",
        "normal_force",
        "side_gravity",
        "normal_gravity",
        "lift_drag",
    )
    outputs: ClassVar[tuple[str, ...]] = ("roll_rate", "pitch_rate", "yaw_rate", "forward_acceleration")

    mixes: ClassVar[tuple[Mix, ...]] = (
        Mix("elevons", "aileron", "elevator", "elevon_left", "elevon_right"),
        Mix("v_tail", "rudder", "elevator", "tail_left", "tail_right"),
    )

    def __init__(self, parameters: Mapping[str, float], signal_rate_hz: float, rate_hz: float) -> None:
        super().__init__(parameters, signal_rate_hz, rate_hz)
        self._before = np.empty((round(_WITHIN_S * signal_rate_hz), 2))
        self._doubt = round(_DOUBT_S * signal_rate_hz)
        self._doubted = -self._doubt  # row of the last jump, counted from the latest one
        self._signal_rate_hz, self._begun = signal_rate_hz, False

    def scale(self, signals: Array) -> Scaled:
        """Return inputs, then outputs, before timing and grouping; ``signals`` (number of signals, n)."""
        aileron, elevator, rudder, throttle, airspeed, roll, pitch = signals[:7]
        roll_rate, pitch_rate, yaw_rate, forward, lateral, vertical = signals[7:]
        s = airspeed / self.reference
        path = np.maximum(s, _SMALLEST_SCALE)
        cos_pitch = cosines(pitch)
        columns = [
            s * s * aileron,
            s * s * elevator,
            s * s * rudder,
            throttle,
            s * s,
            (s - 1.0) * roll_rate,
            (s - 1.0) * pitch_rate,
            (s - 1.0) * yaw_rate,
            s * roll_rate,
            s * yaw_rate,
            lateral,
            vertical,
            sines(roll) * cos_pitch / path,
            cosines(roll) * cos_pitch / path,
            vertical * vertical / (path * path),
            roll_rate,
            pitch_rate,
            yaw_rate,
            forward,
        ]
        jumped = self._jumped(airspeed, forward - STANDARD_GRAVITY * sines(pitch))
        return Scaled(columns, (airspeed >= self.minimum) & ~jumped)

    def _jumped(self, airspeed: Array, acceleration: Array) -> NDArray[np.bool_]:
        """Return where the airspeed has lately changed unlike the acceleration along the body."""
        now = np.column_stack([airspeed, acceleration])
        if not self._begun and len(now):
            self._before[:], self._begun = now[0], True
        both = np.vstack([self._before, now])
        then, lasted = both[: len(now)], len(self._before) / self._signal_rate_hz
        felt = 0.5 * lasted * (now[:, 1] + then[:, 1])
        jumps = np.abs(now[:, 0] - then[:, 0] - felt) > _UNFELT * self.reference
        jumps &= then[:, 0] >= self.minimum  # slower samples are no evidence anyway
        rows = np.arange(1, len(now) + 1)
        since = rows - np.maximum.accumulate(np.where(jumps, rows, self._doubted))
        self._before = both[len(both) - len(self._before) :]
        if len(now):
            self._doubted = -int(since[-1])
        return since < self._doubt
