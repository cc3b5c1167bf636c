"""Means of a multirotor's signals over half seconds of flight, from which conditions are found."""

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
        self._kept: list[tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]] = []

    def run(
        self, vehicle_ns: NDArray[np.int64], time_ns: NDArray[np.int64], rows: NDArray[np.float64]
    ) -> list[HalfSecond]:
        """Process n samples of flight; return the half seconds that they complete."""
        self._kept.append((vehicle_ns // _HALF_NS, time_ns, rows))
        number = self._kept[0][0][0]
        if all(number == one for one in self._kept[-1][0].tolist()):
            return []
        numbers, times_ns, rows = map(np.concatenate, zip(*self._kept, strict=True))
        begins = np.flatnonzero(np.diff(numbers, prepend=-1))
        last = begins[-1]
        self._kept = [(numbers[last:], times_ns[last:], rows[last:])]
        return self._means(numbers, times_ns, rows[:last], begins)

    def _means(
        self,
        numbers: NDArray[np.int64],
        times_ns: NDArray[np.int64],
        rows: NDArray[np.float64],
        begins: NDArray[np.intp],
    ) -> list[HalfSecond]:
        motors, counts, begins = len(self._arms), np.diff(begins), begins[:-1]
        columns = np.ascontiguousarray(rows.T)
        x, y, z, roll, pitch, yaw, speed, course, gps_height, height = columns[motors:]
        command = columns[:motors].sum(axis=0)
        usable = np.isfinite(columns).all(axis=0) & (command > 0.0) & (z < 0.0)
        forward = x * np.cos(pitch) + (y * np.sin(roll)) * np.sin(pitch)
        right = y * np.cos(roll)
        north, east = _turned(forward, right, yaw)
        along, across = _turned(speed, 0.0, np.radians(course))
        load = np.log(command / motors * STANDARD_GRAVITY / -z)
        # no product of matrices, which adds in an order that depends on their size
        moments = (columns[:motors, None] * self._arms[:, :, None]).sum(axis=0) / command
        values = np.array([load, *moments, north, east, along, across, speed, height, gps_height])
        means = (np.add.reduceat(values, begins, axis=1) / counts).T.tolist()
        flown = np.logical_and.reduceat(usable, begins) & (counts >= _LEAST_ROWS)
        return [
            HalfSecond(
                number=number,
                time_ns=time_ns,
                load=mean[0],
                moments=(mean[1], mean[2]),
                pull=(mean[3], mean[4]),
                velocity=(mean[5], mean[6]),
                speed=mean[7],
                height=self._metres * mean[8],
                gps_height=mean[9],
            )
            for number, time_ns, mean, flies in zip(
                numbers[begins].tolist(), times_ns[begins].tolist(), means, flown.tolist(), strict=True
            )
            if flies
        ]


def _turned(
    forward: NDArray[np.float64], right: NDArray[np.float64] | float, heading: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the components north and east of a vector with the components forward and right."""
    c, s = np.cos(heading), np.sin(heading)
    return c * forward - s * right, s * forward + c * right
