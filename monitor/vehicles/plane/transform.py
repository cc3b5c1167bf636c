"""Deflections of a plane's surfaces as the effects they have at the present airspeed.

A control surface acts with the dynamic pressure and a damping moment with the speed. With s = airspeed / reference,

    effect = deflection s^2,   damping of a body rate ~ rate s

so that the plant behind it has constant coefficients.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from monitor.core.lagged import cosines, sines
from monitor.sampling.scaled import Array, Scaled, ScaledInputs

_SMALLEST_SCALE = 0.2
"""Least s to divide by, where the path's curvature and the drag grow without bound; chosen: no plane flies at a fifth
of its reference speed, so no evidence is altered."""


class SurfaceInputs(ScaledInputs):
    """Samples of a plane: surfaces scaled by dynamic pressure, and what else turns the airframe.

    Inputs are, after the four actuators, ``pressure`` s^2 (trims), the damping (s - 1) rate beyond that at the
    reference speed, the rates s that couple roll and yaw, lateral and vertical specific force (they stand for
    sideslip and angle of attack, and with these for the gusts), the share of gravity that curves the path, and
    ``lift_drag`` = vertical force squared over s^2.
    """

    kind: ClassVar[str] = "surfaces"
    actuators: ClassVar[tuple[str, ...]] = ("aileron", "elevator", "rudder", "throttle")
    signals: ClassVar[tuple[str, ...]] = (
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
        return Scaled(columns, airspeed >= self.minimum)
