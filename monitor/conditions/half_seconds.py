"""Means of a multirotor's signals over half seconds of flight, from which conditions are found."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adapters.channels import STANDARD_GRAVITY

SIGNALS = ("xacc", "yacc", "zacc", "roll", "pitch", "yaw", "gps_speed", "gps_course", "gps_alt", "baro_alt")
"""Signals that are needed beside the motors' commands, by their names in the inertial observer."""
_HALF_NS = 500_000_000
"""Length of the mean, nanoseconds. Chosen: shorter than an autopilot takes to answer a load that is let go, longer than
the noise of ten samples a second."""
_LEAST_ROWS = 3
"""Least number of samples in a half second: chosen, of the four or five at the slowest rate that is accepted."""


class HalfSecond(NamedTuple):
    """Means over half a second."""

    number: int  # number of the half second on the vehicle's clock
    time_ns: int  # Unix time of its first sample
    load: float  # logarithm of the mean command over the vertical specific force in units of gravity
    moments: tuple[float, float]  # where thrust acts, as shares of the arm, forward and right
    pull: tuple[float, float]  # specific force along the body's x and y, turned to north and east, m/s^2
    velocity: tuple[float, float]  # velocity by GPS, north and east, m/s
    speed: float  # m/s
    # m
    height: float
    gps_height: float


class HalfSeconds:
    """Collects samples (commands first, then :data:`SIGNALS`) into half seconds.

    ``arms`` is the position of each motor, in shares of the longest arm forward and right (motors, 2), NaN if it is not
    known; ``metres`` the height of one of the barometer's units.
    """

    def __init__(self, arms: NDArray[np.float64], metres: float) -> None:
        self._arms, self._metres = arms, metres
        self._rows = np.empty((0, len(arms) + len(SIGNALS)))
        self._number, self._time_ns = -1, 0

    def run(
        self, vehicle_ns: NDArray[np.int64], time_ns: NDArray[np.int64], rows: NDArray[np.float64]
    ) -> list[HalfSecond]:
        """Process n samples of flight; return the half seconds that they complete."""
        numbers = vehicle_ns // _HALF_NS
        begins = np.flatnonzero(np.diff(numbers, prepend=self._number))
        rest, *others = np.split(rows, begins)
        self._rows = np.vstack([self._rows, rest])
        ended = []
        for first, other in zip(begins, others, strict=True):
            if len(self._rows) >= _LEAST_ROWS and (mean := self._mean()) is not None:
                ended.append(mean)
            self._rows, self._number, self._time_ns = other, int(numbers[first]), int(time_ns[first])
        return ended

    def _mean(self) -> HalfSecond | None:
        motors = len(self._arms)
        u = self._rows[:, :motors]
        x, y, z, roll, pitch, yaw, speed, course, gps_height, height = self._rows[:, motors:].T
        command = u.sum(axis=1)
        if not (np.isfinite(self._rows).all() and command.min() > 0.0 and z.max() < 0.0):
            return None
        forward = x * np.cos(pitch) + (y * np.sin(roll)) * np.sin(pitch)
        right = y * np.cos(roll)
        north, east = _turned(forward, right, yaw)
        along, across = _turned(speed, 0.0, np.radians(course))
        load = np.log(command / motors * STANDARD_GRAVITY / -z)
        moments = (u @ self._arms).T / command
        values = np.array([load, *moments, north, east, along, across, speed, height, gps_height])
        means = values.mean(axis=1).tolist()
        return HalfSecond(
            number=self._number,
            time_ns=self._time_ns,
            load=means[0],
            moments=(means[1], means[2]),
            pull=(means[3], means[4]),
            velocity=(means[5], means[6]),
            speed=means[7],
            height=self._metres * means[8],
            gps_height=means[9],
        )


def _turned(
    forward: NDArray[np.float64], right: NDArray[np.float64] | float, heading: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the components north and east of a vector with the components forward and right."""
    c, s = np.cos(heading), np.sin(heading)
    return c * forward - s * right, s * forward + c * right
