"""Means of a multirotor's signals over half seconds of flight: what conditions are told from."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

SIGNALS = ("xacc", "yacc", "zacc", "roll", "pitch", "yaw", "gps_speed", "gps_course", "gps_alt", "baro_alt")
"""Signals that are needed beside the motors' commands, as the inertial observer names them."""
_HALF_NS = 500_000_000
"""Chosen: shorter than an autopilot takes to answer a load that goes, longer than the noise of ten samples a second."""
_LEAST_ROWS = 3
"""Samples that a half second needs: chosen, of four or five at the slowest rate that is taken."""
_GRAVITY = 9.80665
"""m/s^2, the standard one."""


class HalfSecond(NamedTuple):
    """Means over half a second."""

    number: int  # of the half second on the vehicle's clock
    time_ns: int  # Unix time of its first sample
    load: float  # logarithm of the mean command over the vertical specific force in units of gravity
    moments: tuple[float, float]  # where thrust acts, shares of the arm forward and right
    pull: tuple[float, float]  # specific force along the body's x and y, turned to north and east, m/s^2
    velocity: tuple[float, float]  # of the GPS, north and east, m/s
    speed: float  # m/s
    # m
    height: float
    gps_height: float


class HalfSeconds:
    """Collects samples (commands first, then :data:`SIGNALS`) to half seconds.

    ``arms`` is where each motor is, in shares of the longest arm forward and right (motors, 2), not a number where that
    is not known; ``metres`` the height of one of the barometer's units.
    """

    def __init__(self, arms: NDArray[np.float64], metres: float) -> None:
        self._arms, self._metres = arms, metres
        self._rows: list[NDArray[np.float64]] = []
        self._number, self._time_ns = -1, 0

    def follow(self, vehicle_ns: int, time_ns: int, row: NDArray[np.float64]) -> HalfSecond | None:
        """Take a sample of flight; return the half second before it where it begins another one."""
        number = vehicle_ns // _HALF_NS
        if number == self._number:
            self._rows.append(row)
            return None
        mean = self._mean() if len(self._rows) >= _LEAST_ROWS else None
        self._rows, self._number, self._time_ns = [row], number, time_ns
        return mean

    def _mean(self) -> HalfSecond | None:
        rows = np.array(self._rows)
        motors = len(self._arms)
        u = rows[:, :motors]
        x, y, z, roll, pitch, yaw, speed, course, gps_height, height = rows[:, motors:].T
        mean = u.mean(axis=1)
        if not (np.isfinite(rows).all() and (mean > 0.0).all() and (z < 0.0).all()):
            return None
        forward = x * np.cos(pitch) + (y * np.sin(roll)) * np.sin(pitch)
        right = y * np.cos(roll)
        north, east = _turned(forward, right, yaw)
        along, across = _turned(speed, np.zeros(len(speed)), np.radians(course))
        moments = (u @ self._arms) / u.sum(axis=1, keepdims=True)
        return HalfSecond(
            number=self._number,
            time_ns=self._time_ns,
            load=float(np.mean(np.log(mean * _GRAVITY / -z))),
            moments=_pair(moments.mean(axis=0)),
            pull=(float(north.mean()), float(east.mean())),
            velocity=(float(along.mean()), float(across.mean())),
            speed=float(speed.mean()),
            height=self._metres * float(height.mean()),
            gps_height=float(gps_height.mean()),
        )


def _turned(
    forward: NDArray[np.float64], right: NDArray[np.float64], heading: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return what lies north and east of what lies forward and right."""
    c, s = np.cos(heading), np.sin(heading)
    return c * forward - s * right, s * forward + c * right


def _pair(values: Sequence[float] | NDArray[np.float64]) -> tuple[float, float]:
    first, second = values
    return float(first), float(second)
