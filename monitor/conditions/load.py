"""Find a load that was picked up or let go: a sudden weight changes the ratio of command to specific force.

With thrust T = k u^p of the mean command u and the vertical specific force f = T / m, the quantity

    l = ln u - ln |f|,      p l ~ ln m,

follows the weight alone, whatever the vehicle does. It also changes with the battery, and with the air through the
propellers, but then with speed or over many seconds. A load is found if l differs between seconds before and after a
moment by much more than it varies within either, if half of the difference comes within a second, and if the vehicle
neither climbs nor flies at another speed than before.

The exponent p is only known to lie between 1 (thrust in proportion to the command) and 2 (to its square), unless the
profile has learned the curve.
"""

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from monitor.conditions.condition import FlightCondition
from monitor.conditions.half_seconds import HalfSecond
from monitor.display import number_text, percent_text

_BEFORE, _JUMP, _AFTER = 16, 2, 14
"""Half seconds of the window before, between the windows, and of the window after. Chosen: eight and seven seconds,
longer than gusts."""
_CERTAIN = 2.8
"""Least change of l, relative to the variation of its means over a second within a window. Measured on 23 simulated
flights of two autopilots: the two loads that were let go reach 3.3 and 5.0, all else at most 2.3."""
_LEAST_SPREAD = 0.03
"""Least such variation: that of hovering in calm air. The smallest load that can be found is then 8 % of the weight for
p = 1, 16 % for p = 2."""
_SUDDEN = 0.35
"""Least share of the change within a second: a load goes at once, air does not. Measured: 0.5 and 0.85 of the two
loads; the autopilot changes the thrust within the second, and l differs from the weight while the rotors follow."""
_CLIMB, _SPEED = 0.7, 2.0
"""Largest difference of climb and of speed between the windows, m/s. Measured on the same flights: at the end of a
climb and of a fast leg l changes by up to 0.6; the vehicles that let a load go change by 0.04 and 1.3."""
_NOTICED = 0.03
"""Least shift of the centre of gravity that is reported, as a share of the arm: chosen, 1 cm for an arm of 30."""


class Load:
    """Looks for loads in half seconds of flight.

    p lies between the ``exponents``; ``mass_kg`` is the mass of the vehicle that was fitted, 0 if it is not known.
    """

    def __init__(self, exponents: tuple[float, float], mass_kg: float) -> None:
        self._exponents, self._mass_kg = exponents, mass_kg
        self._window: deque[HalfSecond] = deque(maxlen=_BEFORE + _JUMP + _AFTER)

    def clear(self) -> None:
        """Forget the past: it belongs to another stretch of flight."""
        self._window.clear()

    def follow(self, mean: HalfSecond) -> FlightCondition | None:
        """Process the next half second; return the load that has changed, as soon as it is certain."""
        self._window.append(mean)
        if len(self._window) < _BEFORE + _JUMP + _AFTER:
            return None
        l = [row.load for row in self._window]  # noqa: E741 - as in the formula
        before, after = l[:_BEFORE], l[-_AFTER:]
        change = _median(after) - _median(before)
        if abs(change) < _CERTAIN * _LEAST_SPREAD:
            return None
        spread = max(_spread(before), _spread(after))
        if abs(change) < _CERTAIN * spread:
            return None
        if math.copysign(1.0, change) * (l[_BEFORE + _JUMP] - l[_BEFORE - 1]) < _SUDDEN * abs(change):
            return None
        if abs(self._climb(slice(-_AFTER, None)) - self._climb(slice(None, _BEFORE))) > _CLIMB:
            return None
        speed = [row.speed for row in self._window]
        if abs(_median(speed[-_AFTER:]) - _median(speed[:_BEFORE])) > _SPEED:
            return None
        found = self._condition(change, spread)
        self.clear()
        return found

    def _climb(self, part: slice) -> float:
        rows = list(self._window)[part]
        return (rows[-1].height - rows[0].height) / (0.5 * (len(rows) - 1))

    def _condition(self, change: float, spread: float) -> FlightCondition:
        rows = list(self._window)
        least = self._exponents[0] * max(abs(change) - spread, 0.0)
        most = self._exponents[1] * (abs(change) + spread)
        sign = math.copysign(1.0, change)
        shares = [math.expm1(sign * size) for size in (least, abs(change) * sum(self._exponents) / 2.0, most)]
        low, share, high = shares
        # Commands and accelerations look alike after a gain of weight and after a loss of thrust.
        what = "payload picked up, or less thrust of all motors alike" if change > 0.0 else "payload dropped"
        text = f"{what}: {_weights(low, share, high, self._mass_kg)}"
        forward, right = self._shift(rows).tolist()
        values = {"weight_share": share, "weight_share_low": min(low, high), "weight_share_high": max(low, high)}
        if self._mass_kg:
            values["mass_kg"] = share * self._mass_kg
        if math.isfinite(forward) and math.isfinite(right):
            values |= {"forward_share_of_arm": forward, "right_share_of_arm": right}
            moved = [
                f"{percent_text(abs(size))} % of the arm {words[size < 0.0]}"
                for size, words in ((forward, ("forward", "back")), (right, ("right", "left")))
                if abs(size) >= _NOTICED
            ]
            text += f", centre of gravity {' and '.join(moved)}" if moved else ", centre of gravity where it was"
        return FlightCondition("payload", rows[_BEFORE + _JUMP // 2].time_ns, text, values)

    def _shift(self, rows: list[HalfSecond]) -> NDArray[np.float64]:
        """Return the shift of the thrust, and with it of the weight, forward and right in arms."""
        moments = np.array([row.moments for row in rows])
        middle = sum(self._exponents) / 2.0
        return middle * np.asarray(np.median(moments[-_AFTER:], axis=0) - np.median(moments[:_BEFORE], axis=0))


def _median(values: list[float]) -> float:
    """Return the median of an even number of values: NumPy's takes 30 times as long for so few."""
    middle = len(values) // 2
    return sum(sorted(values)[middle - 1 : middle + 1]) / 2.0


def _spread(values: list[float]) -> float:
    """Return how much means over a second vary, from values over half seconds."""
    means = [(first + second) / 2.0 for first, second in zip(values[::2], values[1::2], strict=True)]
    return max(means) - min(means)


def _weights(low: float, share: float, high: float, mass_kg: float) -> str:
    if mass_kg:
        sizes = [number_text(mass_kg * size, 2, signed=True) for size in (share, low, high)]
        return f"{sizes[0]} kg ({sizes[1]} to {sizes[2]})"
    sizes = [percent_text(size, signed=True) for size in (share, low, high)]
    return f"{sizes[0]} % of the weight ({sizes[1]} to {sizes[2]})"
