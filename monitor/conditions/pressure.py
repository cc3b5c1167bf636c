"""Find a drift of the pressure at sea level: heights by barometer and by GPS slowly diverge."""

from monitor.conditions.condition import FlightCondition
from monitor.conditions.half_seconds import HalfSecond
from monitor.display import number_text

_MEAN = 60
"""Half seconds over which the difference of heights is averaged: 30 s, over which the noise of fixes averages out."""
_LEAST_M = 4.0
"""Least change of the difference that is reported, m. Chosen: heights by GPS wander by a metre or two within a
flight."""
METRES_PER_HPA = 8.3
"""Height of a hectopascal at sea level, m: the standard atmosphere's 8,434 m over its 1,013 hPa."""


class Pressure:
    """Follows the difference of heights through half seconds of flight."""

    def __init__(self) -> None:
        self._sum, self._count = 0.0, 0
        self._said: float | None = None

    def follow(self, mean: HalfSecond) -> FlightCondition | None:
        """Process the next half second; return the drift since the last report, or since the flight's first 30 s."""
        self._sum += mean.height - mean.gps_height
        self._count += 1
        if self._count < _MEAN:
            return None
        now, self._sum, self._count = self._sum / self._count, 0.0, 0
        if self._said is None:
            self._said = now
            return None
        drift = now - self._said
        if abs(drift) < _LEAST_M:
            return None
        self._said = now
        pressure = -drift / METRES_PER_HPA
        text = (
            f"barometer and GPS parted by {number_text(drift, 2, signed=True)} m, as a change of the pressure at sea "
            f"level by {number_text(pressure, 2, signed=True)} hPa does"
        )
        return FlightCondition("pressure", mean.time_ns, text, {"height_m": drift, "sea_level_hpa": pressure})
