"""Estimate the wind of a multirotor from its drag: the specific force across the propellers' thrust.

Thrust has no component along the body's x and y. Accelerometers measure drag there, which is proportional to the speed
through the air:

    f_north = -D (v_north - w_north),     f_east = -D (v_east - w_east)

with the GPS's velocity v. D is constant for the vehicle, the wind w changes. A Kalman filter of D, D w_north and D
w_east separates them as soon as the vehicle has flown at different velocities. If drag grows with the square of the
speed, the wind's size is uncertain, its direction is not.
"""

import math

from monitor.conditions.condition import FlightCondition
from monitor.conditions.half_seconds import HalfSecond
from monitor.display import number_text

_USUAL = 0.3
"""First estimate of D, 1/s, and its standard deviation. Measured: 0.3 to 0.45 and 0.6 to 0.95 in two simulators."""
_PULL = 1.0
"""Standard deviation of the first estimate of D w, m/s^2: 3 m/s of wind for the usual D."""
_NOISE = 0.3
"""Error of a mean over half a second, m/s^2: gusts and accelerometers, in 15 simulated flights 0.1 to 0.5."""
_DRIFT = 0.09
"""Change of D w over a root second, m/s^2: chosen so that the filter follows the wind within some seconds (the root of
noise over drift, 0.3 / 0.09), and does not follow a gust."""
_KNOWN = 0.05
"""Relative standard error of D below which the wind is reported. Measured: at 0.12 a flight reported 15 m/s in a wind
of 5."""
_SIZE = 0.3
"""Relative standard deviation of the wind's size from the shape of the drag. Measured on flights in known wind: the
reported sizes were 0.9 to 2 times the true ones."""
_CHANGED = 3.0
"""Difference from the last reported wind at which it is reported again, m/s: chosen, a Beaufort number or two."""
_LEAST = 1.0
"""Wind below which the air is calm, m/s: the error from accelerometers' biases (0.05 m/s^2) and gusts."""


class Wind:
    """Follows the wind through half seconds of flight."""

    def __init__(self) -> None:
        self._x = [_USUAL, 0.0, 0.0]
        self._P = [[_USUAL**2, 0.0, 0.0], [0.0, _PULL**2, 0.0], [0.0, 0.0, _PULL**2]]
        self._said: tuple[float, float] | None = None

    def follow(self, mean: HalfSecond) -> FlightCondition | None:
        """Process the next half second; return the wind if it is known for the first time or has changed."""
        x, P = self._x, self._P
        for axis, speed, pull in zip((1, 2), mean.velocity, mean.pull, strict=True):
            P[axis][axis] += 0.5 * _DRIFT**2
            # of H = -speed in the first column and 1 in that of the axis
            PH = [row[axis] - speed * row[0] for row in P]
            error, variance = pull - (x[axis] - speed * x[0]), PH[axis] - speed * PH[0] + _NOISE**2
            x = [value + error * gain / variance for value, gain in zip(x, PH, strict=True)]
            P = [
                [entry - gain / variance * of for entry, of in zip(row, PH, strict=True)]
                for row, gain in zip(P, PH, strict=True)
            ]
        self._x, self._P = x, P
        drag = x[0]
        if not math.sqrt(P[0][0]) < _KNOWN * drag:
            return None
        north, east = x[1] / drag, x[2] / drag
        if self._said is not None and math.dist((north, east), self._said) < _CHANGED:
            return None
        self._said = (north, east)
        size = math.hypot(north, east)
        sd = math.hypot(math.sqrt(max(P[1][1], P[2][2])) / drag, _SIZE * size)
        values = {"north_m_s": north, "east_m_s": east, "speed_m_s": size, "sd_m_s": sd}
        if size < _LEAST:
            return FlightCondition("wind", mean.time_ns, f"wind below {_LEAST:g} m/s", values)
        origin = math.degrees(math.atan2(-east, -north)) % 360.0
        text = f"wind {number_text(size, 2)} ± {number_text(sd, 1)} m/s from {origin:.0f} degrees"
        return FlightCondition("wind", mean.time_ns, text, values | {"from_deg": origin})
