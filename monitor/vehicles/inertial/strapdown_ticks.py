"""What the raw signals of a vehicle say about its motion tick by tick, brought to one age by delay lines.

Ticks come one by one (``feed``) or as the columns of a stretch (``run``): what both compute is written once, for
numbers and arrays alike, and a test holds the rest together to the last bit.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from math import atan2, cos, radians, sin

import numpy as np
from numpy.typing import NDArray

from monitor.sampling.stretch import mapped, since
from monitor.vehicles.inertial.kinematics import (
    Real,
    acceleration,
    levelled_field,
    metres_per_degree,
    pressure_altitude,
    rotation_matrix,
    small_rotation,
    wrapped,
    wrapped_degrees,
)

GPS_SIGNALS = 5
_STEEPEST_COSINE = 0.05
# An attitude that turns this much faster than the gyro says was reset (another estimator took over): no rotation.
_RESET_RATE = 1.0
_RESET_TICKS = 3

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Sensors:
    """Which sensors there are beside IMU and attitude, and how many ticks each waits for the latest of them.

    Parameters
    ----------
    gps, baro, mag : bool
        Whether there are GPS, barometer and magnetometer.
    hectopascal : bool
        Whether the barometer's signal is its pressure.
    dt : float
        Time between ticks, seconds.
    imu_ticks, gps_ticks, baro_ticks, compass_ticks : int
        Ticks by which to delay acceleration, GPS and barometer, and the attitude that levels the magnetometer.
    """

    gps: bool
    baro: bool
    mag: bool
    hectopascal: bool
    dt: float
    imu_ticks: int
    gps_ticks: int
    baro_ticks: int
    compass_ticks: int


class Ticks:
    """State between ticks since a restart.

    Parameters
    ----------
    sensors : Sensors
        What the signals consist of.
    """

    def __init__(self, sensors: Sensors) -> None:
        self._sensors = sensors
        self._motion = _Delay(sensors.imu_ticks)
        self._fixes = _Delay(sensors.gps_ticks)
        self._altitudes = _Delay(sensors.baro_ticks)
        self._levels = _Delay(sensors.compass_ticks)
        self._rotation: tuple[float, ...] | None = None
        self._origin: tuple[float, ...] = ()
        self._heading = 0.0
        self._turned = [0.0, 0.0, 0.0]
        self._resets = 0

    def feed(self, values: list[float]) -> tuple[list[float], list[float]] | None:
        """Return u of this tick and the integrals y before washing; None before every delay line is full."""
        sensors, force, rate, (roll, pitch, yaw), rest = self._sensors, values[:3], values[3:6], values[6:9], values[9:]
        level = cos(roll), sin(roll), cos(pitch), sin(pitch)
        R = rotation_matrix(*level, cos(yaw), sin(yaw))
        self._turn(R, rate)
        cosine = level[2]
        if abs(cosine) < _STEEPEST_COSINE:
            cosine = _STEEPEST_COSINE if cosine >= 0.0 else -_STEEPEST_COSINE
        motion = self._motion.push(acceleration(R, *force))
        past = self._levels.push((*level, _heading_rate(rate, level, cosine)))
        fix: tuple[float, ...] | None = ()
        altitude: tuple[float, ...] | None = ()
        if sensors.gps:
            course = radians(rest[4])
            self._settle(rest[0], rest[1])
            fix = self._fixes.push(_fix(self._origin, rest, cos(course), sin(course)))
            rest = rest[GPS_SIGNALS:]
        if sensors.baro:
            altitude = self._altitudes.push((pressure_altitude(rest[0]) if sensors.hectopascal else rest[0],))
            rest = rest[1:]
        if motion is None or past is None or fix is None or altitude is None:
            return None
        compass: tuple[float, ...] = ()
        if sensors.mag:
            self._heading += wrapped(atan2(*levelled_field(*past[:4], *rest)) - self._heading)
            compass = past[4], self._heading
        return _arranged(motion, fix, altitude, rate, self._turned, compass)

    def run(self, signals: Array) -> tuple[Array, Array]:
        """Return u and the integrals y as columns for the last m ticks, those for which :meth:`feed` returns them.

        Parameters
        ----------
        signals : Array
            One column per tick, finite.
        """
        sensors, force, rate, (roll, pitch, yaw), rest = (
            self._sensors,
            signals[:3],
            signals[3:6],
            signals[6:9],
            signals[9:],
        )
        level = (mapped(cos, roll), mapped(sin, roll), mapped(cos, pitch), mapped(sin, pitch))
        R = rotation_matrix(*level, mapped(cos, yaw), mapped(sin, yaw))
        turned = self._turn_all(R, rate)
        steep = np.where(level[2] >= 0.0, _STEEPEST_COSINE, -_STEEPEST_COSINE)
        cosine = np.where(np.abs(level[2]) < _STEEPEST_COSINE, steep, level[2])
        motion = self._motion.run(acceleration(R, *force))
        past = self._levels.run((*level, _heading_rate(tuple(rate), level, cosine)))
        fix, altitude = signals[:0], signals[:0]
        if sensors.gps:
            self._settle(float(rest[0, 0]), float(rest[1, 0]))
            course = mapped(radians, rest[4])
            fix = self._fixes.run(_fix(self._origin, tuple(rest), mapped(cos, course), mapped(sin, course)))
            rest = rest[GPS_SIGNALS:]
        if sensors.baro:
            altitude = self._altitudes.run((mapped(pressure_altitude, rest[0]) if sensors.hectopascal else rest[0],))
            rest = rest[1:]
        count = min(part.shape[1] for part in (motion, past, fix, altitude))
        motion, past, fix, altitude, rate, turned, rest = (
            part[:, part.shape[1] - count :] for part in (motion, past, fix, altitude, rate, turned, rest)
        )
        compass: tuple[Array, ...] = ()
        if sensors.mag:
            compass = past[4], self._follow(*levelled_field(*past[:4], *rest))
        u, y = _arranged(tuple(motion), tuple(fix), tuple(altitude), tuple(rate), tuple(turned), compass)
        return np.stack(u), np.stack(y)

    def _settle(self, latitude: float, longitude: float) -> None:
        """Count metres from the first place."""
        if not self._origin:
            self._origin = latitude, longitude, *metres_per_degree(latitude)

    def _turn(self, R: tuple[float, ...], rate: list[float]) -> None:
        """Add what the attitude turned since the tick before; while it is being reset, what the gyro did."""
        if self._rotation is not None:
            dt = self._sensors.dt
            angles = small_rotation(self._rotation, R)
            steps = [value * dt for value in rate]
            jumps = max(abs(a - b) for a, b in zip(angles, steps, strict=True)) > _RESET_RATE * dt
            self._resets = self._resets + 1 if jumps else 0
            for i, angle in enumerate(steps if 0 < self._resets <= _RESET_TICKS else angles):
                self._turned[i] += angle
        self._rotation = R

    def _turn_all(self, R: tuple[Array, ...], rate: Array) -> Array:
        """Return the rotation about the body's axes after each tick (3, n)."""
        dt = self._sensors.dt
        before = tuple(
            np.concatenate([[first], of[:-1]])
            for first, of in zip(self._rotation or [of[0] for of in R], R, strict=True)
        )
        angles, steps = np.stack(small_rotation(before, R)), rate * dt
        largest, *others = np.abs(angles - steps)
        for other in others:
            largest = np.where(other > largest, other, largest)
        jumps = largest > _RESET_RATE * dt
        if self._rotation is None:
            angles[:, 0], jumps[0] = 0.0, False
        resets = since(~jumps, self._resets)
        by_gyro = (resets > 0) & (resets <= _RESET_TICKS)
        angles = np.where(by_gyro, steps, angles)
        turned = np.cumsum(np.column_stack([self._turned, angles]), axis=1)[:, 1:]
        self._rotation = tuple(float(of[-1]) for of in R)
        self._resets, self._turned = int(resets[-1]), turned[:, -1].tolist()
        return turned

    def _follow(self, left: Array, forward: Array) -> Array:
        """Return the heading of the magnetic field tick by tick, continued beyond half a turn."""
        heading, found = self._heading, []
        for y, x in zip(left.tolist(), forward.tolist(), strict=True):
            heading += wrapped(atan2(y, x) - heading)
            found.append(heading)
        self._heading = heading
        return np.array(found, np.float64)


class _Delay:
    """A line that gives back what went in some ticks ago."""

    def __init__(self, ticks: int) -> None:
        self._line: deque[tuple[float, ...]] = deque(maxlen=ticks + 1)
        self._ticks = ticks

    def push(self, value: tuple[float, ...]) -> tuple[float, ...] | None:
        """Take a value; return the oldest, None while the line fills."""
        self._line.append(value)
        return self._line[0] if len(self._line) > self._ticks else None

    def run(self, values: Sequence[Array]) -> Array:
        """Take values as columns (w, n); return those that come out (w, m), which are the last m of the n ticks."""
        held = list(self._line)[max(len(self._line) - self._ticks, 0) :]
        whole = np.concatenate([np.array(held, np.float64).reshape(-1, len(values)).T, np.stack(values)], axis=1)
        self._line.extend(map(tuple, whole[:, len(held) :][:, -self._ticks - 1 :].T.tolist()))
        return whole[:, : max(whole.shape[1] - self._ticks, 0)]


def _heading_rate(rate: Sequence[Real], level: tuple[Real, ...], cosine: Real) -> Real:
    return (rate[1] * level[1] + rate[2] * level[0]) / cosine


def _fix(origin: tuple[float, ...], gps: Sequence[Real], ahead: Real, right: Real) -> tuple[Real, ...]:
    """Return north, east and down in metres (down of any origin), and the velocity north and east."""
    latitude, longitude, altitude, speed = gps[:4]
    north = (latitude - origin[0]) * origin[2]
    east = wrapped_degrees(longitude - origin[1]) * origin[3]
    return north, east, -altitude, speed * ahead, speed * right


def _arranged(
    motion: tuple[Real, ...],
    fix: tuple[Real, ...],
    altitude: tuple[Real, ...],
    rate: Sequence[Real],
    turned: Sequence[Real],
    compass: tuple[Real, ...],
) -> tuple[list[Real], list[Real]]:
    """Return u and y in the order of their names; empty is what the vehicle has not."""
    u: list[Real] = []
    y: list[Real] = []
    if fix:
        u += [fix[3], fix[4], motion[0], motion[1]]
        y += [fix[0], fix[1], fix[3], fix[4], fix[2]]
    if altitude:
        y.append(-altitude[0])
    if y:
        u.append(motion[2])
    u += rate
    y += turned
    if compass:
        u.append(compass[0])
        y.append(compass[1])
    return u, y
